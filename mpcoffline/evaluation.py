"""Closed loops: what a policy costs in an environment, many episodes stepped together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from mpcoffline.checks import check_integers
from mpcoffline.envs import ControlTask
from mpcoffline.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.solvers.fallback import SolverStats, failures_in_words

Array = NDArray[np.float64]


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
        success: The environment's ``info["is_success"]`` after the last step, ``(n,)``.
        length: Steps, ``(n,)``.
        discount: gamma of ``discounted_cost``.
        states: ``info["state"]`` along each episode, ``(T + 1, nx)``; the observation where the environment gives none.
        actions: Actions applied, ``(T, nu)``.
        n_solves: MPCs that the policy solved meanwhile; 0 for what is no MPC.
        n_failures: Of them, those whose solution was not accepted at first; ``solver_stats`` of the policy says how
            they were answered.
    """

    cost: Array
    discounted_cost: Array
    success: NDArray[np.bool_]
    length: NDArray[np.int64]
    discount: float
    states: list[Array] = field(repr=False)
    actions: list[Array] = field(repr=False)
    n_solves: int = 0
    n_failures: int = 0

    def __str__(self) -> str:
        failed = f", failed solves {failures_in_words(self.n_failures, self.n_solves)}" if self.n_solves else ""
        return (
            f"{len(self.cost)} episodes: cost {self.cost.mean():.1f} +- {self.cost.std():.1f}, "
            f"discounted {self.discounted_cost.mean():.2f}, success {self.success.mean():.0%}{failed}"
        )


def evaluate(
    policy: Predictor,
    env: gym.Env[Any, Any] | str,
    n_episodes: int = 20,
    seed: int = 0,
    *,
    discount: float = 0.9,
    options: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
) -> Evaluation:
    """Runs a policy in closed loop.

    The environment is rebuilt ``n_episodes`` times from ``env.spec``; all copies step together, so that a policy solves
    its MPCs in batches. Episode i is reset with ``seed + i``: two policies meet the same starts.

    Args:
        policy: Anything with SB3's ``predict``.
        env: An environment made by ``gym.make``, or its id.
        n_episodes: Number of episodes.
        seed: Seed of the first episode.
        discount: gamma of the discounted cost.
        options: ``reset`` options, the same for all episodes or one a episode.

    Returns:
        Costs and trajectories.

    Raises:
        InvalidArgumentError: For a non-positive number of episodes, options of another length, or an environment
            without spec.
        UnknownIdError: For an environment id that is not registered.
    """
    check_integers(1, n_episodes=n_episodes)
    if not 0.0 < discount <= 1.0:
        raise InvalidArgumentError("discount", expected="a number in (0, 1]", actual=str(discount))
    if not isinstance(env, str | gym.Env):
        raise InvalidArgumentError(
            "env",
            expected="a Gymnasium environment or the id of one",
            actual=type(env).__name__,
            hint="Vector environments go to stable_baselines3's evaluate_policy; here copies step together anyway.",
        )
    spec = _registered(env) if isinstance(env, str) else env.spec
    if spec is None:
        raise InvalidArgumentError("env", expected="an environment made by gym.make", actual=f"{env} without a spec")
    each = [options or {}] * n_episodes if options is None or isinstance(options, dict) else list(options)
    if len(each) != n_episodes:
        raise InvalidArgumentError("options", expected=f"{n_episodes} entries", actual=str(len(each)))
    as_arrays = spec.vector_entry_point and not spec.additional_wrappers and _is_our_task(spec)
    before = _solves(policy)
    result = (_evaluate_as_arrays if as_arrays else _evaluate_one_by_one)(policy, spec, each, seed, discount)
    n_solves, n_failures = (int(n) for n in np.subtract(_solves(policy), before))
    return replace(result, n_solves=n_solves, n_failures=n_failures)


def _solves(policy: Predictor) -> tuple[int, int]:
    """How many MPCs a policy, or the one in a model of SB3's, has solved, and how many of them failed."""
    stats = getattr(policy, "solver_stats", None) or getattr(getattr(policy, "policy", None), "solver_stats", None)
    return (stats.n_solves, stats.n_failures) if isinstance(stats, SolverStats) else (0, 0)


