"""A learning problem in other units, and what was learned of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.studies.units import Units as Units

Array = NDArray[np.float64]


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
        x, u = units.of(mpc)
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
