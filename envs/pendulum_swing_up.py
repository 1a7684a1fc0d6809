"""Pendulum swing-up: a torque-limited pendulum that must gather momentum to stand upright."""

from __future__ import annotations

import numpy as np

from . import rendering as style
from .base import ControlTask
from .plant import Entries, Input, Nominal, Parameter, Plant, State, Uniform, Values, square
from .registry import register
from .rendering import Canvas, Moment, clockwise, refined, signed

MAX_TORQUE = 2.0
SUCCESS_ANGLE = 0.3  # rad from upright


def dynamics(y: Entries, inputs: Entries, p: Values) -> Entries:
    """The equation of motion, d[phi, phid]/dt."""
    _, sin, phid = y
    (u,) = inputs
    return phid, 1.5 * p["g"] / p["l"] * sin + 3.0 / (p["m"] * p["l"] ** 2) * u


def cost(s: Entries, inputs: Entries) -> object:
    """The stage cost."""
    phi, phid = s
    (u,) = inputs
    return square(phi) + 0.1 * square(phid) + 0.1 * square(u)


PLANT = Plant(
    id="mpcoffline/PendulumSwingUp-v0",
    name="pendulum",
    dt=0.05,
    states=(
        State("phi", "\\varphi", "rad", quantity="angle", angle=True, band=SUCCESS_ANGLE),
        # Gravity and torque add at most 20.7 rad/s^2, 103.5 rad/s in the 5 s of an episode.
        State("phid", "\\dot\\varphi", "rad/s", limit=200.0, start=90.0, quantity="speed", span=(-9.0, 9.0)),
    ),
    inputs=(Input("u", "u", "N m", -MAX_TORQUE, MAX_TORQUE, quantity="torque"),),
    parameters=(
        Parameter("m", 1.0, 0.01, 100.0, "kg", spread=0.5, meaning="mass"),
        Parameter("l", 1.0, 0.05, 20.0, "m", spread=0.5, meaning="length"),
        Parameter("g", 9.8, 0.0, 30.0, "m/s^2", meaning="gravity"),
    ),
    dynamics=dynamics,
    cost=cost,
    starts={
        "broad": Uniform((-np.pi, -1.0), (np.pi, 1.0)),
        "hanging": Uniform((-0.2, -0.1), (0.2, 0.1), around=(np.pi, 0.0)),
    },
    nominal=Nominal((1.0, 1.0, 0.1), (0.1,), horizon=50),
    shown=("phi", "phid"),
    plane=("phi", "phid"),
    coverage=(("phi", "phid"), ("phi", "u")),
    catalog="mpcoffline.datasets.catalog",
    mismatch=("l", 1.3),  # gravity and input share it
    published=True,
)


class PendulumSwingUpEnv(ControlTask):
    r"""Swing a rod up with a torque too weak to lift it directly, and hold it upright.

    ## Description
    A uniform rod hangs from a hinge with a motor. The motor's torque does not hold the rod when it is level, so that
    the rod has to swing to and fro until it has gathered enough momentum to stand upright, which is unstable.

    $$\ddot\varphi = \frac{3g}{2l}\sin\varphi + \frac{3}{m l^2}u$$

    with $\varphi = 0$ upright and positive clockwise in the picture; integrated with one Runge-Kutta (RK4) step of
    $dt = 0.05$ s, the torque held. There is no friction.

    ## Rewards
    $r = -L(s, u)$ with the stage cost

    $$L = \varphi^2 + 0.1\dot\varphi^2 + 0.1u^2$$

    of the state before the step. The best reward of a step is 0.

    ## Success
    The episode is a success if $|\varphi| < 0.3$ at its end.

    ## References
    Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement Learning", arXiv:2301.01667.
    The plant is that of Gymnasium's `Pendulum` with other constants and a Runge-Kutta step.
    """

    plant = PLANT

    def draw(self, canvas: Canvas, moment: Moment) -> None:
        """Draws the rod, the way of its tip, the zone of success around upright and the torque."""
        hinge, reach = np.array([canvas.width / 2, canvas.height / 2 + 14.0]), 215.0
        canvas.wedge(hinge, reach, -SUCCESS_ANGLE, SUCCESS_ANGLE, style.TARGET_ZONE)
        canvas.arc(hinge, reach, 0.0, 2.0 * np.pi, 1.5, style.PALE)
        canvas.dashed(hinge, hinge - np.array([0.0, reach]), 2.0, style.TARGET)
        canvas.trail(hinge + reach * clockwise(refined(moment.trail, self.angle)[:, 0]), 5.0, style.TRAIL)
        phi = float(moment.state[0])
        canvas.line(hinge, hinge + reach * clockwise(phi), 15.0, style.PLANT, rounded=True)
        canvas.disc(hinge, 13.0, style.INK)
        canvas.disc(hinge, 5.0, style.WHITE)
        caption = [(f"t = {moment.time:.2f} s", style.INK), (f"cost {moment.cost:.2f}", style.INK)]
        if moment.action is not None:
            torque = float(moment.action[0])
            edge = phi + np.copysign(0.15, torque)
            canvas.curved_arrow(hinge, 80.0, edge, 1.4 * torque / MAX_TORQUE, 6.0, style.INPUT)
            caption.append((f"torque {signed(torque)} N m", style.INPUT))
        canvas.caption(caption)


PendulumSwingUpVectorEnv = register(PendulumSwingUpEnv)
