"""What a log and a description say of each other, before anything is fitted: one page, and whether tuning pays."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import find_delays, identify
from mpcoffline.estimation.consistency import check
from mpcoffline.estimation.multi_step import Windows, open_loop
from mpcoffline.estimation.plant import plant_rows
from mpcoffline.estimation.trajectories import Trajectories
from mpcoffline.estimation.units import CONVERSIONS, in_words
from mpcoffline.mpc import MPC
from mpcoffline.plants import Plant
from mpcoffline.plants.outputs import check_measured

from .determined import parameters, time_constants
from .page import Kind, LogCheck

_ROWS = 20_000
_AHEAD = 10  # steps
_NOISY = 0.3  # of the increments' spread
_STUCK = "stuck"
_NEAR = 0.05  # of a state's spread about its goal
_WORSE = 1.5  # times the identified model's error ahead, of the described one: tuning pays
_WELL, _POOR = 0.2, 0.5  # of the spread, ten steps ahead
_AS_NOISE = 2.0  # times what noise makes of it
_COARSE, _FINE = 1.0, 0.002  # control intervals in time constants
_FEW = 200  # rows
_DEGREES = ("°", "deg", "K", "C", "F")  # in a unit that may be one of temperature
_RESOLVED, _COARSE_STEP = 5_000, 0.1  # rows looked at, and of a state's spread
_TREND, _SURE = 0.05, 5.0  # of the errors' variance, and standard errors


def check_log(
    plant: Plant, table: TransitionTable, *, seed: int = 0, tell: Callable[[str], None] = lambda _: None
) -> LogCheck:
    """Compares a plant's description with a log of it, before anything is fitted.

    Args:
        plant: The description.
        table: The log, as :meth:`mpcoffline.Plant.read` gives it.
        seed: Seeds the choice of rows.
        tell: Is told, in a word, what is looked at now: on a busy machine it takes minutes.

    Returns:
        The page; ``print`` shows it.

    Raises:
        InvalidArgumentError: For a plant with outputs.
    """
    check_measured(plant, "check")
    mpc, found = plant.mpc(), LogCheck()
    report = getattr(table, "report", None)
    found.head = str(report) if report is not None else repr(table)
    for each in report.left_out if report is not None else ():
        if each.why.startswith(_STUCK):
            found.add("problem", each.what, f"{each.why}, {each.count} rows from {each.first} on: is its sensor well?")
    tell("units, signs, sampling")
    findings = check(mpc, table)
    for finding in findings.findings:
        found.add("problem", "description and data", str(finding), forbids=finding in findings.errors)
    if (table.ny, table.nu) == (mpc.ny, mpc.nu):
        _coverage(plant, table, found)
        _goal(plant, mpc, table, found)
    misread = any(finding.misread for finding in findings.findings)
    if misread:
        text = "what rests on the model (dead time, parameters, noise, predictions) is looked at once that is mended"
        found.add("advice", "description and data", text)
    if misread or findings.errors:
        found.sort()
        return found
    with _quiet():
        try:
            tell("dead time")
            mpc = _dead_time(plant, mpc, table, found, seed)
            tell("parameters")
            found.identification = identify(mpc, table, seed=seed)
        except InvalidDataError as error:
            found.add("problem", "identification", str(error), forbids=True)
            return found
    parameters(plant, mpc, table, found)
    _noise(plant, found)
    _sampling(plant, mpc, table, found)
    tell("predictions")
    _predictions(plant, mpc, table, found, seed)
    _trend(plant, mpc, table, found)
    found.sort()
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
    every = table.sample(_RESOLVED, 0).values().observations
    for i, q in enumerate(plant.states):
        levels = np.unique(every[:, i])
        step = float(np.median(np.diff(levels))) if len(levels) > 2 else 0.0
        if step > _COARSE_STEP * float(every[:, i].std()) and len(levels) < 0.1 * len(every):
            text = (
                f"{q.name} comes in steps of {step:.3g} {q.unit}, {step / float(every[:, i].std()):.0%} of its spread"
            )
            found.add("advice", "resolution", f"{text}: what is smaller is lost; log more digits")
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


def _noise(plant: Plant, found: LogCheck) -> None:
    """How noisy the measurements are."""
    identified = found.identification
    if identified is None:
        return
    noise = identified.noise
    sizes = [(q, f"{v:.2g} {q.unit}" if v > 0.0 else "") for q, v in zip(plant.states, noise.measurement, strict=True)]
    parts = [f"{q.name} {size or 'none that shows'}".rstrip() for q, size in sizes]
    found.add("good", "noise", f"of the measurements, standard deviation: {', '.join(parts)}")
    if noise.increments is None:
        return
    for q, v, motion in zip(plant.states, noise.measurement, noise.increments, strict=True):
        if motion > 0.0 and v > motion * _NOISY * 3.0:
            text = f"{q.name} moves less in a control interval than its noise: what is learned of it rests on averages"
            found.add("advice", "noise", text)


def _sampling(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
    """The control interval against the time constants."""
    identified = found.identification
    if identified is None:
        return
    rows = plant_rows(mpc, table).sample(5_000, 0).values()
    taus = np.sort(time_constants(mpc.with_theta(identified.theta), rows.observations, rows.actions))
    if not len(taus):
        return
    listed = ", ".join(figure(float(tau)) for tau in taus)
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
        found.add("problem" if after > 0.5 * _WELL else "advice", "structure", str(check_))
    if after > _POOR:
        kind: Kind = "problem" if after > 0.9 else "advice"
        text = f"even with the best parameters, {_AHEAD} steps ahead the model misses by {after:.0%} of the spread"
        found.add(kind, "model", f"{text}: something moves the plant that the equations do not know")
    noise = float(np.sqrt(2.0 * np.mean((identified.noise.measurement / scale) ** 2)))  # of start and end
    found.add("good", "gain", _gain(before, after, noise))


def _trend(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
    """Whether what the identified model misses changes along the log, as of a sensor that drifts."""
    identified = found.identification
    if identified is None:
        return
    rows = plant_rows(mpc, table)
    c = rows.take(np.arange(0, len(rows), max(1, len(rows) // _ROWS))).values()
    missed = c.next_observations - mpc.plant_function(c.observations.T, c.actions.T, identified.theta).full().T
    along = np.linspace(-1.0, 1.0, len(missed))
    for i, q in enumerate(plant.states):
        own = missed[:, i] - missed[:, i].mean()
        size = float(own @ own)
        if i in identified.unwrapped or not (np.isfinite(size) and size > 0.0 and len(own) > _AHEAD):
            continue
        r = float(own @ along) / np.sqrt(size * float(along @ along))
        lasting = float(np.clip(own[1:] @ own[:-1] / size, 0.0, 0.99))
        sure = abs(r) * np.sqrt(len(own) * (1.0 - lasting) / (1.0 + lasting))
        if r**2 > _TREND and sure > _SURE:
            text = (
                f"what the model misses of {q.name} goes one way along the log ({r**2:.0%} of it): a sensor that"
                " drifts, or a plant that changes"
            )
            found.add("advice", "drift", text)


def _gain(before: float, after: float, noise: float) -> str:
    """What better parameters would do for predictions, in the words of the verdict.

    Args:
        before: Error of the described model ten steps ahead, in spreads of the states.
        after: The same of the identified one.
        noise: What the sensors' noise makes of it.
    """
    ratio = before / max(after, 1e-9)
    if ratio > _WORSE:
        times = f"{ratio:.1f}" if ratio < 100 else "more than 100"
        return (
            f"Worth tuning. Ten steps ahead, the described model is {times} times as far off as one with the"
            " parameters of the log."
        )
    missed = f"ten steps ahead they miss by {before:.0%} of the spread"
    if after <= max(_WELL, _AS_NOISE * noise):
        return (
            f"Nothing speaks against tuning. The described parameters predict the log about as well as its best ones:"
            f" {missed}. What the log cannot say before a fit is what cost and horizon gain."
        )
    return (
        f"Tuning may gain little. Neither the described parameters nor the best ones predict the log well: {missed}"
        f" and {after:.0%}, of which the sensors' noise makes {noise:.0%}. What is missing is in the equations."
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
            if any(sign in q.unit for sign in _DEGREES):
                text += _in_another_unit(np.asarray(observations[:, i], np.float64), goal)
            found.add("advice", "goal", text)
        else:
            found.add("good", "goal", f"{q.name} is within {near:.2g} {q.unit} of its goal in {share:.0%} of the rows")


def _in_another_unit(logged: Array, goal: Array | float) -> str:
    """Words on temperatures that would meet the goal in another unit."""
    for factor, offset in CONVERSIONS:
        meant = factor * logged + offset
        if meant.min() <= np.max(goal) and np.min(goal) <= meant.max():
            return f", or is it to be {in_words(factor, offset)}?"
    return ""
