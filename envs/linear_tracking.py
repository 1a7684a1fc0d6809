"""Linear tracking: drive a point mass with an uncertain linear plant to the origin."""

from __future__ import annotations

import functools
import math
import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import rendering as style
from .arguments import Array, checked_number
from .base import ControlTask
from .plant import Entries, Input, Nominal, Parameter, Plant, State, Uniform, Values, square
from .registry import register
from .rendering import Canvas, Moment, refined, signed

A0 = np.array([[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.9, 0.0], [0.0, 0.0, 0.0, 0.9]])
B0 = np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
DELTA_A = 1e-2 * np.array(
    [
        [0.68, -1.15, -2.29, -2.42],
        [1.57, 2.06, 0.53, 1.15],
        [0.22, 2.17, 1.58, -2.49],
        [1.79, -2.33, 1.15, -1.62],
    ]
)
DELTA_B = 1e-2 * np.array([[1.82, 0.21], [-1.00, -0.39], [-2.36, -1.88], [0.85, 0.74]])

STATE_WEIGHT = np.diag([9.0, 9.0, 1.0, 1.0])
ACTION_WEIGHT = np.diag([0.1, 0.1])

MAX_FORCE = 10.0
# Twice what the plant can reach in 100 steps from a start in the box with any admissible input, at the largest alpha.
MAX_STATE = 1e4
MAX_ALPHA = 4.0
SUCCESS_RADIUS = 0.05


def dynamics(s: Entries, inputs: Entries, p: Values) -> Entries:
    """The next state, A s + B a.

    Column by column: BLAS sums in an order that depends on the machine and on the number of vectors; this does not, so
    that a recorded episode replays bit for bit, alone or among others.
    """
    A, B = p["A"], p["B"]
    free = functools.reduce(operator.add, [A[:, j] * entry for j, entry in enumerate(s)])
    return [free + functools.reduce(operator.add, [B[:, j] * entry for j, entry in enumerate(inputs)])]


def cost(s: Entries, inputs: Entries) -> object:
    """The stage cost s'Ws + a'Ra."""
    x, y, xd, yd = s
    force_x, force_y = inputs
    return 9.0 * square(x) + 9.0 * square(y) + square(xd) + square(yd) + 0.1 * square(force_x) + 0.1 * square(force_y)


PLANT = Plant(
    id="mpcoffline/LinearTracking-v0",
    name="linear",
    dt=0.1,
    states=(
        State("x", "x", "m", limit=MAX_STATE, band=SUCCESS_RADIUS, span=(-1.3, 1.3)),
        State("y", "y", "m", limit=MAX_STATE, band=SUCCESS_RADIUS),
        State("xd", "\\dot x", "m/s", limit=MAX_STATE, span=(-3.0, 3.0)),
        State("yd", "\\dot y", "m/s", limit=MAX_STATE),
    ),
    inputs=(
        Input("F_x", "F_x", "N", -MAX_FORCE, MAX_FORCE, quantity="force"),
        Input("F_y", "F_y", "N", -MAX_FORCE, MAX_FORCE, quantity="force"),
    ),
    parameters=(
        Parameter("A", A0, spread=0.0, meaning=r"the plant's matrix, instead; $b \ge 1$ (see State Space)"),
        Parameter("B", B0, spread=0.0, meaning=r"the plant's input matrix, instead; $b \ge 1$"),
    ),
    discrete=True,
    dynamics=dynamics,
    cost=cost,
    starts={"broad": Uniform([-1.0] * 4, [1.0] * 4)},
    success=lambda s: np.hypot(s[..., 0], s[..., 1]) < SUCCESS_RADIUS,
    nominal=Nominal(np.diag(STATE_WEIGHT).tolist(), np.diag(ACTION_WEIGHT).tolist(), horizon=100),
    max_alpha=MAX_ALPHA,
    shown=("x", "y"),
    plane=("x", "xd"),
    coverage=(("x", "y"), ("xd", "yd"), ("F_x", "F_y")),
    seconds=5.0,
    catalog="mpcoffline.datasets.catalog",
    reference="riccati",
    published=True,
)


