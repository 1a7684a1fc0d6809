"""Distilling an MPC into an explicit policy: imitation where the policy itself goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.control.evaluation import evaluate
from mpcoffline.core.checks import check_integers, check_number, checked_seed
from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.core.progress import Bars
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable

from .fitting import fit_policy
from .loops import Loops, Teacher, closed_loops, mpc_acting, solved
from .network import PolicyNetwork, multiply_adds as count_multiply_adds, widths_within
from .policy import DistilledPolicy
from .report import Comparison, DistillationReport

if TYPE_CHECKING:
    from minari import MinariDataset

MULTIPLY_ADDS = 2_000  # an action: some 20 us on a microcontroller of 100 MHz
_STARTS = 400  # at most that are drawn of a table or an environment
_JUDGED = 0.25  # of the starts have no part in the fit
_FEW = 20  # starts, with fewer of which none can be spared
_HORIZONS = 3  # that a loop lasts by default
_TEACHER_NOISE, _POLICY_NOISE = 0.1, 0.05  # of an input's unit, twice over: shares of the range
_FIRST = 0.4  # of the labels are of the MPC's own loops
_STEPS, _LATER_STEPS, _REFINED, _LAST_REFINED = 2_500, 1_500, 60, 300
_EPISODES = 100  # in the environment


@dataclass(frozen=True)
class _Plan:
    """What distilling is to do, checked."""

    hidden: tuple[int, ...]
    n_steps: int
    n_labels: int
    rounds: int
    seed: int
    effort: float

    def iterations(self, last: bool, first: bool) -> tuple[int, int]:
        """Steps of Adam and of L-BFGS in a round."""
        adam = _STEPS if first else _LATER_STEPS
        refined = _LAST_REFINED if last else _REFINED
        return round(self.effort * adam), round(self.effort * refined)


def distill(
    policy: Teacher,
    starts: ArrayLike | TransitionTable | MinariDataset | str | None = None,
    *,
    env: gym.Env[Any, Any] | str | None = None,
    seed: int = 0,
    multiply_adds: int = MULTIPLY_ADDS,
    hidden: Sequence[int] | None = None,
    n_steps: int | None = None,
    n_labels: int = 40_000,
    rounds: int = 4,
    effort: float = 1.0,
    progress: bool = False,
) -> DistilledPolicy:
    """Makes an explicit policy of an MPC: a small network that acts as the MPC does, and solves nothing.

    Imitation alone fails in closed loop, since a small error leads where no example was. So the examples come from
    where the policy goes (DAgger; Ross, Gordon, Bagnell, arXiv:1011.0686): the MPC's closed loops on its own model from
    given starts, without and with noise on the inputs, then in each round those of the policy fitted so far. In each
    state met, the MPC is solved from several starts, and the best plan's first input is the example: a function of the
    state alone, while the MPC in its loop goes on with its plan. Where two plans are as good, as which way round a
    pendulum swings, the network changes from one to the other within a thin layer that the policy's own loops leave.
    Of the rounds' policies the one whose loops cost least is kept.

    What is no function of the observation must be among the network's inputs: past inputs are, see
    :class:`DistilledPolicy`; of a policy that estimates its states, distil the MPC within, and keep the observer.

    Example:
        >>> small = distill(learner.policy, "mpcoffline/pendulum/ddpg-v0", env="mpcoffline/PendulumSwingUp-v0", seed=0)
        >>> print(small.report)
        >>> small.save("small.zip")

    Args:
        policy: The MPC.
        starts: From which observations loops begin: ``(n, ny)``, or ``(n, n_states)`` with usual signals; or a log (a
            table, a data set or its id), of which the begins of its episodes and other rows are drawn. By default the
            environment's resets.
        env: An environment or its id, in which policy and MPC are compared at last, in 100 episodes.
        seed: Seeds everything random: the same seed, data and machine give the same policy.
        multiply_adds: The most that an action may take; decides the widths of two hidden layers.
        hidden: Their widths, instead.
        n_steps: Length of a loop; three horizons by default.
        n_labels: MPCs that are solved as examples, about. Solvers other than ddp and lqr take long for as many.
        rounds: How often it is fitted; two fifths of the examples are of the MPC's own loops, the others of the
            policies of the rounds before the last.
        effort: Scales the iterations of the fits.
        progress: Whether to show progress bars.

    Returns:
        The policy, with its ``report``.

    Raises:
        InvalidArgumentError: For a policy that estimates its states, neither starts nor an environment, starts of
            another size, numbers that are not positive, or a budget that no network keeps.
        MPCOfflineError: If the MPC was hardly ever solved.
    """
    mpc = _checked(policy)
    plan = _plan(mpc.nx, mpc.nu, mpc.horizon, hidden, multiply_adds, n_steps, n_labels, rounds, seed, effort)
    teacher = policy.with_normalization(None)
    rng = np.random.default_rng(plan.seed)
    states = mpc.state(_starts(policy, starts, env, rng))
    learned, judged = _parted(states, rng)
    with Bars(progress) as bars:
        bars.busy("the MPC in its own loops")
        network, n_solved = _Distilling(teacher, plan, learned, rng, bars).network()
        bars.busy("comparing with the MPC")
        report = _report(teacher, network, judged, plan, n_solved)
        made = _made(policy, network, report)
        if env is not None:
            made.report = _with_env(made, teacher, env, plan.seed)
    return made


class _Distilling:
    """The rounds of fitting and solving."""

    def __init__(self, teacher: Teacher, plan: _Plan, starts: Array, rng: np.random.Generator, bars: Bars) -> None:
        self._teacher, self._mpc, self._plan, self._starts, self._rng = teacher, teacher.mpc, plan, starts, rng
        self._bars, self._n_solved = bars, 0

    def network(self) -> tuple[PolicyNetwork, int]:
        """The best of the rounds' networks, and how many MPCs were solved."""
        plan, mpc = self._plan, self._mpc
        own = self._loops(mpc_acting(self._teacher), round(plan.n_labels * _FIRST / 2))
        bounds = np.asarray(mpc.action_low, np.float64), np.asarray(mpc.action_high, np.float64)
        network = PolicyNetwork.random(*own.rows()[:1], bounds, own.rows()[1], plan.hidden, self._rng)
        shaken = self._loops(mpc_acting(self._teacher), round(plan.n_labels * _FIRST / 2), 2 * _TEACHER_NOISE, network)
        near = [loops.near(network.mean, network.spread) for loops in (own, shaken)]
        states, actions = self._solved(np.concatenate(near))
        best, least = network, np.inf
        for k in range(plan.rounds):
            last = k == plan.rounds - 1
            adam, refined = plan.iterations(last, k == 0)
            self._bars.show("fitting", k, plan.rounds)
            network = fit_policy(network, states, actions, n_steps=adam, n_refined=refined, seed=plan.seed + k)
            rounded = network.rounded()
            cost = float(closed_loops(mpc, rounded, self._starts, plan.n_steps).cost().mean())
            if cost < least or not np.isfinite(least):
                best, least = rounded, cost
            if last:
                break
            share = plan.n_labels * (1.0 - _FIRST) / max(plan.rounds - 1, 1)
            gone = self._loops(network, round(share), 2 * _POLICY_NOISE, network).near(network.mean, network.spread)
            more = self._solved(gone)
            states, actions = (np.concatenate(pair) for pair in zip((states, actions), more, strict=True))
        self._bars.show("fitting", plan.rounds, plan.rounds)
        return best, self._n_solved

    def _loops(self, act: Any, count: int, noise: float = 0.0, network: PolicyNetwork | None = None) -> Loops:
        """Loops of about so many steps in all, from random starts; noise in units of the inputs."""
        n = max(1, round(count / self._plan.n_steps))
        again = n > len(self._starts)
        rows = self._rng.choice(len(self._starts), size=n, replace=again)
        size = 0.0 if network is None else noise * network.unit
        rng = None if network is None else self._rng
        return closed_loops(self._mpc, act, self._starts[rows], self._plan.n_steps, noise=size, rng=rng)

    def _solved(self, states: Array) -> tuple[Array, Array]:
        if not len(states):
            return states, np.zeros((0, self._mpc.nu))
        before, total = self._n_solved, max(self._plan.n_labels, self._n_solved + len(states))

        def told(count: int) -> None:
            self._n_solved += count
            self._bars.show("solving MPCs", self._n_solved, total)

        kept, actions = solved(self._teacher.solver, states, told)
        if not before and 2 * len(kept) < len(states):
            raise MPCOfflineError(
                "policy", expected="an MPC that is solved where it goes", actual=f"{len(kept)} of {len(states)} solved"
            )
        return kept, actions


