"""HOW an MPC is solved; every solver stands behind the protocol :class:`Solver`."""

from __future__ import annotations

import logging
import warnings
from typing import Any

from mpcoffline.errors import UnknownIdError
from mpcoffline.mpc import MPC

from .ddp import CompilerError, DDPSolver
from .interface import Plan, Solution, Solver
from .nlp import IpoptSolver

__all__ = ["SOLVERS", "CompilerError", "DDPSolver", "IpoptSolver", "Plan", "Solution", "Solver", "make_solver"]

logger = logging.getLogger(__name__)

SOLVERS: dict[str, type[Solver]] = {"ddp": DDPSolver, "ipopt": IpoptSolver}


def make_solver(mpc: MPC, name: str = "auto", **options: Any) -> Solver:
    """A solver for an MPC.

    Args:
        mpc: The problem.
        name: ``"ddp"`` (generated C, input bounds only, hundreds of times faster), ``"ipopt"`` (any smooth problem),
            or ``"auto"`` for the fastest that supports the problem; the log says which, and why not a faster one.
        **options: Options of that solver's constructor.

    Returns:
        The solver; its ``name`` says which.

    Raises:
        UnknownIdError: For an unknown name.
        InvalidArgumentError: If the solver named does not support the problem.
        CompilerError: If ``"ddp"`` is named and there is no working C compiler; ``"auto"`` warns and takes ipopt.
    """
    if name == "auto":
        return _fastest(mpc, options)
    if name not in SOLVERS:
        raise UnknownIdError.of("solver", name, ["auto", *SOLVERS])
    return SOLVERS[name](mpc, **options)


def _fastest(mpc: MPC, options: dict[str, Any]) -> Solver:
    """The fastest solver that supports the problem."""
    if mpc.constraints is not None:
        logger.info("Solver: ipopt, as ddp supports no constraints other than input bounds.")
        return IpoptSolver(mpc, **options)
    try:
        solver = DDPSolver(mpc, **options)
    except CompilerError as error:
        # The warnings module shows the same text once.
        warnings.warn(f"Solving with ipopt, which is about 500 times slower than ddp: {error}", stacklevel=3)
        return IpoptSolver(mpc)
    logger.info("Solver: ddp.")
    return solver
