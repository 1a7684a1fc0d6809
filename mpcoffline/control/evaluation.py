"""Closed loops: what a policy costs in an environment, many episodes stepped together."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from mpcoffline.core.checks import check_integers, checked_seed
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.datasets.check.rebuilding import rebuilt_spec, without_window
from mpcoffline.datasets.recording.plants import (
    check_spaces,
    check_unchanged,
    check_units,
    in_units,
    is_mpc,
    no_end,
    opened,
    step_cap,
)
from mpcoffline.datasets.recording.stage_cost import PlantInfo, number_of, reward_of
from mpcoffline.datasets.recording.watching import PlantWatch, watched
from mpcoffline.envs import ControlTask
from mpcoffline.envs.episode import DISCOUNT
from mpcoffline.solvers.fallback import SolverStats, failures_in_words


class Predictor(Protocol):
    """Anything with SB3's ``predict``: an :class:`mpcoffline.MPCPolicy`, an SB3 algorithm or policy."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Actions for a batch of observations, and the next state."""


@dataclass(frozen=True)
class Evaluation:
    """Closed-loop figures, one entry an episode.

    Attributes:
        cost: Undiscounted cost J = sum of L, ``(n,)``.
        discounted_cost: Jd = sum of gamma^k L, ``(n,)``.
        success: The environment's ``info["is_success"]`` after the last step, ``(n,)``; False where it says nothing.
        length: Steps, ``(n,)``.
        discount: gamma of ``discounted_cost``.
        states: ``info["state"]`` along each episode, ``(T + 1, nx)``; the observation where the environment does not
            give one at each step.
        actions: Actions applied, ``(T, nu)``.
        observations: What the policy saw, ``(T + 1, ny)`` of an environment whose observations are arrays.
        n_solves: MPCs that the policy solved meanwhile; 0 for what is no MPC.
        n_failures: Of them, those whose solution was not accepted at first; ``solver_stats`` of the policy says how
            they were answered.
        knows_success: Whether the environment says if an episode ended well.
    """

    cost: Array
    discounted_cost: Array
    success: NDArray[np.bool_]
    length: NDArray[np.int64]
    discount: float
    states: list[Array] = field(repr=False)
    actions: list[Array] = field(repr=False)
    observations: list[Any] = field(repr=False, default_factory=list)
    n_solves: int = 0
    n_failures: int = 0
    knows_success: bool = True

    def __str__(self) -> str:
        success = f", success {self.success.mean():.0%}" if self.knows_success else ""
        failed = f", failed solves {failures_in_words(self.n_failures, self.n_solves)}" if self.n_solves else ""
        return (
            f"{len(self.cost)} episodes: cost {self.cost.mean():.1f} +- {self.cost.std():.1f}, "
            f"discounted {self.discounted_cost.mean():.2f}{success}{failed}"
        )


