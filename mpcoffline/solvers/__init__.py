"""HOW an MPC is solved; every solver stands behind the protocol :class:`Solver`."""

from __future__ import annotations

from typing import Any

from mpcoffline.errors import UnknownIdError
from mpcoffline.mpc import MPC

from .interface import Plan, Solution, Solver
from .nlp import IpoptSolver

__all__ = ["SOLVERS", "IpoptSolver", "Plan", "Solution", "Solver", "make_solver"]

SOLVERS: dict[str, type[Solver]] = {"ipopt": IpoptSolver}


def make_solver(mpc: MPC, name: str = "auto", **options: Any) -> Solver:
    """A solver for an MPC.

    Args:
        mpc: The problem.
        name: ``"ipopt"``, or ``"auto"`` for the fastest that supports the problem.
        **options: Options of that solver's constructor.

    Raises:
        UnknownIdError: For an unknown name.
    """
    if name == "auto":
        name = "ipopt"
    if name not in SOLVERS:
        raise UnknownIdError.of("solver", name, ["auto", *SOLVERS])
    return SOLVERS[name](mpc, **options)