def _checked(policy: Any) -> Any:
    """The MPC of a policy whose inputs are a function of its MPC's state."""
    if hasattr(policy, "observer"):
        raise InvalidArgumentError(
            "policy",
            expected="an MPC that sees the plant's states",
            actual="one behind an observer, whose estimate is no function of the observation",
            hint="Distil the MPC within, policy.policy, and give it the observer's estimates.",
        )
    if not hasattr(policy, "mpc") or not hasattr(policy, "solver"):
        raise InvalidArgumentError("policy", expected="an MPCPolicy", actual=type(policy).__name__)
    return policy.mpc


def _plan(
    nz: int,
    nu: int,
    horizon: int,
    hidden: Sequence[int] | None,
    budget: int,
    n_steps: int | None,
    n_labels: int,
    rounds: int,
    seed: int,
    effort: float,
) -> _Plan:
    length = _HORIZONS * horizon if n_steps is None else n_steps
    check_integers(1, multiply_adds=budget, n_steps=length, n_labels=n_labels, rounds=rounds)
    check_number("effort", effort, 0.0)
    widths = widths_within(budget, nz, nu) if hidden is None else tuple(hidden)
    if not widths:
        raise InvalidArgumentError("hidden", expected="the width of at least one layer", actual="none")
    check_integers(1, **{f"hidden[{i}]": width for i, width in enumerate(widths)})
    if (found := count_multiply_adds(nz, nu, widths)) > budget:
        raise InvalidArgumentError("hidden", expected=f"at most {budget} multiply-adds", actual=f"{found}")
    return _Plan(widths, int(length), int(n_labels), int(rounds), checked_seed("seed", seed), float(effort))


