"""How a solve ended, and its figures: for programs; what people read stands in ``Solution.words``."""

from __future__ import annotations

from enum import StrEnum
from typing import NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray


class Status(StrEnum):
    """How the solve of a problem ended. A text, equal to its value: ``status == "stalled"`` holds, too."""

    #: The conditions of an optimum hold: the only one that ``success`` comes with.
    CONVERGED = "converged"
    #: The iterations were used up.
    ITERATION_LIMIT = "iteration limit"
    #: The time was used up.
    TIME_LIMIT = "time limit"
    #: No step lowers the cost, though its derivatives promise that one does; most often a kink.
    STALLED = "stalled"
    #: Model or cost gave NaN or infinity.
    NOT_FINITE = "not finite"
    #: A hard constraint is violated at a point from which no direction leads closer to feasible ones.
    INFEASIBLE = "infeasible"
    #: A hard constraint is violated.
    VIOLATED = "violated"
    #: The conditions of an optimum do not hold.
    NOT_OPTIMAL = "not optimal"

    def __repr__(self) -> str:
        """As a text's, so that lists of them are easy to read."""
        return repr(self.value)


class Stats(TypedDict):
    """Figures of a call of ``solve``.

    Attributes:
        iterations: Of each problem, ``(B,)``.
        time: In s, of all.
        all_starts: Whether problems that failed were tried from all starts, of each ``(B,)`` or of all.
        partial: Whether some iterations were all that was asked for: neither a solution nor a failure; left out where
            the solve was carried through.
        words: What :class:`Status` says with its particulars, one text a problem, e.g. the constraint that is violated;
            left out where there are none.
        residual: Of the conditions of an optimum, relative, ``(B,)``: lqr and ipopt.
        violation: Of the constraint that is violated most, ``(B,)``: ipopt, and ddp where there are limits.
        violation_now: By how much the given state itself violates the hard limits that no input can change at stage 0,
            ``(B,)``, in what ddp measures each limit by: reported, not imposed.
        predicted_decrease: Of the cost by the quadratic model at the plan, ``(B,)``: ddp.
    """

    iterations: NDArray[np.int64]
    time: float
    all_starts: NotRequired[NDArray[np.bool_] | bool]
    partial: NotRequired[bool]
    words: NotRequired[list[str]]
    residual: NotRequired[NDArray[np.float64]]
    violation: NotRequired[NDArray[np.float64]]
    violation_now: NotRequired[NDArray[np.float64]]
    predicted_decrease: NotRequired[NDArray[np.float64]]
