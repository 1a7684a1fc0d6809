"""A trial of a proposal: what the models of the log before predict for it, and what was seen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, Sensors
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learning.known_cost import as_logged, identify_as_logged
from mpcoffline.mpc import MPC
from mpcoffline.simulation.behaviour import Behaviour, agreement, stretches
from mpcoffline.simulation.choice import FIRST
from mpcoffline.simulation.episodes import Controller
from mpcoffline.simulation.quick import are_slow, quick_policy
from mpcoffline.simulation.starts import cheapest_step, returns_along, signals_along
from mpcoffline.simulation.surroundings import surroundings_of
from mpcoffline.simulation.trials import Surroundings

from .differences import SURE, outvoted

TRIED, TODAY = "the controller of the trial", "today's controller (clone)"
_WINDOWS, _LOOPS = 32, 96  # stretches of the trial, closed loops on a model in all
_FEW_LOOPS = 8  # where solves are slow
_TRIAL = 2_000  # added to the seed
_FAR = 2.0  # half widths of the band from its middle
_DECIDED, _ROWS, _RUN = 0.05, 300, 25  # of an input's range; rows that are looked at, and how many in a row

Band = tuple[float, float, float]


@dataclass(frozen=True)
class Calibration:
    """Predicted and seen cost of a trial.

    Attributes:
        steps: Length of the stretches of the trial that were compared.
        stretches: How many there are.
        seen: Their mean cost.
        predicted: Lowest, middle and highest mean cost that the models of the log before let expect from the same
            starts, under the same signals, for the controller of the trial, MPC_1 and a clone of today's.
        promised: What the verdict expected from the starts of its own log, in as many steps; None where it had none.
        models: How many models were asked.
        others: Share of the rows of the trial in which another input was applied than the controller decides.
        widened: How many times as wide as the models alone say the bands are, since trials before lay outside theirs.
    """

    steps: int
    stretches: int
    seen: float
    predicted: Mapping[str, Band]
    promised: Band | None
    models: int
    others: float = 0.0
    widened: float = 1.0

    @property
    def band(self) -> Band:
        """What was predicted for the controller of the trial."""
        return self.predicted[TRIED]

    @property
    def known(self) -> bool:
        """Whether anything was predicted."""
        return bool(np.isfinite(self.band).all())

    @property
    def off(self) -> float:
        """Seen minus predicted, in half widths of the band on that side of its middle: beyond 1 is outside."""
        low, middle, high = self.band
        width = high - middle if self.seen >= middle else middle - low
        return float((self.seen - middle) / width) if width > 0.0 else float(np.sign(self.seen - middle) * np.inf)

    @property
    def inside(self) -> bool:
        """Whether what was seen lies in the band."""
        return self.known and self.band[0] <= self.seen <= self.band[2]

    @property
    def far(self) -> bool:
        """Whether it lies far outside."""
        return self.known and not self.inside and abs(self.off) > _FAR

    @property
    def sentences(self) -> tuple[str, ...]:
        """What came of it and what that means, the first one in short."""
        if not self.known:
            return ("Nothing was predicted: no model of the log before predicts it. What was seen stands alone.",)
        low, middle, high = self.band
        head = (
            f"The trial cost {figure(self.seen, 4)} in {self.steps} steps (mean of {self.stretches}); predicted were"
            f" {figure(middle, 4)}, {figure(low, 4)} to {figure(high, 4)}:"
        )
        difference = f"{figure(abs(self.seen - middle))} {'more' if self.seen > middle else 'less'} than the middle"
        if self.inside:
            found = [f"{head} inside the band, {difference}. The models told what this controller does on the plant."]
        elif not self.far:
            found = [
                f"{head} outside the band, {difference}. Take the verdict's figures as that much less certain; the fit"
                " below knows the trial."
            ]
        elif self.seen > middle:
            found = [
                f"{head} FAR OUTSIDE the band, {difference}. What the verdict promised does not hold on this plant: its"
                " models do not know what the controller met.",
                "Before anything else, look for what differs: an input that is not applied as it is logged (another"
                " loop, a rate, a limit, a unit, a sign), a plant or load that has changed since the log, a"
                " disturbance that nobody measures. The fit below knows the trial; go back to what ran before until a"
                " further short trial lies inside its band.",
            ]
        else:
            found = [
                f"{head} FAR OUTSIDE the band, {difference}: cheaper than the models can explain. The trial was easier"
                " than the log (less disturbed, another load), or one of both logs is not what it seems: do not"
                " count on it to stay so."
            ]
        return (*found, *self._against_today(), *self._of_others())

    def _against_today(self) -> tuple[str, ...]:
        if TODAY not in self.predicted or not np.isfinite(self.predicted[TODAY]).all():
            return ()
        low, _, high = self.predicted[TODAY]
        where = "less" if self.seen < low else "more" if self.seen > high else "neither clearly less nor more"
        span = f"{figure(low, 4)} to {figure(high, 4)}"
        return (f"That is {where} than today's controller costs there on the models, {span}.",)

    def _of_others(self) -> tuple[str, ...]:
        if self.others <= _DECIDED:
            return ()
        return (
            f"In {self.others:.0%} of the trial's rows another input was applied than the controller decides there: by"
            " hand, by a fall-back, while it took over, or because it is another controller. Say which rows count"
            " (--where), if it was not in charge.",
        )

    @property
    def table(self) -> Table:
        """Predicted and seen, a row each."""
        shown = {"expected by the verdict, from its own log": self.promised} if self.promised is not None else {}
        rows = [(name, *(figure(v, 4) for v in band)) for name, band in shown.items() if band is not None]
        rows += [(f"predicted here: {name}", *(figure(v, 4) for v in band)) for name, band in self.predicted.items()]
        rows.insert(1 + len(shown), ("seen in the trial", "", f"{figure(self.seen, 4)}", ""))
        title = f"Cost in {self.steps} steps, mean of {self.stretches} stretches of the trial"
        return Table(("", "lowest", "middle", "highest"), rows, title, "lr")

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`.

        Raises:
            KeyError: For a part that is missing.
            TypeError: For a part of another kind.
            ValueError: Likewise.
        """
        promised = None if data["promised"] is None else _numbers(data["promised"])
        predicted = {str(name): _numbers(band) for name, band in data["predicted"].items()}
        counts = int(data["steps"]), int(data["stretches"])
        shares = float(data["others"]), float(data.get("widened", 1.0))
        return cls(*counts, float(data["seen"]), predicted, promised, int(data["models"]), *shares)

    def to_json(self) -> dict[str, Any]:
        """For files."""
        return asdict(self) | {"inside": self.inside, "off": self.off if self.known else None, "far": self.far}


