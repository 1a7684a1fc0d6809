"""Plants of which half of the states are hidden, and the rest is measured with noise: what is learned from outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.tables import Table
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Sensors, identify_from_outputs
from mpcoffline.learner.effort import core_seconds
from mpcoffline.learner.learner import Learn, OfflineMPCLearner
from mpcoffline.mpc import MPC

from .plant_files import Loops, PlantFile
from .zoo import MARGIN, NAN, Case, Found, heard, noted, paired, short_text

NOISE = 0.02  # of an output's spread in the log
NEAR = 0.1  # of |yardstick|, by which what is learned may cost more
_LEAST_SPREAD = 0.05  # of a state's spread in the log: how well starts are known at best
_MISSED = (0.01, 0.1)  # of what states move in a step: how far a rough model may be taken to be off
_HORIZON = 100  # steps, in which an observer settles
_SEED = 23


@dataclass(frozen=True)
class Outcome:
    """What came of a case; a line of the results. Costs are means over the starts, NaN where there is none.

    Attributes:
        plant: Name of the plant.
        seed: The seed.
        starts: Number of episodes of each controller, from the same starts.
        shown: Places of the states that are measured, of how many.
        mpc_1: Cost of the rough MPC behind an observer.
        yardstick: Cost of the plant file's best MPC behind an observer with the noise as identified.
        learned: Cost of the learned MPC behind its own.
        gain: learned - MPC_1: mean of the differences, start by start.
        gain_error: Its standard error.
        short: learned - yardstick, likewise.
        short_error: Its standard error.
        identify_s: Time of the identification in s of one core.
        fit_s: That of the fit and the choice.
        candidate: What the learner handed out.
        verdict: That of ``diagnose``, whose simulations have the observer, too.
        reason: Its first reason.
        expected: What it expects an episode to cost.
        undetermined: Of what the log hardly says anything.
        said: Warnings.
        error: What went wrong; such a case is tried again.
    """

    plant: str
    seed: int
    starts: int
    shown: str = ""
    mpc_1: float = NAN
    yardstick: float = NAN
    learned: float = NAN
    gain: float = NAN
    gain_error: float = NAN
    short: float = NAN
    short_error: float = NAN
    identify_s: float = NAN
    fit_s: float = NAN
    candidate: str = ""
    verdict: str = ""
    reason: str = ""
    expected: float = NAN
    undetermined: str = ""
    said: str = ""
    error: str = ""

    @property
    def key(self) -> tuple[str, int, int]:
        """That of its case."""
        return self.plant, self.seed, self.starts

    @property
    def near(self) -> bool:
        """Whether it costs at most as much as the yardstick and 10 % of its size."""
        return self.short <= NEAR * abs(self.yardstick)

    @property
    def worse(self) -> bool:
        """Whether it costs more than MPC_1, by more than 2 % of its size; so does one without a cost."""
        return not self.gain <= MARGIN * abs(self.mpc_1)

    def __str__(self) -> str:
        """In short."""
        return self.error or (
            f"{self.shown}; MPC_1 {self.mpc_1:.5g}, yardstick {self.yardstick:.5g}, learned {self.learned:.5g}"
            f" ({self.gain:+.3g} +- {self.gain_error:.2g}), {self.identify_s:.0f} + {self.fit_s:.0f} s"
        )


def run_case(case: Case, tell: Callable[[str], None] = lambda what: None) -> Outcome:
    """Hides states, identifies and learns from the rest, and lets all act behind observers; errors become part of it.

    Args:
        case: The case.
        tell: Is told what is being done.
    """
    found: Found = {}
    noted(found, lambda: _fill(found, case, tell))
    return Outcome(case.plant, case.seed, case.n_starts, **found)


def _fill(found: Found, case: Case, tell: Callable[[str], None]) -> None:
    """The figures of a case, each put down as soon as it is known."""
    from mpcoffline.diagnostics import diagnose

    tell("log")
    plant = PlantFile.load(Path(case.path))
    log, seed, nominal = plant.log(case.seed), case.seed, plant.module.mpc(case.seed)
    n = nominal.layout.n_states
    states = log.values().observations[:, :n]
    places = list(getattr(plant.module, "OUTPUTS", None) or shown_states(nominal, log))
    found["shown"] = f"{', '.join(map(str, places))} of {n}"
    noise = NOISE * states[:, places].std(axis=0)
    first = states[log.episodes.firsts]
    spread = np.maximum(first.std(axis=0), _LEAST_SPREAD * states.std(axis=0))

    def loops(mpc: MPC, sensors: Sensors) -> Loops:
        policy = OutputFeedbackPolicy(MPCPolicy(mpc), sensors.observer(mpc))
        return plant.closed_loops(_Behind(policy, places, n, noise, seed), seed, case.n_starts)

    tell("identification from outputs")
    said: list[str] = []
    learn: Learn = getattr(plant.module, "LEARN", "cost+model")
    learner = OfflineMPCLearner(nominal, learn=learn, seed=seed)
    begun = core_seconds()
    seen = with_outputs(log, places, n, noise, seed)
    with heard(said):
        told = identify_from_outputs(nominal, seen, places, start=first.mean(axis=0), start_spread=spread, seed=seed)
        found["identify_s"], begun = core_seconds() - begun, core_seconds()
        tell(f"fit of {len(log)} transitions")
        learner.fit(told, show_progress=False)
    found["fit_s"] = core_seconds() - begun
    found["undetermined"], found["said"] = ", ".join(told.sensors.undetermined), short_text("; ".join(said))
    tell("closed loops")
    rough = [told.sensors, told.sensors.suited(nominal, told.table)]
    rough += [replace(told.sensors, process=p) for p in _processes(log, n)]
    starts = min((loops(nominal, sensors) for sensors in rough), key=lambda done: _total(done.cost))
    learned, truth = loops(learner.mpc, learner.sensors or told.sensors), plant.module.truth()
    found["mpc_1"], found["learned"] = float(starts.cost.mean()), float(learned.cost.mean())
    found["gain"], found["gain_error"] = paired(learned.cost, starts.cost)
    if truth is not None:
        best = loops(truth, told.sensors)
        found["yardstick"] = float(best.cost.mean())
        found["short"], found["short_error"] = paired(learned.cost, best.cost)
    found["candidate"] = "" if learner.candidates is None else learner.candidates.chosen
    tell("verdict")
    report = diagnose(learner, told, seed=seed)
    found["verdict"], found["reason"] = report.verdict, short_text(report.reasons[0] if report.reasons else "")
    found["expected"] = report.judgement.expected[1]


def _total(cost: Array) -> float:
    return float(np.nan_to_num(cost, nan=np.inf).mean())


def _processes(log: TransitionTable, n: int) -> list[Array]:
    """What an engineer would take a rough model to miss."""
    columns = log.values()
    moved = (columns.next_observations - columns.observations)[:, :n].std(axis=0)
    return [share * moved for share in _MISSED]


def shown_states(mpc: MPC, log: TransitionTable) -> list[int]:
    """Half of the states, rounded up: one after the other, that from which a rough model tells most of the rest.

    By how much a Kalman filter, linearised where the log is on average, leaves unknown of all states, in their spreads
    in the log, when it has settled.
    """
    n, columns = mpc.layout.n_states, log.values()
    s, a = columns.observations, columns.actions
    spread = np.maximum(s[:, :n].std(axis=0), np.finfo(np.float64).tiny)
    x = np.concatenate([s.mean(axis=0), mpc.layout.filled(a.mean(axis=0)).ravel()[: mpc.nx - mpc.ny]])
    step = mpc.dynamics_function.jacobian()(x, a.mean(axis=0), mpc.theta, 0)
    F = np.array(step[0] if isinstance(step, tuple) else step)[:n, :n] * spread / spread[:, None]
    places: list[int] = []
    while len(places) < -(-n // 2):
        places.append(min(set(range(n)) - set(places), key=lambda i: (_unknown(F, [*places, i]), i)))
    return sorted(places)


def _unknown(F: Array, places: list[int]) -> float:
    """The trace of the covariance after the last of many steps."""
    n = len(F)
    P, Q, H = np.eye(n), 1e-4 * np.eye(n), np.eye(n)[places]
    for _ in range(_HORIZON):
        P = F @ P @ F.T + Q
        gain = np.linalg.solve(H @ P @ H.T + NOISE**2 * np.eye(len(H)), H @ P).T
        P = P - gain @ H @ P
        P = 0.5 * (P + P.T) / max(1.0, float(np.trace(P)) / (1e6 * n))
    return round(float(np.trace(P)), 9)


def with_outputs(log: TransitionTable, places: Sequence[int], n: int, noise: Array, seed: int = 0) -> TransitionTable:
    """The log with some of n states, measured with noise, in place of all; a state seen twice is measured once."""
    columns, rng = log.values(), np.random.default_rng([_SEED, seed])
    before, after = (noise * rng.standard_normal((len(log), len(noise))) for _ in range(2))
    ids = np.asarray(log.episode_ids)
    same = np.flatnonzero(ids[1:] == ids[:-1])
    after[same] = before[same + 1]
    shown = [
        np.hstack([s[:, list(places)] + e, s[:, n:]])
        for s, e in ((columns.observations, before), (columns.next_observations, after))
    ]
    return TransitionTable.from_arrays(
        shown[0], columns.actions, columns.costs, shown[1], columns.terminations, log.episode_ids
    )


class _Behind(MPCPolicy):
    """What acts on outputs, on a plant that shows all states; the noise is the same for each controller."""

    def __init__(self, policy: OutputFeedbackPolicy, places: Sequence[int], n: int, noise: Array, seed: int) -> None:
        super().__init__(policy.mpc)
        self._policy, self._places, self._n, self._noise, self._seed = policy, list(places), n, noise, seed
        self._rng = np.random.default_rng([_SEED, seed, 1])

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """As the policy, with outputs of the states ``(B, n)`` with noise."""
        s = np.atleast_2d(np.asarray(observation, dtype=np.float64))
        if state is None:
            self._rng = np.random.default_rng([_SEED, self._seed, 1])
        y = s[:, self._places] + self._noise * self._rng.standard_normal((len(s), len(self._noise)))
        return self._policy.predict(np.hstack([y, s[:, self._n :]]), state, episode_start, deterministic)


def report(outcomes: Sequence[Outcome]) -> str:
    """A page in Markdown: the counts, then a line a case."""
    rows = sorted(outcomes, key=lambda o: o.key)
    done = [o for o in rows if not o.error]
    measured = [o for o in done if not np.isnan(o.yardstick)]
    lines = [
        "# Outputs: half of the states hidden",
        "",
        f"`scripts/bench_zoo --outputs`: {len(done)} cases, each a plant file and a seed. Half of the states,"
        f" rounded up, are measured, with a noise of {NOISE:.0%} of their spread; which ones says the plant file, or a"
        " rough model: those that tell most of the rest."
        " All controllers act behind extended Kalman filters. That of the yardstick, the plant file's best MPC, has the"
        " noise that was identified; MPC_1 has the best of four. Times in s of one core.",
        "",
        f"* At most {NEAR:.0%} dearer than the yardstick behind its observer: **{sum(o.near for o in measured)} of"
        f" {len(measured)}**",
        f"* Dearer than MPC_1 behind one by more than {MARGIN:.0%}: **{sum(o.worse for o in done)} of {len(done)}**;"
        f" recommended of these: **{sum(o.worse and o.verdict == 'recommend' for o in done)}**",
    ]
    lines += [f"* Failed: {o.plant} {o.seed}: {o.error}" for o in rows if o.error]
    header = ["plant", "seed", "measured states", "MPC_1", "yardstick", "learned", "over the yardstick", "handed out"]
    header += ["s", "expected", "verdict", "hardly told by the log"]
    return "\n".join([*lines, "", Table(header, [_cells(o) for o in done], align="lllrrrrlrrll").markdown(), ""])


def _cells(o: Outcome) -> list[str]:
    costs = ["-" if np.isnan(v) else f"{v:.5g}" for v in (o.mpc_1, o.yardstick, o.learned)]
    short = "-" if np.isnan(o.short) else f"{o.short:+.3g} +- {o.short_error:.2g}"
    times = f"{o.identify_s:.0f} + {o.fit_s:.0f}"
    return [
        o.plant,
        str(o.seed),
        o.shown,
        *costs,
        short,
        o.candidate,
        times,
        f"{o.expected:.5g}",
        o.verdict,
        o.undetermined,
    ]