class LinearTrackingEnv(ControlTask):
    r"""Drive a point mass to the origin of the plane although its dynamics are not the nominal ones.

    ## Description
    A mass slides on a plane with friction; two forces bring it to the origin. A controller that knows only the nominal
    matrices $A_0, B_0$ meets a model error that grows with $\alpha$:

    $$s_+ = A s + B a, \qquad A = A_0 + \alpha\,\Delta_A, \quad B = B_0 + \alpha\,\Delta_B$$

    sampled every $dt = 0.1$ s. For any $\alpha > 0$ the plant is unstable.

    ## State Space
    The state $s = [x, y, \dot x, \dot y]$ in `info["state"]` is the observation in float64. `state_space`, a
    `Box(float64)`, holds the states that `reset` accepts: $|s_i| \le b$ with the largest $b$ from which no admissible
    input leaves the observation bounds in 100 steps (about 580 at $\alpha = 1$).

    ## Rewards
    $r = -L(s, a)$ with the stage cost

    $$L = 9(x^2 + y^2) + \dot x^2 + \dot y^2 + 0.1(F_x^2 + F_y^2)$$

    of the state before the step. The best reward of a step is 0.

    ## Success
    The episode is a success if $|(x, y)| < 0.05$ at its end.

    ## References
    Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement Learning", arXiv:2301.01667.
    The paper gives no action bounds and no distribution of $s_0$: the ones here are ours.
    """

    plant = PLANT
    trail_steps = 100
    A: Array
    B: Array

    def __init__(
        self, alpha: float = 1.0, *, A: ArrayLike | None = None, B: ArrayLike | None = None, **arguments: Any
    ) -> None:
        self.alpha: float = checked_number("alpha", alpha, 0.0, MAX_ALPHA)
        matrices = plant_matrices(self.alpha)
        A, B = (own if given is None else given for own, given in zip(matrices, (A, B), strict=True))
        super().__init__(A=A, B=B, **arguments)

    def start_bound(self) -> Array:
        """The largest b from which no admissible input leaves the observation bounds, for each coordinate."""
        bound = start_bound(self.A, self.B)
        if not bound >= 1.0:
            raise ValueError(
                f"A, B: expected a plant that stays within {MAX_STATE:g} for 100 steps from |s| <= 1, "
                f"got one that does so from |s| <= {bound:.3g} only."
            )
        return np.full(4, bound)

    def draw(self, canvas: Canvas, moment: Moment) -> None:
        """Draws the plane with the target, and the mass with its way, velocity and force."""
        x, y, xd, yd = map(float, moment.state)
        # The view doubles when the mass comes near its edge.
        half = 1.25 * 2.0 ** max(0, math.ceil(math.log2(max(abs(x), abs(y), 1e-9) / 1.1)))
        scale = canvas.width / 2.0 / half
        origin = np.array([canvas.width, canvas.height]) / 2.0

        def place(points: ArrayLike) -> Array:
            return origin + scale * np.asarray(points) * [1.0, -1.0]

        canvas.grid(origin, scale)
        canvas.disc(origin, max(SUCCESS_RADIUS * scale, 6.0), style.TARGET_ZONE)
        canvas.arc(origin, max(SUCCESS_RADIUS * scale, 6.0), 0.0, 2.0 * np.pi, 2.0, style.TARGET)
        canvas.trail(place(refined(moment.trail, self.angle)[:, :2]), 4.0, style.TRAIL)
        mass = place([x, y])
        speed = math.hypot(xd, yd)
        if speed > 0.0:  # half a second ahead, in the picture at most 110 pixels
            canvas.arrow(mass, mass + np.array([xd, -yd]) / speed * min(0.5 * speed * scale, 110.0), 4.0, style.PLANT)
        caption = [(f"t = {moment.time:.1f} s", style.INK), (f"cost {moment.cost:.2f}", style.INK)]
        if moment.action is not None:
            force = moment.action
            pull = force * [1.0, -1.0] / MAX_FORCE
            rim = mass + 13.0 * pull / max(math.hypot(*pull), 1e-9)
            canvas.arrow(rim, rim + 110.0 * pull, 6.0, style.INPUT)
            caption.append((f"force {signed(force[0], 1)}, {signed(force[1], 1)} N", style.INPUT))
        canvas.disc(mass, 10.0, style.PLANT)
        canvas.caption(caption)


def start_bound(A: Array, B: Array, n_steps: int = 100) -> float:
    """The largest b such that from every |s| <= b no admissible input leaves the observation bounds in an episode."""
    bound, power, forced = MAX_STATE, np.eye(len(A)), np.zeros(len(A))
    for _ in range(n_steps):
        forced += MAX_FORCE * np.abs(power @ B).sum(axis=1)
        power = power @ A
        bound = min(bound, float(((MAX_STATE - forced) / np.abs(power).sum(axis=1)).min()))
    return bound


def plant_matrices(alpha: float) -> tuple[Array, Array]:
    """The matrices A ``(4, 4)`` and B ``(4, 2)`` of the plant; ``alpha = 0`` is the nominal model."""
    return A0 + alpha * DELTA_A, B0 + alpha * DELTA_B


LinearTrackingVectorEnv = register(LinearTrackingEnv)