def _numbers(data: Any) -> Band:
    """Three numbers; null is none that is known."""
    low, middle, high = (float("nan") if value is None else float(value) for value in data)
    return low, middle, high


def compared(
    learner: OfflineMPCLearner,
    running: MPC,
    log: TransitionTable,
    trial: TransitionTable,
    *,
    expected: tuple[Band, int] | None = None,
    today: int | None = None,
    seed: int = 0,
    widened: float = 1.0,
) -> Calibration:
    """Predicts what a trial costs by models of the log before it, and compares with what was seen.

    Each stretch of the trial is simulated from its first state, under its signals, on every model that predicts the log
    (:class:`~mpcoffline.simulation.models.LogModels`), under disturbances drawn from the log. The band holds all models
    but one, and two standard deviations of what disturbances, and the sensors' noise in the first state, make of the
    mean; by how much the models are off for the log's own controller widens it to that side. It does not reach below
    what the cheapest step, logged or simulated, would cost so many times.

    Args:
        learner: What was learned before the trial.
        running: The controller of the trial.
        log: What it was learned from.
        trial: The trial, in the columns of the log.
        expected: What the verdict expected, and in how many steps.
        today: How many episodes of the log, the first ones, today's controller made; all by default.
        seed: Of models, stretches and disturbances.
        widened: How many times as wide the bands become: what :func:`widening` says of trials before.

    Raises:
        InvalidDataError: If the trial has no stretch of which all is known, or other columns.
    """
    learned, given = learner.mpc, learner.nominal_mpc
    trial.check_fits(given.ny, given.nu)
    layout, nominal = learned.layout, given.with_delay(learned.layout.delay)
    table, tried = with_memory(log, layout), with_memory(trial, layout)
    known = None if learner.result is None else learner.result.cost
    rows = as_logged(learned, table, known)
    found, clean = identify_as_logged(nominal, table, rows, seed=seed, start=learner.start)
    policies = {TRIED: quick_policy(running), FIRST: quick_policy(given)}
    slow = are_slow(policies.values())
    around, starts = _surroundings(
        learned, given, (log, table, clean), tried, found, slow, seed + _TRIAL, sensors=learner.sensors
    )
    own = np.ones(len(table), dtype=bool) if today is None else np.asarray(table.episode_ids) < today
    clone = Behaviour.of(table.take(np.flatnonzero(own)) if own.any() else table, layout, seed)
    n, votes, steps = len(starts), around.models.votes, around.n_steps
    controllers: dict[str, Controller] = {name: around.seeing(policy) for name, policy in policies.items()}
    controllers[TODAY] = clone
    levels = _levels(around, clone, table, votes, own)
    done = dict(zip(controllers, around.act(list(controllers.values())), strict=True))
    floor = steps * min(
        cheapest_step(tried), around.least, *(float(each.least[votes].min(initial=np.inf)) for each in done.values())
    )
    predicted = {
        name: stretched(_band(episodes.cost[votes].reshape(int(votes.sum()), -1, n), levels), widened, floor)
        for name, episodes in done.items()
    }
    seen = float(np.mean(returns_along(tried, starts, steps)))
    promised = None
    if expected is not None and np.isfinite(expected[0]).all():
        low, middle, high = (float(v) * steps / expected[1] for v in expected[0])
        promised = low, middle, high
    others = 0.0 if learner.sensors is not None else _others(running, tried)  # what was estimated then nobody logged
    return Calibration(steps, n, seen, predicted, promised, int(votes.sum()), others, widened)


