"""What a quantity of a closed loop is to follow, and where its limits are, as far as the given description tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.penalties import limit_expressions

STATE, INPUT = 0, 1  #: Kinds of a quantity.


@dataclass(frozen=True)
class Marks:
    """Courses of what is not a controller's doing, over T + 1 steps each.

    Attributes:
        wanted: What states are to follow: set-points and fixed goals, by state.
        limits: Limits of states and inputs, by kind and place; bounds of the inputs among them.
        outside: Signals that no state is to follow, by their column of an observation.
    """

    wanted: Mapping[int, Array] = field(default_factory=dict)
    limits: Mapping[tuple[int, int], tuple[Array, ...]] = field(default_factory=dict)
    outside: Mapping[int, Array] = field(default_factory=dict)


def marks_of(mpc: MPC, observations: Array) -> Marks:
    """The marks of an MPC along signals.

    Args:
        mpc: The one that was given.
        observations: Of which the signals count, ``(T + 1, ny)``.
    """
    layout, tracks = mpc.layout, dict(getattr(mpc.stage_cost, "tracks", None) or {})
    present = {s.name: int(at) for s, at in zip(layout.signals, layout.present, strict=True)}
    turning = {s.name for s in layout.signals if s.period is not None}
    followed = {*tracks.values(), *turning}
    outside = {at: observations[:, at] for name, at in present.items() if name not in followed}
    return Marks(
        _wanted(mpc, observations, {i: present[name] for i, name in tracks.items()}),
        _limits(mpc, observations),
        outside,
    )


def _wanted(mpc: MPC, observations: Array, tracks: Mapping[int, int]) -> dict[int, Array]:
    """What the states are to follow that a quadratic cost has a weight for: of others a reference means nothing."""
    weights, reference = getattr(mpc.stage_cost, "W", None), mpc.reference
    if weights is None or reference is None:
        return {}
    size = np.abs(np.diag(np.asarray(weights)))[: mpc.layout.n_states]
    return {
        i: reference[i] + (observations[:, tracks[i]] if i in tracks else np.zeros(len(observations)))
        for i in np.flatnonzero(size > 0.0).tolist()
    }


def _limits(mpc: MPC, observations: Array) -> dict[tuple[int, int], tuple[Array, ...]]:
    """Limits of one state or one input each, which may move with signals: those of several cannot be drawn."""
    n, ny, found = mpc.layout.n_states, mpc.layout.ny, dict[tuple[int, int], list[Array]]()
    for j, ends in enumerate(zip(np.asarray(mpc.action_low), np.asarray(mpc.action_high), strict=True)):
        for end in ends:
            if np.isfinite(end):
                found.setdefault((INPUT, j), []).append(np.full(len(observations), end))
    x, u, theta = (ca.SX.sym(name, size) for name, size in (("x", mpc.nx), ("u", mpc.nu), ("p", mpc.space.size)))
    free = ca.vertcat(x[:n], x[ny:], u)  # all but the signals
    places = [*((STATE, i) for i in range(n)), *[None] * (mpc.nx - ny), *((INPUT, j) for j in range(mpc.nu))]
    for _, _, h in limit_expressions(mpc, x, u, theta):
        slopes = ca.jacobian(h, free)
        for k in range(h.numel()):
            own = [i for i in range(free.numel()) if not slopes[k, i].is_zero()]
            place = places[own[0]] if len(own) == 1 else None
            if place is None or ca.depends_on(slopes[k, own[0]], free):
                continue
            end = ca.substitute(-h[k] / slopes[k, own[0]], free, ca.DM.zeros(free.numel()))
            function = ca.Function("end", [x, theta], [end])
            course: Any = function(_states(observations, mpc.nx), mpc.theta).full().ravel()
            if np.isfinite(course).all():
                found.setdefault(place, []).append(course)
    return {place: tuple(courses) for place, courses in found.items()}


def _states(observations: Array, nx: int) -> Array:
    """As states of the MPC whose past inputs are zero, ``(nx, T + 1)``."""
    return np.pad(observations, ((0, 0), (0, nx - observations.shape[1]))).T