def evaluate(
    policy: Predictor,
    env: gym.Env[Any, Any] | str,
    n_episodes: int = 20,
    seed: int = 0,
    *,
    discount: float = DISCOUNT,
    options: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
    cost_key: str | None = None,
    max_episode_steps: int | None = None,
) -> Evaluation:
    """Runs a policy in closed loop.

    The environment is rebuilt ``n_episodes`` times from its spec, without windows; all copies step together, so that a
    policy solves its MPCs in batches. Where that would be another environment (wrappers around it, attributes set on
    it, no spec), the given one itself is stepped, one episode after the other. Episode i is reset with ``seed + i``:
    two policies meet the same starts.

    The cost is the plant's: minus the reward below wrappers that change it, or ``info["cost"]`` in its place where the
    two are the same in float32. Where they are not, that key means something else (a violated limit, as in safe RL),
    and the reward counts, which a warning says once.

    Args:
        policy: Anything with SB3's ``predict``. An agent that learned under ``VecNormalize`` gets its observations
            normalised where it has the statistics.
        env: An environment or its id; not a vector environment. An MPC is refused wrappers that rescale.
        n_episodes: Number of episodes.
        seed: Seed of the first episode.
        discount: gamma of the discounted cost.
        options: ``reset`` options, the same for all episodes or one an episode.
        cost_key: The key of ``info`` that *is* the stage cost, minus the plant's reward; by default ``"cost"``, where
            it proves to be. A key that is named must be there and equal at each step.
        max_episode_steps: Steps after which an episode is one without end, an error; by default 10,000, or the
            environment's own limit where that is larger.

    Returns:
        Costs and trajectories.

    Raises:
        InvalidArgumentError: For a non-positive number of episodes, options of another length, a policy of other
            spaces, an MPC in an environment under wrappers that rescale, an episode without end, or a missing
            ``cost_key``.
        InvalidDataError: For a reward that is no number, or not minus the cost that ``cost_key`` names.
        UnknownIdError: For an environment id that is not registered.
    """
    check_integers(1, n_episodes=n_episodes)
    first_seed, number = checked_seed("seed", seed), int(n_episodes)
    if not 0.0 < discount <= 1.0:
        raise InvalidArgumentError("discount", expected="a number in (0, 1]", actual=str(discount))
    each = [options or {}] * number if options is None or isinstance(options, dict) else list(options)
    if len(each) != number:
        raise InvalidArgumentError("options", expected=f"{number} entries", actual=str(len(each)))
    given = opened(env)
    rule = PlantInfo("evaluate", cost_key)
    try:
        cap = step_cap(given, max_episode_steps)
        check_spaces(policy, given, narrower=is_mpc(policy))
        if is_mpc(policy):
            check_units(given)
        actor, our_task = in_units(policy), isinstance(given.unwrapped, ControlTask)
        known_cost = cost_key in (None, "cost")
        spec = rebuilt_spec(given) if given is env else without_window(given.spec) if given.spec is not None else None
    finally:
        if given is not env:
            given.close()
    before = _solves(policy)
    if our_task and spec is not None and spec.vector_entry_point and not spec.additional_wrappers and known_cost:
        result = _evaluate_as_arrays(actor, spec, each, first_seed, discount, cap)
    else:
        result = _figures(_run(actor, given, spec, each, first_seed, rule, cap), rule, discount)
    n_solves, n_failures = (int(n) for n in np.subtract(_solves(policy), before))
    return replace(result, n_solves=n_solves, n_failures=n_failures)


def _solves(policy: Predictor) -> tuple[int, int]:
    """How many MPCs a policy, or the one in a model of SB3's, has solved, and how many of them failed."""
    stats = getattr(policy, "solver_stats", None) or getattr(getattr(policy, "policy", None), "solver_stats", None)
    return (stats.n_solves, stats.n_failures) if isinstance(stats, SolverStats) else (0, 0)


def _run(
    policy: Predictor,
    given: gym.Env[Any, Any],
    spec: EnvSpec | None,
    options: Sequence[dict[str, Any]],
    seed: int,
    rule: PlantInfo,
    cap: int,
) -> list[_Episode]:
    """The episodes: of copies that step together, or one after the other where no copy can be made."""
    if spec is None:
        return _one_after_the_other(policy, given, options, seed, rule, cap)
    with ExitStack() as stack:
        envs = [stack.enter_context(closing(gym.make(spec))) for _ in options]
        episodes = [_Episode(PlantWatch(env), seed + i, options[i], rule, i) for i, env in enumerate(envs)]
        _step_together(policy, episodes, cap)
    return episodes


def _figures(episodes: Sequence[_Episode], rule: PlantInfo, discount: float) -> Evaluation:
    return Evaluation(
        cost=np.array([episode.costs.sum() for episode in episodes]),
        discounted_cost=np.array([discount ** np.arange(len(e.costs)) @ e.costs for e in episodes]),
        success=np.array([episode.success for episode in episodes]),
        length=np.array([len(episode.actions) for episode in episodes]),
        discount=discount,
        states=[np.array(episode.states if rule.has_state else episode.observations) for episode in episodes],
        actions=[np.array(episode.actions) for episode in episodes],
        observations=[np.array(episode.observations) for episode in episodes],
        knows_success=any(episode.knows_success for episode in episodes),
    )


