"""Cart-pole swing-up: move a cart so that the pole hinged on it swings up and stays there."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from . import rendering as style
from .arguments import Array
from .base import ControlTask
from .plant import Entries, Input, Nominal, Parameter, Plant, State, Uniform, Values, square
from .registry import register
from .rendering import Canvas, Moment, clockwise, refined, signed

MAX_FORCE = 2.0
SUCCESS_ANGLE = 0.3  # rad from upright


def dynamics(y: Entries, inputs: Entries, p: Values) -> Entries:
    """The equations of motion, d[x, xd, phi, phid]/dt."""
    _, xd, cos, sin, phid = y
    (u,) = inputs
    mass, moment = p["m_c"] + p["m_p"], p["m_p"] * p["l"]
    friction, turning = p["mu"] * xd, square(phid)
    drive = friction - u - moment * turning * sin
    if isinstance(cos, float | np.ndarray):  # on the unit circle
        share = p["m_p"] * square(cos) / mass
    else:
        # Dividing by |(cos, sin)|^2 keeps the inertia positive off it, where the iterates of an NLP solver wander. The
        # order of the product differs, and with it the rounding: data and fits made before would not repeat otherwise.
        share = p["m_p"] / mass * square(cos) / (square(cos) + square(sin))
    phidd = (p["g"] * sin + cos * drive / mass) / (p["l"] * (4.0 / 3.0 - share))
    xdd = (u - friction + moment * (turning * sin - phidd * cos)) / mass
    return xd, xdd, phid, phidd


def cost(s: Entries, inputs: Entries) -> object:
    """The stage cost."""
    x, xd, phi, phid = s
    (u,) = inputs
    return 2.0 * square(x) + square(phi) + 0.1 * square(xd) + 0.1 * square(phid) + 0.1 * square(u)


def max_friction(p: Values) -> float:
    """The largest friction at which RK4 is stable, about 2.8 / dt, with a margin.

    The mass that the force meets is least with the pole upright or hanging: m_c + m_p / 4.
    """
    return float(40.0 * (p["m_c"] + p["m_p"] / 4.0))


# Starts from which no input leaves the observation bounds, and from which RK4 at this sampling time is stable.
PLANT = Plant(
    id="mpcoffline/CartPoleSwingUp-v0",
    name="cartpole",
    dt=0.05,
    states=(
        State("x", "x", "m", limit=1e3, start=100.0, quantity="position"),
        State("xd", "\\dot x", "m/s", limit=200.0, start=20.0, quantity="speed"),
        State("phi", "\\varphi", "rad", quantity="angle", angle=True, band=SUCCESS_ANGLE),
        State("phid", "\\dot\\varphi", "rad/s", limit=500.0, start=20.0, quantity="speed", span=(-12.0, 12.0)),
    ),
    inputs=(Input("u", "u", "N", -MAX_FORCE, MAX_FORCE, quantity="force"),),
    parameters=(
        Parameter("m_c", 0.2, 0.01, 100.0, "kg", spread=0.1, meaning="mass of the cart"),
        Parameter(
            "mu", 0.5, 0.0, max_friction, "N s/m", spread=0.25, meaning="friction of the cart, 0 to $40(m_c + m_p/4)$"
        ),
        Parameter("m_p", 0.2, 0.01, 100.0, "kg", spread=0.1, meaning="mass of the pole"),
        Parameter("l", 0.5, 0.05, 20.0, "m", spread=0.25, meaning="half the length of the pole"),
        Parameter("g", 9.8, 0.0, 30.0, "m/s^2", meaning="gravity"),
    ),
    dynamics=dynamics,
    cost=cost,
    starts={
        "broad": Uniform((-1.0, -0.5, -np.pi, -1.0), (1.0, 0.5, np.pi, 1.0)),
        "hanging": Uniform((-0.1, -0.1, np.pi - 0.2, -0.1), (0.1, 0.1, np.pi + 0.2, 0.1)),
    },
    nominal=Nominal((3.0, 0.01, 3.0, 1.0, 0.01), (0.001,), horizon=50),
    shown=("phi", "x"),
    plane=("phi", "phid"),
    coverage=(("x", "xd"), ("phi", "phid"), ("phi", "u")),
    catalog="mpcoffline.datasets.catalog",
    mismatch=("mu", 0.0),
    published=True,
)


class CartPoleSwingUpEnv(ControlTask):
    r"""Swing up the pole of a cart with viscous friction, and bring the cart back to the middle.

    ## Description
    A uniform pole is hinged on a cart that a force moves along a track without end. The force swings the pole up and
    keeps it upright, which is unstable, while the cart returns to the middle of the track. With the pole's half-length
    $l$, the masses $m_c$ and $m_p$, $M = m_c + m_p$ and the friction $\mu$ of the cart:

    $$\ddot\varphi = \dfrac{g\sin\varphi + \cos\varphi\,(\mu\dot x - u - m_p l\dot\varphi^2\sin\varphi)/M}
    {l\,(4/3 - m_p\cos^2\varphi/M)}, \qquad
    \ddot x = \dfrac{u - \mu\dot x + m_p l(\dot\varphi^2\sin\varphi - \ddot\varphi\cos\varphi)}{M}$$

    with $\varphi = 0$ upright and positive clockwise in the picture; integrated with one Runge-Kutta (RK4) step of
    $dt = 0.05$ s, the force held.

    ## Rewards
    $r = -L(s, u)$ with the stage cost

    $$L = 2x^2 + \varphi^2 + 0.1\dot x^2 + 0.1\dot\varphi^2 + 0.1u^2$$

    of the state before the step. The best reward of a step is 0.

    ## Success
    The episode is a success if $|\varphi| < 0.3$ at its end.

    ## References
    Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement Learning", arXiv:2301.01667.
    Barto, Sutton, Anderson, "Neuronlike adaptive elements that can solve difficult learning control problems", IEEE
    Transactions on Systems, Man, and Cybernetics, 1983, for the equations.
    """

    plant = PLANT
    picture_size: ClassVar[tuple[int, int]] = (600, 400)
    l: float  # noqa: E741 -- the plant's own name

    def draw(self, canvas: Canvas, moment: Moment) -> None:
        """Draws cart and pole on the track, the way of the tip, the zone of success, the reference and the force."""
        track, axis = 206.0, canvas.height - 44.0
        # A view of 4.8 m, more for long poles, that follows a cart near its edges.
        scale = min(canvas.width / 4.8, 125.0 / (2.0 * self.l))
        half = canvas.width / 2.0 / scale
        x, phi = float(moment.state[0]), float(moment.state[2])
        center = x - np.clip(x, -0.55 * half, 0.55 * half)

        def place(position: ArrayLike, height: ArrayLike = 0.0) -> Array:
            across = canvas.width / 2.0 + (np.asarray(position) - center) * scale
            return np.stack(np.broadcast_arrays(across, track - np.asarray(height) * scale), axis=-1)

        canvas.ruler(axis, center - half, center + half)
        middle = float(place(0.0)[0])
        canvas.dashed([middle, track], [middle, axis], 2.0, style.TARGET)
        # Out of the view, the mark stays at the edge and points there.
        canvas.marker([float(np.clip(middle, 12.0, canvas.width - 12.0)), axis - 9.0], middle, style.TARGET)
        canvas.line([0.0, track], [canvas.width, track], 4.0, style.PALE)
        hinge, reach = place(x), 2.0 * self.l * scale
        canvas.wedge(hinge, reach + 22.0, -SUCCESS_ANGLE, SUCCESS_ANGLE, style.TARGET_ZONE)
        trail = refined(moment.trail, self.angle)
        canvas.trail(place(trail[:, 0]) + reach * clockwise(trail[:, 2]), 5.0, style.TRAIL)
        canvas.box(hinge, 66.0, 34.0, style.INK)
        canvas.line(hinge, hinge + reach * clockwise(phi), 11.0, style.PLANT, rounded=True)
        canvas.disc(hinge, 3.5, style.WHITE)
        caption = [(f"t = {moment.time:.2f} s", style.INK), (f"cost {moment.cost:.2f}", style.INK)]
        if moment.action is not None:
            force = float(moment.action[0])
            side = hinge + np.array([np.copysign(38.0, force), 0.0])
            canvas.arrow(side, side + np.array([80.0 * force / MAX_FORCE, 0.0]), 6.0, style.INPUT)
            caption.append((f"force {signed(force)} N", style.INPUT))
        canvas.caption(caption)


CartPoleSwingUpVectorEnv = register(CartPoleSwingUpEnv)
