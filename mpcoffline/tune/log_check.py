"""What a log and a description say of each other, before anything is fitted: one page, and whether tuning pays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure
from mpcoffline.core.threads import one_blas_thread
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import find_delays, find_lags, identify
from mpcoffline.estimation.consistency import check
from mpcoffline.estimation.multi_step import Windows, open_loop
from mpcoffline.estimation.plant import plant_rows
from mpcoffline.estimation.trajectories import Trajectories
from mpcoffline.mpc import MPC
from mpcoffline.plants import BlackBoxPlant, Plant

from .covered import coverage, gain, goal, quiet, readable, sampling
from .determined import in_words, parameters
from .moves import unstated_rates
from .output_check import check_outputs
from .page import Kind, LogCheck

_ROWS = 20_000
_AHEAD = 10  # steps
_NOISY = 0.3  # of the increments' spread
_WELL, _POOR = 0.2, 0.5  # of the spread, ten steps ahead
_MOVED = 0.1  # of a parameter, where a lag is described
_TREND, _SURE = 0.05, 5.0  # of the errors' variance, and standard errors


@one_blas_thread()
def check_log(
    plant: Plant | BlackBoxPlant,
    table: TransitionTable,
    *,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
) -> LogCheck:
    """Compares a plant's description with a log of it, before anything is fitted.

    Args:
        plant: The description; one without equations gets a linear model of the log first.
        table: The log, as :meth:`mpcoffline.Plant.read` gives it.
        seed: Seeds the choice of rows.
        tell: Is told, in a word, what is looked at now: on a busy machine it takes minutes.

    Returns:
        The page; ``print`` shows it.

    Raises:
        InvalidDataError: If there are no equations, and the log says too little for a model.
    """
    plant, model = with_equations(plant, table, seed, tell)
    if plant.outputs:
        found = check_outputs(plant, table, seed=seed, tell=tell)
        if model:
            found.add("advice", "model", model)
            found.sort()
        return found
    mpc, found = plant.mpc(), LogCheck()
    readable(table, found)
    tell("units, signs, sampling")
    findings = check(mpc, table)
    for finding in findings.findings:
        found.add("problem", "description and data", str(finding), forbids=finding in findings.errors)
    if (table.ny, table.nu) == (mpc.ny, mpc.nu):
        coverage(plant, table, found)
        unstated_rates(plant, table, found)
        goal(plant, mpc, table, found)
    misread = any(finding.misread for finding in findings.findings)
    if misread:
        text = "what rests on the model (dead time, parameters, noise, predictions) is looked at once that is mended"
        found.add("advice", "description and data", text)
    if misread or findings.errors:
        found.sort()
        return found
    with quiet():
        try:
            tell("dead time")
            mpc = _dead_time(plant, mpc, table, found, seed)
            if not findings.findings:  # a column that was not applied looks as if it acted slowly
                _lags(plant, mpc, table, found, seed)
            tell("parameters")
            found.identification = identify(mpc, table, seed=seed)
        except InvalidDataError as error:
            found.add("problem", "identification", str(error), forbids=True)
            return found
    parameters(plant, mpc, table, found)
    _noise(plant, found)
    rows = plant_rows(mpc, table).sample(5_000, 0).values()
    sampling(plant, mpc.with_theta(found.identification.theta), rows.observations, rows.actions, found)
    tell("predictions")
    _predictions(plant, mpc, table, found, seed)
    _trend(plant, mpc, table, found)
    found.sort()
    return found


def with_equations(
    plant: Plant | BlackBoxPlant, table: TransitionTable, seed: int, tell: Callable[[str], None]
) -> tuple[Plant, str]:
    """The plant, with a linear model of the log where it has no equations; and what is to be said of that."""
    if isinstance(plant, Plant):
        return plant, ""
    tell("No equations are described: a linear model is looked for in the log")
    model = plant.model(table, seed=seed)
    return plant.modelled(model), str(model)


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


def _lags(plant: Plant, mpc: MPC, table: TransitionTable, found: LogCheck, seed: int) -> None:
    """What acts slowly where the equations say at once; and what that makes of a parameter that takes its place."""
    found.lags = find_lags(mpc, table, seed=seed)
    names = [*(each.name for each in plant.inputs), *(signal.name for signal in mpc.layout.signals)]
    space = mpc.model.space
    for lag in found.lags:
        name, seconds = names[lag.place], lag.steps * mpc.model.dt
        before, after = lag.before[: space.size], lag.after[: space.size]
        text = (
            f"{name} acts slowly, as through a lag with a time constant of about {in_words(seconds)}: with one,"
            f" one-step errors are {lag.gain:.2g} times those without"
        )
        moved = np.abs(after - before) / np.maximum(np.maximum(np.abs(before), np.abs(after)), 1e-300)
        if space.size and moved.max() > _MOVED:
            k = int(moved.argmax())
            text += f", and {space.names[k]} in the log is {after[k]:.3g} instead of {before[k]:.3g}"
        state = f"slow_{name}"
        found.add(
            "advice",
            "lag",
            f"{text}. Without it the model is wrong where inputs move otherwise than in the log. Describe a state"
            f" {state} that follows it at the rate ({name} - {state}) / {figure(seconds, 2)} s, and name in"
            " outputs=[...] what is measured",
        )


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
    found.add("good", "gain", gain(before, after, noise))


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
