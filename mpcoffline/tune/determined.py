"""Which parameters a log determines, how far they are from the description, and what would determine the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure, listed
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.plant import plant_rows
from mpcoffline.mpc import MPC
from mpcoffline.plants import Plant

from .experiment import Experiment, experiments
from .page import Kind, LogCheck

DETERMINED, WEAK = 0.1, 0.3  #: Relative deviation of a parameter.
FAR, SURE = 1.5, 3.0  #: Described spreads beyond which a parameter is far off, and deviations besides.


def parameters(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck) -> None:
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
        word = "no" if in_doubt or relative > WEAK else "weakly" if relative > DETERMINED else "yes"
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
    _far_off(plant, rows, values, deviations, found)
    if not open_ones:
        found.add("good", "parameters", f"the log determines all {n}")
        return
    model = mpc.with_theta(identified.theta)
    rows_of = plant_rows(mpc, table).sample(5_000, 0).values()
    signals = rows_of.actions[:, len(plant.inputs) :].mean(axis=0)
    about = np.append(np.median(rows_of.observations, axis=0), signals)
    least = 1e-3 * np.where(rows_of.observations.std(axis=0) > 0.0, rows_of.observations.std(axis=0), 1.0)
    noise = np.maximum(identified.noise.measurement, least)
    taus = time_constants(model, rows_of.observations, rows_of.actions)
    hold = int(np.clip(round(0.5 * float(np.median(taus)) / plant.dt), 1, 25)) if len(taus) else 2
    found.experiments = experiments(model, open_ones, about, noise, hold)
    weak = all(row[-1] == "weakly" for row in rows if row[0] in open_ones)
    explained = any(each.about == "description and data" for each in found.problems)
    kind: Kind = "advice" if weak or explained else "problem"
    for text in _asked(plant, found.experiments):
        found.add(kind, "excitation", text)


def _far_off(plant: Plant, rows: Sequence[tuple[str, ...]], values: Array, deviations: Array, found: LogCheck) -> None:
    """Parameters that the log puts far outside what the description leaves open."""
    far = []
    for (name, unit, *_, word), value, deviation in zip(rows, values, deviations, strict=True):
        given = plant.parameters[name]
        if not (word == "yes" and given.spread > 0.0 and given.value):
            continue
        if abs(value - given.value) > FAR * given.spread * abs(given.value) + SURE * deviation:
            far.append(
                f"{name} is {value:.4g} {unit}".rstrip() + f" ({given.value:.4g} +- {given.spread:.0%} described)"
            )
    if far:
        hint = "are units, columns and the log's sampling time the ones of the equations?"
        found.add("advice", "parameters", f"in the log {', '.join(far)}: {hint}")


def _asked(plant: Plant, wanted: dict[str, Experiment | None]) -> list[str]:
    """What to record: a sentence for all parameters that one input's test determines."""
    none = [name for name, each in wanted.items() if each is None]
    texts = []
    if none:
        begin = f"the log does not determine {listed(none)}"
        texts.append(
            f"{begin}, and no test of the inputs alone would: write the numbers into the equations, or vary the start"
        )
    for i in sorted({each.input for each in wanted.values() if each is not None}):
        own = {name: each for name, each in wanted.items() if each is not None and each.input == i}
        amplitude, hold = (max(getattr(each, part) for each in own.values()) for part in ("amplitude", "hold"))
        input_, steps = plant.inputs[i], max(each.steps for each in own.values())
        texts.append(
            f"the log does not determine {listed(list(own))}: move {input_.name} at random between two values"
            f" {2 * amplitude:.3g} {input_.unit} apart, each kept for {in_words(hold * plant.dt)} or longer, for about"
            f" {in_words(max(steps, 4 * hold) * plant.dt)}".replace("  ", " ")
        )
    return texts


def in_words(seconds: float) -> str:
    """A time in words: ``"0.25 s"``, ``"12 minutes"``, ``"3.4 hours"``."""
    for size, word in ((86_400.0, "days"), (3_600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2.0 * size:
            return f"{figure(seconds / size, 2)} {word}"
    return f"{figure(seconds, 2)} s"


def time_constants(mpc: MPC, x: Array, u: Array) -> Array:
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
