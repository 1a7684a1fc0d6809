"""Planar quadrotor: rotors that lift and tilt a body, which has to fly to the origin and hover there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from . import rendering as style
from .arguments import Array
from .base import ControlTask
from .plant import Entries, Input, Nominal, Parameter, Plant, State, Uniform, Values, square
from .registry import register
from .rendering import Canvas, Moment, clockwise, refined, signed

MASS, GRAVITY, MAX_THRUST, MAX_TORQUE = 0.5, 9.8, 10.0, 0.2
HOVER = MASS * GRAVITY
SUCCESS_RADIUS = 0.1


def dynamics(y: Entries, inputs: Entries, p: Values) -> Entries:
    """The equations of motion, d[x, z, phi, xd, zd, phid]/dt."""
    _, _, cos, sin, xd, zd, phid = y
    thrust, torque = inputs
    xdd = (thrust * sin - p["mu"] * xd) / p["m"]
    zdd = (thrust * cos - p["mu"] * zd) / p["m"] - p["g"]
    return xd, zd, phid, xdd, zdd, (torque - p["c"] * phid) / p["J"]


def cost(s: Entries, inputs: Entries) -> object:
    """The stage cost."""
    x, z, phi, xd, zd, phid = s
    thrust, torque = inputs
    speeds = square(xd) + square(zd) + square(phid)
    return 2.0 * (square(x) + square(z)) + square(phi) + 0.1 * speeds + 0.02 * square(thrust - HOVER) + square(torque)


PLANT = Plant(
    id="mpcoffline/PlanarQuadrotor-v0",
    name="quadrotor",
    dt=0.1,
    # Thrust and gravity add at most 29.8 m/s^2, the torque 10 rad/s^2, in the 10 s of an episode: 1490 m, 298 m/s.
    states=(
        State("x", "x", "m", limit=3e3, start=300.0, quantity="position", span=(-2.0, 2.0)),
        State("z", "z", "m", limit=3e3, start=300.0, quantity="height"),
        State("phi", r"\varphi", "rad", quantity="tilt", angle=True),
        State("xd", r"\dot x", "m/s", limit=500.0, start=100.0, quantity="speed", span=(-3.0, 3.0)),
        State("zd", r"\dot z", "m/s", limit=500.0, start=100.0, quantity="speed"),
        State("phid", r"\dot\varphi", "rad/s", limit=500.0, start=100.0, quantity="speed"),
    ),
    inputs=(
        Input("thrust", "F", "N", 0.0, MAX_THRUST, quantity="thrust"),
        Input("torque", r"\tau", "N m", -MAX_TORQUE, MAX_TORQUE, quantity="torque"),
    ),
    parameters=(
        Parameter("m", MASS, 0.1, 10.0, "kg", spread=0.15, meaning="mass"),
        Parameter("J", 0.02, 0.01, 1.0, "kg m2", spread=0.006, meaning="moment of inertia"),
        Parameter("mu", 0.5, 0.0, 2.0, "N s/m", spread=0.2, meaning="drag on motion"),
        Parameter("c", 0.04, 0.0, 0.2, "N m s", spread=0.015, meaning="drag on rotation"),
        Parameter("g", GRAVITY, 0.0, 30.0, "m/s2", meaning="gravity"),
    ),
    dynamics=dynamics,
    cost=cost,
    starts={"broad": Uniform((-1.0, -1.0, -1.0, -0.5, -0.5, -1.0), (1.0, 1.0, 1.0, 0.5, 0.5, 1.0))},
    success=lambda s: np.hypot(s[..., 0], s[..., 1]) < SUCCESS_RADIUS,
    nominal=Nominal((2.0, 2.0, 1.0, 1.0, 0.1, 0.1, 0.1), (0.02, 1.0), horizon=30, input_target=(HOVER, 0.0)),
    shown=("x", "z", "phi"),
    plane=("x", "xd"),
    coverage=(("x", "z"), ("phi", "phid"), ("thrust", "torque")),
    seconds=5.0,
    catalog="mpcoffline.datasets.catalog",
    mismatch=("mu", 0.0),
)


class PlanarQuadrotorEnv(ControlTask):
    r"""Fly a body with rotors to the origin of a vertical plane and hover there.

    ## Description
    Rotors push along the body's own upward direction and turn it. To move sideways the body has to tilt, and what it
    tilts is missing from its lift. With the tilt $\varphi$, positive clockwise in the picture, the mass $m$, the moment
    of inertia $J$, and the drag of the air on motion, $\mu$, and on rotation, $c$:

    $$m\ddot x = F\sin\varphi - \mu\dot x, \qquad m\ddot z = F\cos\varphi - \mu\dot z - mg, \qquad
    J\ddot\varphi = \tau - c\,\dot\varphi$$

    integrated with one Runge-Kutta (RK4) step of $dt = 0.1$ s, the input held.

    ## Rewards
    $r = -L$ with the stage cost

    $$L = 2(x^2 + z^2) + \varphi^2 + 0.1(\dot x^2 + \dot z^2 + \dot\varphi^2) + 0.02(F - 4.9)^2 + \tau^2$$

    of the state before the step. The best reward of a step is 0.

    ## Success
    The episode is a success if $|(x, z)| < 0.1$ m at its end.

    ## References
    Not a task of arXiv:2301.01667: the plant is the usual planar model of a multirotor, its numbers are ours.
    """

    plant = PLANT

    def draw(self, canvas: Canvas, moment: Moment) -> None:
        """Draws the body and its rotors, the way of its centre, the target and the thrusts."""
        x, z, phi = map(float, moment.state[:3])
        # The view doubles when the body comes near its edge.
        half = 1.5 * 2.0 ** max(0, math.ceil(math.log2(max(abs(x), abs(z), 1e-9) / 1.3)))
        scale = canvas.width / 2.0 / half
        origin = np.array([canvas.width, canvas.height]) / 2.0

        def place(points: ArrayLike) -> Array:
            return origin + scale * np.asarray(points) * [1.0, -1.0]

        canvas.grid(origin, scale)
        canvas.disc(origin, max(SUCCESS_RADIUS * scale, 6.0), style.TARGET_ZONE)
        canvas.arc(origin, max(SUCCESS_RADIUS * scale, 6.0), 0.0, 2.0 * np.pi, 2.0, style.TARGET)
        canvas.trail(place(refined(moment.trail, self.angle)[:, :2]), 4.0, style.TRAIL)
        body, up, right = place([x, z]), clockwise(phi), clockwise(phi + np.pi / 2.0)
        canvas.line(body - 46.0 * right, body + 46.0 * right, 8.0, style.PLANT, rounded=True)
        canvas.disc(body, 11.0, style.INK)
        for hub in (body - 46.0 * right, body + 46.0 * right):
            canvas.line(hub + 9.0 * up - 17.0 * right, hub + 9.0 * up + 17.0 * right, 4.0, style.INK, rounded=True)
        caption = [(f"t = {moment.time:.1f} s", style.INK), (f"cost {moment.cost:.2f}", style.INK)]
        if moment.action is not None:
            thrust, torque = map(float, moment.action)
            canvas.arrow(body + 13.0 * up, body + (13.0 + 110.0 * thrust / MAX_THRUST) * up, 6.0, style.INPUT)
            canvas.curved_arrow(body, 64.0, phi, 1.4 * torque / MAX_TORQUE, 5.0, style.INPUT)
            caption += [(f"{signed(thrust)} N", style.INPUT), (f"{signed(torque)} N m", style.INPUT)]
        canvas.caption(caption)


PlanarQuadrotorVectorEnv = register(PlanarQuadrotorEnv)
