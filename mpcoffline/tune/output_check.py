"""What a log of outputs and a description say of each other: ``check`` where states are hidden."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.core.text import listed
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import OutputIdentification
from mpcoffline.estimation.from_outputs import AHEAD, NOTHING, SEEN, missed_of
from mpcoffline.mpc.labels import Label
from mpcoffline.mpc.outputs import shown
from mpcoffline.plants import Plant

from .covered import coverage, gain, goal, quiet, readable, sampling
from .determined import DETERMINED, FAR, SURE, WEAK
from .moves import unstated_rates
from .page import LogCheck

_STRANGE = 4.0  # standard deviations of where episodes begin, as described
_LOST = 1e3  # of what an output moves: larger errors count as this
_NOISY = 0.9  # of what an output moves from step to step


def check_outputs(plant: Plant, table: TransitionTable, *, seed: int, tell: Callable[[str], None]) -> LogCheck:
    """See :func:`mpcoffline.tune.check_log`."""
    found = LogCheck()
    readable(table, found)
    tell("units")
    coverage(plant, table, found)
    unstated_rates(plant, table, found)
    _contradictions(plant, table, found)
    if any(each.forbids for each in found.remarks):
        found.sort()
        return found
    tell("model and states, in the outputs")
    try:
        with quiet():
            known = plant.identify(table, seed=seed)
    except InvalidDataError as error:
        found.add("problem", "identification", str(error), forbids=True)
        found.sort()
        return found
    found.outputs = known
    _dead_time(plant, known, found)
    _parameters(plant, known, found)
    _states(plant, known, found)
    _noise(plant, known, table, found)
    goal(plant, known.mpc, known.table, found)
    rows = known.table.sample(5_000, seed).values()
    present = rows.observations[:, known.mpc.layout.present.tolist()]
    sampling(plant, known.mpc, rows.observations, np.hstack([rows.actions, present]), found)
    tell("predictions")
    _predictions(plant, known, table, found)
    found.sort()
    return found


def _contradictions(plant: Plant, table: TransitionTable, found: LogCheck) -> None:
    """What needs no model: inputs and outputs that do not move, where episodes begin."""
    for kind, quantities, values in (
        ("outputs", plant.outputs, table.observations),
        ("inputs", plant.inputs, table.actions),
    ):
        for j, each in enumerate(quantities):
            if not np.ptp(values[:, j]) > 0.0:
                text = f"{each.name} is one number throughout: nothing can be learned of it"
                found.add("problem", kind, text, forbids=kind == "outputs")
    _beginnings(plant, table, found)


def _beginnings(plant: Plant, table: TransitionTable, found: LogCheck) -> None:
    """Whether outputs begin where the described starts of the states let them."""
    low, high = np.array([state.starts for state in plant.states]).T
    first = table.take(np.sort(table.episodes.firsts)).observations[:, : len(plant.outputs)]
    rng, (least, most) = np.random.default_rng(0), plant.action_bounds
    starts = rng.uniform(low, high, (200, len(low)))
    rest = np.array([each.at_rest for each in plant.inputs])
    bounded = np.isfinite(least) & np.isfinite(most)  # before an episode, any input may have acted
    acted = rng.uniform(np.where(bounded, least, rest), np.where(bounded, most, rest), (200, len(rest)))
    begun = shown(plant.outputs_function, starts, acted).T
    for i, output in enumerate(plant.outputs):
        spread = float(np.hypot(begun[i].std(), output.deviation))
        away = abs(float(first[:, i].mean()) - float(begun[i].mean()))
        if spread > 0.0 and away > _STRANGE * spread:
            text = (
                f"episodes begin with {output.name} at {first[:, i].mean():.3g} {output.unit} on average; by the starts"
                f" of the states it would be {begun[i].mean():.3g}, give or take {spread:.2g}: a unit, or the starts?"
            )
            found.add("problem", "description and data", text)


def _dead_time(plant: Plant, known: OutputIdentification, found: LogCheck) -> None:
    for each, d in zip(plant.inputs, known.mpc.layout.delay, strict=True):
        if each.delay is None and d:
            text = f"{each.name} acts {d} {'step' if d == 1 else 'steps'} late. Write delay={d} into the plant file"
            found.add("advice", "dead time", text)
    told = np.isfinite(known.missed).all()  # else episodes are too short to compare dead times in
    if told and not any(known.mpc.layout.delay) and any(each.delay is None for each in plant.inputs):
        found.add("good", "dead time", "none that shows")


def _parameters(plant: Plant, known: OutputIdentification, found: LogCheck) -> None:
    """Which parameters the log determines, and how far they are from the description."""
    given, rows, open_ones, far = plant.mpc(), [], [], []
    for name, deviation in zip(known.names, known.deviations, strict=True):
        own, at = name.removeprefix("model."), given.space.names.index(name)
        before, value, parameter = float(given.theta[at]), float(known.mpc.theta[at]), plant.parameters[own]
        relative = deviation / abs(value) if value else np.inf
        left_open = name in known.sensors.undetermined or relative > WEAK
        word = "no" if left_open else "weakly" if relative > DETERMINED else "yes"
        rows.append((own, parameter.unit, f"{before:.4g}", f"{value:.4g}", f"{deviation:.2g}", word))
        if word == "no":
            open_ones.append(own)
        elif parameter.spread > 0.0 and abs(value - before) > FAR * parameter.spread * abs(before) + SURE * deviation:
            far.append(f"{own} is {value:.4g} {parameter.unit}".rstrip() + f" ({before:.4g} described)")
    if rows:
        header = ("parameter", "unit", "described", "in the log", "+-", "determined")
        found.tables.append(Table(header, rows, title="Parameters", align="llrrrl"))
    if far:
        found.add("advice", "parameters", f"in the log {', '.join(far)}: are units and columns those of the equations?")
    if open_ones:
        text = (
            f"the log does not determine {listed(open_ones)}: write the numbers into the equations, or move inputs more"
        )
        found.add("advice", "excitation", text)
    elif rows:
        found.add("good", "parameters", f"the log determines all {len(rows)}")


def _states(plant: Plant, known: OutputIdentification, found: LogCheck) -> None:
    """How well outputs tell the states."""
    spread = known.table.statistics().std.observations
    rows = []
    for state, share, all_ in zip(plant.states, known.seen, spread, strict=False):
        rows.append((str(Label(state.name, state.unit)), f"{all_:.3g}", f"{share:.0%}"))
        if share < SEEN:
            text = f"{state.name} hardly shows in the outputs: what is learned of it rests on the equations"
            found.add("advice", "states", text)
    header = ("state", "spread", "of its variance, outputs tell")
    found.tables.append(Table(header, rows, title="States that are estimated", align="lr"))


def _noise(plant: Plant, known: OutputIdentification, table: TransitionTable, found: LogCheck) -> None:
    """How noisy the sensors are."""
    parts = [f"{q.name} {v:.2g} {q.unit}".rstrip() for q, v in zip(plant.outputs, known.sensors.noise, strict=True)]
    found.add("good", "noise", f"of the measurements, standard deviation: {', '.join(parts)}")
    c = table.sample(5_000, 0).values()
    moved = (c.next_observations - c.observations)[:, : len(plant.outputs)].std(axis=0)
    for output, v, motion in zip(plant.outputs, known.sensors.noise, moved, strict=True):
        if np.sqrt(2.0) * v > _NOISY * motion:
            text = f"{output.name} moves little more in a control interval than its noise: states rest on averages"
            found.add("advice", "noise", text)


def _predictions(plant: Plant, known: OutputIdentification, table: TransitionTable, found: LogCheck) -> None:
    """How far predictions are, with the described and with the identified parameters."""
    if not np.isfinite(known.missed).all():
        found.add("advice", "length", f"episodes are too short to look {AHEAD} steps ahead")
        return
    described = plant.mpc().with_delay(known.mpc.layout.delay)
    with np.errstate(over="ignore", invalid="ignore"):
        before = missed_of(described, known.sensors.suited(described, known.table), table)
    before = np.where(np.isfinite(before), np.minimum(before, _LOST), _LOST)
    rows = [
        (q.name, q.unit, f"{a:.0%}", f"{b:.0%}") for q, a, b in zip(plant.outputs, before, known.missed, strict=True)
    ]
    title = f"Prediction errors {AHEAD} steps ahead, in what outputs move in these"
    found.tables.append(Table(("output", "unit", "described", "identified"), rows, title, "llr"))
    worst = int(np.argmax(known.missed))
    if known.missed[worst] > NOTHING:
        text = (
            f"{AHEAD} steps ahead, {plant.outputs[worst].name} is missed by {known.missed[worst]:.0%} of what it moves:"
            " hardly better than to say that it stays. The structure may be wrong, an input unknown, or it moves little"
            " more than its noise"
        )
        found.add("problem", "model", text)
    # Of a start and an end, in what outputs move: by so much noise alone makes predictions miss.
    moved = np.sqrt(2.0) * table.statistics().std.observations[: len(plant.outputs)]
    noise = float(np.sqrt(np.mean((np.sqrt(2.0) * known.sensors.noise / moved) ** 2)))
    off, left = (float(np.sqrt(np.mean(each**2))) for each in (before, known.missed))
    found.add("good", "gain", gain(off, left, noise, f"{AHEAD}", "what outputs move"))
