"""What a log and a description say of each other, before anything is fitted: one page, and whether tuning pays."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import DelaySearch, Identification, find_delays, identify
from mpcoffline.estimation.consistency import check
from mpcoffline.estimation.multi_step import Windows, open_loop
from mpcoffline.estimation.plant import plant_rows
from mpcoffline.estimation.trajectories import Trajectories
from mpcoffline.mpc import MPC
from mpcoffline.plants import Plant

from .experiment import Experiment, experiments

_ROWS = 20_000
_AHEAD = 10  # steps
_DETERMINED, _WEAK = 0.1, 0.3  # relative deviation of a parameter
_NOISY = 0.3  # of the increments' spread
_STUCK = "stuck"
_NEAR = 0.05  # of a state's spread about its goal
_WORSE = 1.5  # times the identified model's error ahead, of the described one: tuning pays
_POOR = 0.5  # of the spread, ten steps ahead
_COARSE, _FINE = 1.0, 0.002  # control intervals in time constants
_FEW = 200  # rows

Kind = Literal["problem", "advice", "good"]


@dataclass(frozen=True)
class Remark:
    """A sentence on log or description.

    Attributes:
        kind: ``"problem"``: mend it first; ``"advice"``: better with it; ``"good"``.
        about: What it is about: a section of the page.
        text: The sentence.
        forbids: Whether nothing can be fitted before it is mended.
    """

    kind: Kind
    about: str
    text: str
    forbids: bool = False

    def __str__(self) -> str:
        return self.text


@dataclass
class LogCheck:
    """What a log and a description say of each other.

    Attributes:
        head: What was read.
        remarks: What was found, problems first.
        tables: Coverage, parameters and predictions.
        identification: The model of the log; None where none could be found.
        delays: What the log says of dead time.
        experiments: What would determine the parameters that the log leaves open.
    """

    head: str = ""
    remarks: list[Remark] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    identification: Identification | None = None
    delays: DelaySearch | None = None
    experiments: dict[str, Experiment | None] = field(default_factory=dict)

    def add(self, kind: Kind, about: str, text: str, *, forbids: bool = False) -> None:
        """Enters a remark."""
        self.remarks.append(Remark(kind, about, text, forbids))

    @property
    def problems(self) -> list[Remark]:
        """What is to be mended first."""
        return [each for each in self.remarks if each.kind == "problem"]

    @property
    def verdict(self) -> str:
        """Whether tuning is worth it, in a sentence."""
        if self.problems:
            n = len(self.problems)
            return f"Not yet worth tuning: {n} {'thing is' if n == 1 else 'things are'} to be looked at first."
        gain = [each.text for each in self.remarks if each.about == "gain"]
        return " ".join(["Worth tuning.", *gain])

    def __str__(self) -> str:
        """The page."""
        lines = [self.verdict, "", self.head, ""]
        for kind, title in (("problem", "To be mended first"), ("advice", "Advice"), ("good", "Good")):
            chosen = [each for each in self.remarks if each.kind == kind and each.about != "gain"]
            if chosen:
                lines += [f"{title}:", *(f"* {each.about}: {each.text}" for each in chosen), ""]
        for table in self.tables:
            lines += [*table.lines, ""]
        return "\n".join(lines).rstrip()


def check_log(plant: Plant, table: TransitionTable, *, seed: int = 0) -> LogCheck:
    """Compares a plant's description with a log of it, before anything is fitted.

    Args:
        plant: The description.
        table: The log, as :meth:`mpcoffline.Plant.read` gives it.
        seed: Seeds the choice of rows.

    Returns:
        The page; ``print`` shows it.
    """
    mpc, found = plant.mpc(), LogCheck()
    report = getattr(table, "report", None)
    found.head = str(report) if report is not None else repr(table)
    for each in report.left_out if report is not None else ():
        if each.why.startswith(_STUCK):
            found.add("problem", each.what, f"{each.why}, {each.count} rows from {each.first} on: is its sensor well?")
    findings = check(mpc, table)
    for finding in findings.findings:
        found.add("problem", "description and data", str(finding), forbids=finding in findings.errors)
    if (table.ny, table.nu) == (mpc.ny, mpc.nu):
        _coverage(plant, table, found)
    if findings.errors:
        return found
    with _quiet():
        try:
            mpc = _dead_time(plant, mpc, table, found, seed)
            found.identification = identify(mpc, table, seed=seed)
        except InvalidDataError as error:
            found.add("problem", "identification", str(error), forbids=True)
            return found
    _parameters(plant, mpc, table, found)
    _noise(plant, found)
    _sampling(plant, mpc, table, found)
    _predictions(plant, mpc, table, found, seed)
    _goal(plant, mpc, table, found)
    found.remarks.sort(key=lambda each: ("problem", "advice", "good").index(each.kind))
    return found


@contextmanager
def _quiet() -> Iterator[None]:
    """What the steps would log stands on the page."""
    logger = logging.getLogger("mpcoffline")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _coverage(plant: Plant, table: TransitionTable, found: LogCheck) -> None:
    """What ranges the log covers."""
    statistics = table.statistics()
    labels = plant.mpc().layout
    low = np.append(statistics.low.observations, statistics.low.actions)
    high = np.append(statistics.high.observations, statistics.high.actions)
    spread = np.append(statistics.std.observations, statistics.std.actions)
    rows = []
    columns = [*labels.y_labels, *labels.u_labels]
    quantities: tuple[Any, ...] = (*plant.states, *plant.inputs, *plant.signals)
    ranges = {q.name: (q.low, q.high) for q in quantities}
    for label, a, b, s in zip(columns, low, high, spread, strict=True):
        least, most = ranges.get(label.name, (-np.inf, np.inf))
        share = f"{(b - a) / (most - least):.0%}" if np.isfinite(most - least) else ""
        rows.append((str(label), f"{a:.4g}", f"{b:.4g}", f"{s:.3g}", share))
    header = ("quantity", "least", "most", "spread", "of its range")
    found.tables.append(Table(header, rows, title="What the log covers", align="lr"))
    actions = table.actions
    for j, each in enumerate(plant.inputs):
        ends = np.mean((actions[:, j] <= each.low) | (actions[:, j] >= each.high))
        if ends > 0.5:
            text = f"{each.name} is at its bounds in {ends:.0%} of the rows: little is learned of what lies between"
            found.add("advice", "inputs", text)
    if len(table) < _FEW:
        found.add("advice", "length", f"{len(table)} control intervals are few: {_FEW} or more tell noise from motion")


def _dead_time(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck, seed: int) -> MPC:
    """The MPC with the dead time that the log shows."""
    found.delays = delays = find_delays(mpc, table, seed=seed)
    if not delays.found:
        if any(delays.longest):
            found.add("good", "dead time", "none beside the described one" if any(delays.given) else "none")
        return mpc
    for each, d, given in zip(plant.inputs, delays.delay, delays.given, strict=True):
        if d != given:
            more = f"; described are {given}" if each.delay is not None else ""
            text = (
                f"{each.name} acts {d} {'step' if d == 1 else 'steps'} late{more}: one-step errors are"
                f" {delays.gain:.2g} times those without. Write delay={d} into the plant file"
            )
            kind: Kind = "advice" if each.delay is None else "problem"
            found.add(kind, "dead time", text)
    return mpc.with_delay(delays.delay)


def _parameters(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
    """Which parameters the log determines, and what would determine the others."""
    identified = found.identification
    if identified is None or not plant.parameters:
        return
    n = mpc.model.space.size
    values, deviations = identified.theta[:n], identified.deviation[:n]
    rows, open_ones = [], []
    left_open = " ".join(identified.undetermined)
    for name, before, value, deviation in zip(
        mpc.model.space.names, mpc.model.space.theta, values, deviations, strict=True
    ):
        relative = deviation / abs(value) if value else np.inf
        in_doubt = f"model.{name}" in left_open.split() or deviation == 0.0
        word = "no" if in_doubt or relative > _WEAK else "weakly" if relative > _DETERMINED else "yes"
        if f"model.{name}" in identified.at_bound:
            word = f"{word}, at its bound"
        rows.append((name, plant.parameters[name].unit, f"{before:.4g}", f"{value:.4g}", f"{deviation:.2g}", word))
        if not word.startswith("yes"):
            open_ones.append(name)
    header = ("parameter", "unit", "described", "in the log", "+-", "determined")
    found.tables.append(Table(header, rows, title="Parameters", align="llrrrl"))
    for name in identified.at_bound:
        if not found.problems:
            found.add("advice", "parameters", f"{name.removeprefix('model.')} ends at its bound: is the bound right?")
    if not open_ones:
        found.add("good", "parameters", f"the log determines all {n}")
        return
    model = mpc.with_theta(identified.theta)
    rows_of = plant_rows(mpc, table).sample(5_000, 0).values()
    signals = rows_of.actions[:, len(plant.inputs) :].mean(axis=0)
    about = np.append(np.median(rows_of.observations, axis=0), signals)
    least = 1e-3 * np.where(rows_of.observations.std(axis=0) > 0.0, rows_of.observations.std(axis=0), 1.0)
    noise = np.maximum(identified.noise.measurement, least)
    taus = _time_constants(model, rows_of.observations, rows_of.actions)
    hold = int(np.clip(round(0.5 * float(np.median(taus)) / plant.dt), 1, 25)) if len(taus) else 2
    found.experiments = experiments(model, open_ones, about, noise, hold)
    weak = all(row[-1] == "weakly" for row in rows if row[0] in open_ones)
    for name in open_ones:
        explained = any(each.about == "description and data" for each in found.problems)
        found.add(
            "advice" if weak or explained else "problem", "excitation", _asked(plant, name, found.experiments[name])
        )


def _asked(plant: Plant, name: str, experiment: Experiment | None) -> str:
    """What to record for a parameter."""
    begin = f"the log does not determine {name}"
    if experiment is None:
        return f"{begin}, and no test of the inputs alone would: write its number into the equations, or vary the start"
    each = plant.inputs[experiment.input]
    minutes = experiment.steps * plant.dt / 60.0
    length = f"{minutes:.0f} minutes" if minutes >= 2.0 else f"{60 * minutes:.0f} s"
    return (
        f"{begin}: move {each.name} at random between two values {2 * experiment.amplitude:.3g} {each.unit} apart, each"
        f" kept for {experiment.hold * plant.dt:g} s or longer, for about {length}"
    )


def _noise(plant: Plant, found: LogCheck) -> None:
    """How noisy the measurements are."""
    identified = found.identification
    if identified is None:
        return
    noise = identified.noise
    parts = [f"{q.name} {v:.2g} {q.unit}".rstrip() for q, v in zip(plant.states, noise.measurement, strict=True)]
    found.add("good", "noise", f"of the measurements, standard deviation: {', '.join(parts)}")
    if noise.increments is None:
        return
    for q, v, motion in zip(plant.states, noise.measurement, noise.increments, strict=True):
        if motion > 0.0 and v > motion * _NOISY * 3.0:
            text = f"{q.name} moves less in a control interval than its noise: what is learned of it rests on averages"
            found.add("advice", "noise", text)


def _time_constants(mpc: MPC, x: Array, u: Array) -> Array:
    """Time constants of the model about the middle of the log, in s."""
    n = mpc.layout.n_states
    plant = mpc.plant_function
    middle, inputs = np.median(x, axis=0)[:n], np.median(u, axis=0)
    size = 1e-4 * np.where(x[:, :n].std(axis=0) > 0.0, x[:, :n].std(axis=0), 1.0)
    columns = [
        (plant(middle + e, inputs, mpc.theta).full().ravel() - plant(middle - e, inputs, mpc.theta).full().ravel())
        for e in np.diag(size)
    ]
    slopes = np.stack(columns, axis=1) / (2.0 * size)
    if not np.isfinite(slopes).all():
        return np.zeros(0)
    sizes = np.abs(np.linalg.eigvals(slopes))
    moving = (sizes > 1e-12) & (np.abs(np.log(np.maximum(sizes, 1e-300))) > 1e-6)
    return np.asarray(mpc.model.dt / np.abs(np.log(sizes[moving])))


def _sampling(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
    """The control interval against the time constants."""
    identified = found.identification
    if identified is None:
        return
    rows = plant_rows(mpc, table).sample(5_000, 0).values()
    taus = np.sort(_time_constants(mpc.with_theta(identified.theta), rows.observations, rows.actions))
    if not len(taus):
        return
    listed = ", ".join(f"{tau:.3g}" for tau in taus)
    text = f"time constants about {listed} s, control interval {plant.dt:g} s"
    if plant.dt > _COARSE * taus[-1]:
        found.add("advice", "sampling", f"{text}: the plant settles between two decisions; decide more often")
    elif plant.dt < _FINE * taus[0]:
        found.add("advice", "sampling", f"{text}: hardly anything happens between two decisions; decide less often")
    else:
        found.add("good", "sampling", text)


def _predictions(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck, seed: int) -> None:
    """How far predictions of one and of ten steps are, with the described and with the identified parameters."""
    identified = found.identification
    if identified is None:
        return
    trajectories = Trajectories.of(mpc, excerpt(plant_rows(mpc, table), _ROWS, seed), identified.unwrapped)
    windows = Windows.of(trajectories, _AHEAD, _AHEAD // 2, full=True)
    if len(windows) < 8:
        found.add("advice", "length", f"episodes are too short to look {_AHEAD} steps ahead")
        return
    errors = [np.sqrt(np.mean(open_loop(m, windows) ** 2, axis=1)) for m in (mpc, mpc.with_theta(identified.theta))]
    spread = trajectories.spread
    scale = trajectories.scale
    rows = []
    for i, q in enumerate(plant.states):
        numbers = [f"{errors[m][k, i] * scale[i]:.3g}" for k in (1, _AHEAD) for m in (0, 1)]
        rows.append((q.name, q.unit, *numbers, f"{spread[i]:.3g}"))
    header = ("state", "unit", "1 step", "identified", f"{_AHEAD} steps", "identified", "spread")
    found.tables.append(
        Table(header, rows, title="Prediction errors of the described and the identified model", align="llr")
    )
    before, after = (float(np.sqrt(np.mean(np.minimum(e[_AHEAD], 1e3) ** 2))) for e in errors)
    check_ = identified.multi_step
    if check_ is not None and check_.suspicious and not any(r.about == "description and data" for r in found.problems):
        found.add("problem", "structure", str(check_))
    if after > _POOR:
        kind: Kind = "problem" if after > 0.9 else "advice"
        text = f"even with the best parameters, {_AHEAD} steps ahead the model misses by {after:.0%} of the spread"
        found.add(kind, "model", f"{text}: something moves the plant that the equations do not know")
    ratio = before / max(after, 1e-9)
    if ratio > _WORSE:
        times = f"{ratio:.1f}" if ratio < 100 else "more than 100"
        found.add("good", "gain", f"The described model is {times} times as far off, ten steps ahead, as the log's.")
    else:
        found.add(
            "good", "gain", "The description's parameters fit the log; what is to be gained is in cost and horizon."
        )


def _goal(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
    """Whether the goal was ever visited."""
    reference, tracks = mpc.reference, getattr(mpc.stage_cost, "tracks", {})
    weights = getattr(mpc.stage_cost, "W", None)
    if reference is None or weights is None:
        return
    observations = table.observations
    present = {s.name: int(at) for s, at in zip(mpc.layout.signals, mpc.layout.present, strict=True)}
    for i, q in enumerate(plant.states):
        if weights[i, i] <= 0.0:
            continue
        goal = reference[i] + (observations[:, present[tracks[i]]] if i in tracks else 0.0)
        away = np.abs(observations[:, i] - goal)
        near = _NEAR * max(float(observations[:, i].std()), float(np.std(goal)), 1e-300)
        share = float(np.mean(away <= near))
        if share == 0.0:
            text = (
                f"{q.name} is never nearer to its goal than {away.min():.3g} {q.unit}: what it costs there is a guess"
            )
            found.add("advice", "goal", text)
        else:
            found.add("good", "goal", f"{q.name} is within {near:.2g} {q.unit} of its goal in {share:.0%} of the rows")