def _starts(policy: Teacher, given: Any, env: Any, rng: np.random.Generator) -> Array:
    """Observations from which loops begin, ``(n, ny)`` or ``(n, n_states)``."""
    if given is None and env is None:
        raise InvalidArgumentError("starts", expected="observations, a log, or an environment", actual="none of them")
    if given is None:
        made = gym.make(env) if isinstance(env, str) else env
        first, *more = (int(seed) for seed in rng.integers(2**31, size=_STARTS))
        found = np.array([made.reset(seed=first)[0], *(made.reset(seed=each)[0] for each in more)], dtype=np.float64)
        if made is not env:
            made.close()
    elif isinstance(given, str) or hasattr(given, "iterate_episodes") or isinstance(given, TransitionTable):
        table = TransitionTable.of(given)
        begins = rng.permutation(table.episodes.firsts)[: _STARTS // 2]
        others = rng.integers(len(table), size=_STARTS - len(begins))
        found = np.asarray(table.observations[np.concatenate([begins, others])], dtype=np.float64)
    else:
        found = np.atleast_2d(np.array(given, dtype=np.float64))
    layout = policy.mpc.layout
    if found.ndim != 2 or found.shape[1] not in (layout.ny, layout.n_states) or not np.isfinite(found).all():
        raise InvalidArgumentError(
            "starts", expected=f"finite numbers of shape (n, {layout.ny})", actual=f"shape {found.shape}"
        )
    return rng.permutation(found)


def _parted(states: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Starts to learn from, and others to judge by; all to both where they are few."""
    n = len(states)
    if n < _FEW:
        return states, states
    kept = min(round(_JUDGED * n), _EPISODES)
    return states[kept:], states[:kept]


def _report(teacher: Teacher, network: PolicyNetwork, starts: Array, plan: _Plan, n_solved: int) -> DistillationReport:
    """Both in closed loop on the model."""
    mpc = teacher.mpc
    theirs = closed_loops(mpc, mpc_acting(teacher), starts, plan.n_steps)
    ours = closed_loops(mpc, network, starts, plan.n_steps)
    states, actions = theirs.rows()
    error = np.sqrt(np.mean(((network(states) - actions) / network.unit) ** 2, axis=0))
    least = min(loops.costs[np.isfinite(loops.costs)].min(initial=np.inf) for loops in (ours, theirs))
    floor = float(least) * plan.n_steps if np.isfinite(least) else 0.0
    comparison = Comparison.of(ours.cost(), theirs.cost(), plan.n_steps, floor)
    return DistillationReport(
        multiply_adds=network.multiply_adds,
        n_labels=n_solved,
        fit_error=tuple(error.tolist()),
        model=comparison,
        env=None,
        dt=float(mpc.model.dt),
        discount=float(mpc.discount),
        seed=plan.seed,
    )


def _made(policy: Teacher, network: PolicyNetwork, report: DistillationReport) -> DistilledPolicy:
    layout = policy.mpc.layout
    return DistilledPolicy(
        network,
        policy.observation_space,
        policy.action_space,
        usual_memory=layout.filled(policy.mpc.usual_input),
        memory_sources=layout.memory_sources.tolist(),
        y_labels=layout.y_labels,
        u_labels=layout.u_labels,
        memory_names=layout.names,
        report=report,
    )


def _with_env(policy: DistilledPolicy, teacher: Teacher, env: Any, seed: int) -> DistillationReport:
    """The report with both in an environment."""
    acting: tuple[Any, Any] = policy, teacher
    ours, theirs = (evaluate(each, env, _EPISODES, seed) for each in acting)
    comparison = Comparison.of(ours.cost, theirs.cost, round(float(theirs.length.mean())))
    return replace(policy.report, env=comparison)