def _evaluate_as_arrays(
    policy: Predictor, spec: EnvSpec, options: Sequence[dict[str, Any]], seed: int, discount: float, cap: int
) -> Evaluation:
    """Our own tasks: their vector twin, which equals them bit for bit and ends all episodes at the same step."""
    n = len(options)
    env = gym.make_vec(spec, num_envs=n, vectorization_mode="vector_entry_point", render_mode=None)  # nothing to close
    observations, info = env.reset(seed=seed, options=list(options))  # type: ignore[arg-type]  # our twin takes a list
    state: Any = None
    first, done = np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
    states, actions, costs, seen = [info["state"]], [], [], [observations]
    while not done.all():
        action, state = policy.predict(observations, state=state, episode_start=first, deterministic=True)
        observations, _, _, done, info = env.step(action)
        first = np.zeros(n, dtype=bool)
        states.append(info["state"])
        seen.append(observations)
        actions.append(np.asarray(action, dtype=np.float64))
        costs.append(info["cost"])
        if len(costs) >= cap and not done.all():
            raise no_end("env, episode 0", cap)
    each_cost = np.stack(costs)
    return Evaluation(
        cost=each_cost.sum(axis=0),
        discounted_cost=discount ** np.arange(len(costs)) @ each_cost,
        success=info["is_success"],
        length=np.full(n, len(costs)),
        discount=discount,
        states=list(np.stack(states, axis=1)),
        actions=list(np.stack(actions, axis=1)),
        observations=list(np.stack(seen, axis=1)),
    )


def _one_after_the_other(
    policy: Predictor, env: gym.Env[Any, Any], options: Sequence[dict[str, Any]], seed: int, rule: PlantInfo, cap: int
) -> list[_Episode]:
    """Steps the given environment itself."""
    episodes = []
    for i, option in enumerate(options):
        with watched(env) as watch:
            episodes.append(_Episode(watch, seed + i, option, rule, i, unchanged=is_mpc(policy)))
            _step_together(policy, episodes[-1:], cap)
    return episodes


def _step_together(policy: Predictor, episodes: Sequence[_Episode], cap: int) -> None:
    """Steps environments in turn, with one prediction for all, until all have ended."""
    state: Any = None
    starts = np.ones(len(episodes), dtype=bool)
    while not all(episode.done for episode in episodes):
        observations = np.stack([episode.observation for episode in episodes])
        actions, state = policy.predict(observations, state=state, episode_start=starts, deterministic=True)
        starts = np.zeros(len(episodes), dtype=bool)
        for episode, action in zip(episodes, actions, strict=True):
            episode.step(action, cap)


class _Episode:
    """One episode and what has happened in it; steps after the end are ignored."""

    def __init__(
        self,
        watch: PlantWatch,
        seed: int,
        options: dict[str, Any],
        rule: PlantInfo,
        number: int,
        *,
        unchanged: bool = False,
    ) -> None:
        self._watch, self._rule, self._number, self._unchanged = watch, rule, number, unchanged
        self.observation, info = watch.env.reset(seed=seed, options=options or None)
        self.success = self.done = self.knows_success = False
        self.observations: list[Any] = [np.array(self.observation)]
        self._first = rule.state(info, reset=True)
        self._states: list[Array | None] = []
        self._costs: list[float] = []
        self._rewards: list[float] = []
        self.actions: list[Array] = []

    @property
    def costs(self) -> Array:
        """The stage costs ``(T,)``: those of the infos where they count."""
        return np.array(self._costs) if self._rule.has_cost else -np.array(self._rewards)

    @property
    def states(self) -> list[Array]:
        """The states ``(T + 1, nx)``, where they count; an unknown first one is NaN."""
        known = [state for state in self._states if state is not None]
        return [np.full_like(known[0], np.nan) if self._first is None else self._first, *known]

    def step(self, action: NDArray[Any], cap: int) -> None:
        """Steps the environment unless the episode is over."""
        if self.done:
            return
        observation, reward, terminated, truncated, info = self._watch.env.step(action)
        if self._unchanged:
            check_unchanged(self._watch.env, self._watch, action, observation)
        given = reward_of(f"env, episode {self._number}", reward)
        paid = given if self._watch.reward is None else self._watch.reward
        self._costs.append(self._rule.cost(info, paid, given))
        self._rewards.append(paid)
        self._states.append(self._rule.state(info))
        self.observations.append(np.array(observation))
        self.actions.append(np.asarray(action, dtype=np.float64))
        self.done = bool(terminated or truncated)
        self.success = bool(number_of(info.get("is_success")) or False)
        self.knows_success |= "is_success" in info
        if not self.done:  # a policy goes on seeing the last state before the end, which it can solve for
            self.observation = observation
            if len(self.actions) >= cap:
                raise no_end(f"env, episode {self._number}", cap)
