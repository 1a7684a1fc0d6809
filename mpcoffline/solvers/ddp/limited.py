"""What limits besides input bounds add to a solver's calls of the kernel."""

from __future__ import annotations

import ctypes
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers.limits import limits_of
from mpcoffline.solvers.status import Status

#: Of what a limit is measured by: what counts as kept, as in ``constraints.c``.
FEASIBLE = 1e-6


class Limited:
    """The limits of an MPC as the kernel knows them: names of their elements, and the arrays of a call.

    Args:
        mpc: A problem that has limits.
    """

    labels: tuple[str, ...]
    horizon: int

    def __init__(self, mpc: MPC) -> None:
        symbols = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
        limits = limits_of(mpc, *symbols)
        assert limits is not None  # noqa: S101 -- the argument is one that has limits; narrows the type
        self.labels, self.horizon = limits.labels, mpc.horizon

    def results(self, n: int) -> dict[str, NDArray[Any]]:
        """Where the kernel writes what it finds of n problems."""
        return {
            "multipliers": np.empty((n, self.horizon + 4, len(self.labels))),
            "violation": np.empty(n),
            "now": np.empty(n),
            "worst": np.empty(n, dtype=np.int64),
            "amount": np.empty(n),
        }

    def check(self, multipliers: Array, n: int) -> None:
        """Refuses the multipliers of other limits, or of another number of problems.

        Raises:
            InvalidArgumentError: Names both shapes.
        """
        expected = n, self.horizon + 4, len(self.labels)
        if multipliers.shape != expected:
            raise InvalidArgumentError(
                "warm_start.multipliers", expected=f"shape {expected}", actual=f"shape {multipliers.shape}"
            )

    @staticmethod
    def unknown(multipliers: Array) -> NDArray[np.bool_]:
        """Rows of which nothing is known, ``(B,)``."""
        with np.errstate(invalid="ignore"):
            rows = multipliers.reshape(len(multipliers), -1)
            return np.asarray(rows @ np.zeros(rows.shape[1]) != 0.0)

    def words(self, result: dict[str, NDArray[Any]], ended: list[Status]) -> list[str]:
        """How each solve ended, with the limit that is violated where it failed."""
        words = []
        found = (result[name].tolist() for name in ("worst", "amount", "violation"))
        for status, worst, amount, violation in zip(ended, *found, strict=True):
            stage, j = divmod(worst, len(self.labels))
            named = status is not Status.CONVERGED and violation > FEASIBLE and amount < np.inf
            words.append(
                status + (f": {self.labels[j]!r} at stage {stage} is violated by {amount:.3g}" if named else "")
            )
        return words


def better(new: dict[str, NDArray[Any]], old: dict[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Where a second result of the same problems is taken: it is solved, or keeps the limits better, or is cheaper."""
    cheaper = ~(new["J"] >= old["J"])
    if "violation" in new:
        worse, before = (np.where(result["violation"] > FEASIBLE, result["violation"], 0.0) for result in (new, old))
        cheaper = (worse < before) | ((worse == before) & cheaper)
    return np.asarray((new["status"] == 0) | cheaper)


def address(array: NDArray[Any]) -> int:
    """Where the first number of an array is; three times faster than ``array.ctypes.data``."""
    buffer: Any = array  # that arrays are buffers is in numpy's types from Python 3.12 on
    return ctypes.addressof(ctypes.c_char.from_buffer(buffer)) if array.size else 0
