"""What a log covers, how far it is from the goal, and what better parameters would do: of states and of outputs."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import Columns, TransitionTable
from mpcoffline.estimation.units import CONVERSIONS, in_words
from mpcoffline.mpc import MPC
from mpcoffline.mpc.labels import Label
from mpcoffline.plants import Plant

from .determined import time_constants
from .page import LogCheck

_NEAR = 0.05  # of a state's spread about its goal
_WORSE = 1.5  # times the identified model's error ahead, of the described one: tuning pays
_WELL, _AS_NOISE = 0.2, 2.0  # of the spread, ahead; times what noise makes of it
_STUCK, _MOSTLY_STUCK = "stuck", 0.05  # of the rows: no incident any more
_COARSE, _FINE = 1.0, 0.002  # control intervals in time constants
_FEW = 200  # rows
_DEGREES = ("°", "deg", "K", "C", "F")  # in a unit that may be one of temperature
_RESOLVED, _COARSE_STEP = 5_000, 0.1  # rows looked at, and of a quantity's spread


def readable(table: TransitionTable, found: LogCheck) -> None:
    """What was read, and sensors that were stuck."""
    report = getattr(table, "report", None)
    found.head = str(report) if report is not None else repr(table)
    if report is None:
        return
    stuck = [each for each in report.left_out if each.why.startswith(_STUCK)]
    for each in stuck:
        share = sum(other.count for other in stuck if other.what == each.what) / max(report.rows, 1)
        text = f"{each.why}, {each.count} rows from {each.first} on"
        if each.lasting or share > _MOSTLY_STUCK:  # what is past and left out cannot be mended any more
            end = " to the log's end" if each.lasting else ""
            found.add("problem", each.what, f"{text}{end}: is its sensor well?")
        else:
            found.add("advice", each.what, f"{text}: left out. Is its sensor well?")


@contextmanager
def quiet() -> Iterator[None]:
    """What the steps of a check would log stands on its page."""
    logger = logging.getLogger("mpcoffline")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def coverage(plant: Plant, table: TransitionTable, found: LogCheck) -> None:
    """What ranges the log covers, of what is measured, inputs and present signals; previews are the same numbers."""
    statistics = table.statistics()
    layout = plant.mpc().layout
    measured: Sequence[Label] = [Label(q.name, q.unit) for q in plant.measured]
    present = [int(at) for s, at in zip(layout.signals, layout.present, strict=True) if s.period is None]
    labels = [*measured, *(layout.y_labels[i] for i in present), *layout.u_labels]
    shown = [*range(len(measured)), *(i - layout.n_states + len(plant.measured) for i in present)]

    def listed(part: Columns) -> Array:
        return np.append(part.observations[shown], part.actions)

    low, high, spread = (listed(part) for part in (statistics.low, statistics.high, statistics.std))
    rows = []
    quantities: tuple[Any, ...] = (*plant.measured, *plant.inputs, *plant.signals)
    ranges = {q.name: (q.low, q.high) for q in quantities}
    for label, a, b, s in zip(labels, low, high, spread, strict=True):
        least, most = ranges.get(label.name, (-np.inf, np.inf))
        share = f"{(b - a) / (most - least):.0%}" if np.isfinite(most - least) else ""
        rows.append((str(label), f"{a:.4g}", f"{b:.4g}", f"{s:.3g}", share))
    header = ("quantity", "least", "most", "spread", "of its range")
    found.tables.append(Table(header, rows, title="What the log covers", align="lr"))
    every = table.sample(_RESOLVED, 0).values().observations
    for i, q in enumerate(plant.measured):
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


def gain(before: float, after: float, noise: float, ahead: str = "ten", of: str = "the spread") -> str:
    """What better parameters would do for predictions, in the words of the verdict.

    Args:
        before: Error of the described model some steps ahead, relative.
        after: The same of the identified one.
        noise: What the sensors' noise makes of it.
        ahead: How many steps that is, in a word.
        of: What errors are relative to.
    """
    ratio = before / max(after, 1e-9)
    if ratio > _WORSE:
        times = f"{ratio:.1f}" if ratio < 100 else "more than 100"
        return (
            f"Worth tuning. {ahead.capitalize()} steps ahead, the described model is {times} times as far off as one"
            " with the parameters of the log."
        )
    missed = f"{ahead} steps ahead they miss by {before:.0%} of {of}"
    if after <= max(_WELL, _AS_NOISE * noise):
        return (
            f"Nothing speaks against tuning. The described parameters predict the log about as well as its best ones:"
            f" {missed}. What the log cannot say before a fit is what cost and horizon gain."
        )
    return (
        f"Tuning may gain little. Neither the described parameters nor the best ones predict the log well: {missed}"
        f" and {after:.0%}, of which the sensors' noise makes {noise:.0%}. What is missing is in the equations."
    )


def goal(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
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
        wanted = reference[i] + (observations[:, present[tracks[i]]] if i in tracks else 0.0)
        away = np.abs(observations[:, i] - wanted)
        near = _NEAR * max(float(observations[:, i].std()), float(np.std(wanted)), 1e-300)
        share = float(np.mean(away <= near))
        if share == 0.0:
            text = (
                f"{q.name} is never nearer to its goal than {away.min():.3g} {q.unit}: what it costs there is a guess"
            )
            if any(sign in q.unit for sign in _DEGREES):
                text += _in_another_unit(np.asarray(observations[:, i], np.float64), wanted)
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


def sampling(plant: Plant, model: MPC, states: Array, inputs: Array, found: LogCheck) -> None:
    """The control interval against the time constants of a model at states ``(n, nx)`` and what acts on these."""
    taus = np.sort(time_constants(model, states, inputs))
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
