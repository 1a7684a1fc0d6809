"""A learning problem in other units: what an engineer who measures in mm, kW and minutes would have written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline import MPC, Model, Parameter, QuadraticCost, TransitionTable

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Units:
    """New numbers are the old ones times these; the cost has an offset besides.

    Attributes:
        states: ``(nx,)``, or one number.
        inputs: ``(nu,)``, or one number.
        cost: Positive.
        offset: Added to the logged cost, in the old unit.
    """

    states: ArrayLike = 1.0
    inputs: ArrayLike = 1.0
    cost: float = 1.0
    offset: float = 0.0

    def table(self, table: TransitionTable) -> TransitionTable:
        """The log."""
        s, a, cost, reached, ended = table.values()
        x, u = np.asarray(self.states), np.asarray(self.inputs)
        costs = self.cost * (cost + self.offset)
        return TransitionTable.from_arrays(x * s, u * a, costs, x * reached, ended, episode_ids=table.episode_ids)

    def mpc(self, mpc: MPC) -> MPC:
        """The MPC: the same model parameters, the cost's weights in the new units."""
        x, u = self._of(mpc)
        function, space = mpc.model.function, mpc.model.space

        def step(state: Any, action: Any, p: dict[str, Any]) -> Any:
            flat = ca.vertcat(*(block.flat(p[block.name]) for block in space))
            return x * function(state / x, action / u, flat)

        parameters = {b.name: Parameter(b.value, *(v.reshape(b.shape) for v in (b.low, b.high))) for b in space}
        return MPC(
            model=Model(step, mpc.nx, mpc.nu, mpc.model.dt, parameters, discrete=True),
            stage_cost=self._cost(mpc.stage_cost, x, u),
            terminal_cost=self._cost(mpc.terminal_cost, x, u),
            horizon=mpc.horizon,
            discount=mpc.discount,
            action_low=u * np.asarray(mpc.action_low),
            action_high=u * np.asarray(mpc.action_high),
        )

    def _of(self, mpc: MPC) -> tuple[Array, Array]:
        return np.broadcast_to(self.states, mpc.nx), np.broadcast_to(self.inputs, mpc.nu)

    def _cost(self, cost: Any, x: Array, u: Array) -> Any:
        if not isinstance(cost, QuadraticCost):
            return cost
        old = cost.values
        parts: dict[str, Any] = {"W": self.cost * cost.W / np.outer(x, x), "x_ref": x * old["x_ref"]}
        if cost.nu:
            parts |= {"R": self.cost * cost.R / np.outer(u, u), "u_ref": u * old["u_ref"]}
        return QuadraticCost(constant=self.cost * float(old["constant"]), **parts)


@dataclass(frozen=True)
class Learned:
    """What was learned, in the old units."""

    model: Array
    W: Array
    R: Array
    terminal: Array = field(repr=False)
    value: Array = field(repr=False)

    @classmethod
    def of(cls, learner: Any, units: Units, states: Array) -> Learned:
        """Of a fitted learner; terminal cost and V as differences from those of the first of some states, ``(n,)``."""
        mpc = learner.mpc
        x, u = units._of(mpc)
        stage = mpc.stage_cost
        terminal = mpc.terminal_function((x * states).T, mpc.theta).full().ravel() / units.cost
        value = learner.value_function.predict(x * states) / units.cost
        model = mpc.theta[mpc.space.mask(("model",))]
        W, R = (w * np.outer(d, d) / units.cost for w, d in ((stage.W, x), (stage.R, u)))
        return cls(model, W, R, terminal - terminal[0], value - value[0])

    def differences(self, other: Learned) -> dict[str, float]:
        """Largest differences, relative to the largest number of each kind."""
        return {
            name: float(np.abs(getattr(other, name) - mine).max() / max(float(np.abs(mine).max()), 1e-300))
            for name, mine in vars(self).items()
        }


def powers(n: int, seed: int) -> Sequence[float]:
    """Powers of two between 2^-20 and 2^20."""
    return [float(2.0**k) for k in np.random.default_rng(seed).integers(-20, 20, n)]