def widening(trials: Iterable[tuple[float | None, float]]) -> float:
    """How many times as wide as the models alone say a band has to be, after some trials; at least 1.

    ::

        w = max(1, sqrt(mean_i (o_i w_i)^2))

    with o_i how far trial i lay from the middle of its band, in half widths, and w_i how many times as wide that was.

    Args:
        trials: o_i and w_i of each, as :attr:`Calibration.off` and :attr:`Calibration.widened`; None, and what is not
            finite, tells nothing.
    """
    off = np.array([o * w for o, w in trials if o is not None and np.isfinite(o)])
    return max(1.0, float(np.sqrt(np.mean(off**2)))) if len(off) else 1.0


def stretched(band: Band, factor: float, floor: float = -np.inf) -> Band:
    """A band so many times as wide, to either side of its middle, but not below what can be."""
    low, middle, high = band
    return float(np.maximum(middle - factor * (middle - low), floor)), middle, middle + factor * (high - middle)


def _surroundings(
    learned: MPC,
    given: MPC,
    logs: tuple[TransitionTable, TransitionTable, TransitionTable],
    tried: TransitionTable,
    found: Identification,
    slow: bool,
    seed: int,
    sensors: Sensors | None,
) -> tuple[Surroundings, NDArray[np.intp]]:
    """Models of the log, begun where stretches of the trial do, several times each; and where these begin.

    ``logs`` are the log, the same with past inputs, and that without measurement noise.
    """
    log, table, clean = logs
    loops = _FEW_LOOPS if slow else _LOOPS
    usual = surroundings_of(learned, given, log, found, are_slow=lambda: slow, n_starts=1, seed=seed, sensors=sensors)
    rng, longest = np.random.default_rng(seed), int(table.episodes.lengths.max())
    steps = min(usual.n_steps + usual.n_before, longest, int(tried.episodes.lengths.max()))
    starts = _stretches(tried, steps, min(_WINDOWS, loops // 2))
    times = max(2, loops // len(starts))
    _, firsts, lengths = table.episodes
    whole = np.concatenate([np.arange(a, a + n - steps + 1) for a, n in zip(firsts, lengths, strict=True)])
    rows = rng.choice(whole, size=times * len(starts), replace=len(whole) < times * len(starts))
    around = Surroundings(
        usual.models, usual.cost, clean, rows, steps, learned.layout, seed, logged=table, sensors=sensors
    )
    states = np.tile(tried.values().observations[starts], (times, 1))
    n, noise = learned.layout.n_states, usual.models.noise  # of the sensors: where a stretch began is not known exactly
    states[:, :n] += noise * rng.standard_normal((len(states), n))
    signals = signals_along(tried, starts, steps, learned.layout)
    at_work = np.tile(~np.isin(starts, tried.episodes.firsts), times)
    return around.begun_at(states, np.tile(signals, (times, 1, 1)), at_work), starts


def _stretches(trial: TransitionTable, steps: int, most: int) -> NDArray[np.intp]:
    """Where stretches of that length begin, one after the other, no more than a number of them."""
    _, firsts, lengths = trial.episodes
    every = np.concatenate([np.arange(a, a + n - steps + 1, steps) for a, n in zip(firsts, lengths, strict=True)])
    if not len(every):
        raise InvalidDataError(trial.name, expected=f"{steps} steps without a gap", actual=f"at most {lengths.max()}")
    return np.asarray(every[np.unique(np.linspace(0, len(every) - 1, min(most, len(every))).round().astype(np.intp))])


def _levels(
    around: Surroundings, clone: Behaviour, table: TransitionTable, votes: NDArray[np.bool_], own: NDArray[np.bool_]
) -> float:
    """By how much models exceed what the log cost under its own controller, in as many steps; 0 where unknown."""
    rows = around.rows[own[around.rows]]
    _, whole = stretches(table, rows, around.n_steps)
    if not votes.any() or not len(rows) or not whole.all():
        return 0.0
    acting = clone.replaying(clone.deviations(table, rows, around.n_steps))
    found = agreement(around.models, around.cost, table, acting, rows, around.n_steps, around.cost.ends.paid)
    return float(np.median((found.simulated - found.logged).mean(axis=1)[votes]))


def _band(costs: Array, level: float) -> Band:
    """Lowest, middle and highest mean of a trial, from costs ``(models, repetitions, stretches)``."""
    trials = costs.mean(axis=2)
    means, doubt = trials.mean(axis=1), SURE * trials.std(axis=1, ddof=1)
    if not len(means) or not np.isfinite(means).any():
        return np.nan, np.nan, np.nan
    order, out = np.sort(means), outvoted(len(means))
    kept, width = order[out : len(order) - out], float(np.median(doubt))
    ends = float(kept[0]) - width, float(kept[-1]) + width
    return ends[0] - max(level, 0.0), float(np.median(order)), ends[1] - min(level, 0.0)


def _others(running: MPC, trial: TransitionTable) -> float:
    """In which share of some rows another input was applied than a controller decides.

    Of several plans that are as good it takes the one near that of the step before, so that stretches are gone through
    from their beginning; a row counts where its input is neither that of a plan from there nor one's from nowhere.
    """
    if running.nx != trial.ny:
        return 0.0
    _, firsts, lengths = trial.episodes
    n = min(int(np.median(lengths)), max(_RUN, _ROWS // len(lengths)))
    begins, solver = firsts[lengths >= n][: max(1, _ROWS // n)], quick_policy(running).solver
    columns, others, plan = trial.values(), list[int](), None
    width = np.ptp(columns.actions, axis=0)

    def far(decided: Array, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        missed = np.abs(columns.actions[rows] - decided) > _DECIDED * np.where(width > 0.0, width, np.inf)
        return np.asarray(missed.any(axis=1))

    for rows in (begins + k for k in range(n)):
        found = solver.solve(columns.observations[rows], warm_start=plan)
        plan, left = found.plan.shifted(running), rows[far(found.u0, rows)]
        if len(left):
            left = left[far(solver.solve(columns.observations[left]).u0, left)]
        others.append(len(left))
    return float(np.mean(others)) / len(begins)