def _evaluate_as_arrays(
    policy: Predictor, spec: EnvSpec, options: Sequence[dict[str, Any]], seed: int, discount: float
) -> Evaluation:
    """Our own tasks: their vector twin, which equals them bit for bit and ends all episodes at the same step."""
    n = len(options)
    env = gym.make_vec(spec, num_envs=n, vectorization_mode="vector_entry_point", render_mode=None)
    observations, info = env.reset(seed=seed, options=list(options))  # type: ignore[arg-type]  # our twin takes a list
    state: Any = None
    first, done = np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
    states, actions, costs = [info["state"]], [], []
    while not done.all():
        action, state = policy.predict(observations, state=state, episode_start=first, deterministic=True)
        observations, _, _, done, info = env.step(action)
        first = np.zeros(n, dtype=bool)
        states.append(info["state"])
        actions.append(np.asarray(action, dtype=np.float64))
        costs.append(info["cost"])
    each_cost = np.stack(costs)
    return Evaluation(
        cost=each_cost.sum(axis=0),
        discounted_cost=discount ** np.arange(len(costs)) @ each_cost,
        success=info["is_success"],
        length=np.full(n, len(costs)),
        discount=discount,
        states=list(np.stack(states, axis=1)),
        actions=list(np.stack(actions, axis=1)),
    )


def _evaluate_one_by_one(
    policy: Predictor, spec: EnvSpec, options: Sequence[dict[str, Any]], seed: int, discount: float
) -> Evaluation:
    """Any environment: copies of it, stepped in turn, with one prediction for all."""
    episodes = [_Episode(gym.make(spec), seed + i, option, discount) for i, option in enumerate(options)]
    state: Any = None
    starts = np.ones(len(episodes), dtype=bool)
    while not all(episode.done for episode in episodes):
        observations = np.stack([episode.observation for episode in episodes])
        actions, state = policy.predict(observations, state=state, episode_start=starts, deterministic=True)
        starts = np.zeros(len(episodes), dtype=bool)
        for episode, action in zip(episodes, actions, strict=True):
            episode.step(action)
    return Evaluation(
        cost=np.array([episode.cost for episode in episodes]),
        discounted_cost=np.array([episode.discounted_cost for episode in episodes]),
        success=np.array([episode.success for episode in episodes]),
        length=np.array([len(episode.actions) for episode in episodes]),
        discount=discount,
        states=[np.array(episode.states) for episode in episodes],
        actions=[np.array(episode.actions) for episode in episodes],
    )


def _is_our_task(spec: EnvSpec) -> bool:
    env: gym.Env[Any, Any] = gym.make(spec)
    env.close()
    return isinstance(env.unwrapped, ControlTask)


def _registered(env_id: str) -> EnvSpec | None:
    """The specification of an environment id, ``"module:id"`` too."""
    try:
        env: gym.Env[Any, Any] = gym.make(env_id)
    except gym.error.UnregisteredEnv as error:
        raise UnknownIdError(
            "environment id", expected="a registered environment", actual=repr(env_id), hint=str(error)
        ) from error
    env.close()
    return env.spec


class _Episode:
    """One environment and what has happened in it; steps after the end are ignored."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, options: dict[str, Any], discount: float) -> None:
        self._env, self._discount = env, discount
        self.observation, info = env.reset(seed=seed, options=options or None)
        self.cost = self.discounted_cost = 0.0
        self.success = self.done = False
        self.states: list[Any] = [info.get("state", self.observation)]
        self.actions: list[Any] = []

    def step(self, action: NDArray[Any]) -> None:
        """Steps the environment unless the episode is over."""
        if self.done:
            return
        observation, reward, terminated, truncated, info = self._env.step(action)
        cost = float(info.get("cost", -float(reward)))
        self.discounted_cost += self._discount ** len(self.actions) * cost
        self.cost += cost
        self.states.append(info.get("state", observation))
        self.actions.append(np.asarray(action, dtype=np.float64))
        self.done = bool(terminated or truncated)
        self.success = bool(info.get("is_success", False))
        if self.done:
            self._env.close()
        else:  # a policy goes on seeing the last state before the end, which it can solve for
            self.observation = observation
