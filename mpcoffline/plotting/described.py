"""Closed loops of described plants over time: states with set-points and limits, inputs, and what came from outside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc.labels import Label
from mpcoffline.plants import Plant

from .signals import Signal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mpcoffline.control.evaluation import Evaluation


def quantities_of(plant: Plant, loops: Mapping[str, Evaluation], episode: int) -> list[Signal]:
    """What figures show of an episode: states and what they are to follow or keep, inputs, then the other signals.

    Args:
        plant: The plant.
        loops: Closed loops by controller, in an environment of that plant.
        episode: Which of the episodes.
    """
    mpc = plant.mpc()
    tracks: Mapping[int, str] = getattr(mpc.stage_cost, "tracks", {})
    references = mpc.values.get("stage_cost.x_ref")
    observed = next(iter(loops.values())).observations[episode]
    courses = {s.name: observed[:, k] for s, k in zip(plant.signals, mpc.layout.present, strict=True)}
    states, actions = ({name: getattr(loop, kind)[episode] for name, loop in loops.items()} for kind in _KINDS)
    weighted = _weighted(mpc.stage_cost, len(plant.states))
    shown = []
    for i, state in enumerate(plant.states):
        target = None if i in tracks or references is None or not weighted[i] else float(references[i])
        course = courses[tracks[i]] if i in tracks else None
        curves = {name: values[:, i] for name, values in states.items()}
        label = str(Label(state.name, state.unit))
        shown.append(Signal(label, curves, limits=_limits(plant, state.name), target=target, course=course))
    for i, each in enumerate(plant.inputs):
        curves = {name: values[:, i] for name, values in actions.items()}
        label = str(Label(each.name, each.unit))
        shown.append(Signal(label, curves, bounds=(each.low, each.high), held=True))
    for signal in plant.signals:
        if signal.name not in tracks.values():
            shown.append(Signal(str(Label(signal.name, signal.unit)), {}, course=courses[signal.name], held=True))
    return shown


_KINDS = ("states", "actions")


def _weighted(cost: Any, n: int) -> Array:
    """Which states a quadratic cost has a weight for, ``(n,)``: of others a reference means nothing."""
    weights = getattr(cost, "W", None)
    return np.zeros(n) if weights is None else np.abs(np.diag(np.asarray(weights)))[:n]


def _limits(plant: Plant, name: str) -> tuple[float, ...]:
    """Where a quantity has limits that the controller is to keep."""
    ends = [end for limit in plant.limits if limit.of == name for end in (limit.low, limit.high)]
    return tuple(end for end in ends if np.isfinite(end))
