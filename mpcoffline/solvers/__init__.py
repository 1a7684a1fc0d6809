"""HOW an MPC is solved; every solver stands behind the protocol :class:`Solver`."""

from __future__ import annotations

import inspect
import logging
import warnings
from collections.abc import Mapping
from typing import Any

from mpcoffline.core.checks import check_known
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC

from .ddp import CompilerError, DDPSolver
from .interface import Plan, Solution, Solver
from .ipopt.solver import IpoptSolver
from .lqr import LQRSolver
from .options import check_options

__all__ = [
    "SOLVERS",
    "CompilerError",
    "DDPSolver",
    "IpoptSolver",
    "LQRSolver",
    "Plan",
    "Solution",
    "Solver",
    "make_solver",
]

logger = logging.getLogger(__name__)

# In the order in which "auto" tries them: the fastest first.
SOLVERS: dict[str, type[Solver]] = {"lqr": LQRSolver, "ddp": DDPSolver, "ipopt": IpoptSolver}


def make_solver(mpc: MPC, name: str = "auto", **options: Any) -> Solver:
    """A solver for an MPC.

    Args:
        mpc: The problem.
        name: ``"lqr"`` (linear model, quadratic costs, input bounds: exact), ``"ddp"`` (input bounds only; generated C,
            hundreds of times faster than ipopt), ``"ipopt"`` (any smooth problem), or ``"auto"`` for the fastest that
            supports the problem and has the options given; its ``reason`` and the log say why not a faster one. The
            choice rests on the problem's structure alone, not on how solves go: that depends on states that nobody
            knows yet, and changing over would be hundreds of times slower unasked. Where ddp often fails, name ipopt,
            or give the policy ``rescue="ipopt"``.
        **options: Options of that solver's constructor.

    Returns:
        The solver; its ``name`` says which.

    Raises:
        UnknownIdError: For an unknown name.
        InvalidArgumentError: If the solver named does not support the problem, or for an option that it has not.
        CompilerError: If ``"ddp"`` is named and there is no working C compiler; ``"auto"`` warns and takes ipopt.
    """
    check_solver(name, options)
    return _fastest(mpc, options) if name == "auto" else SOLVERS[name](mpc, **options)


def check_solver(name: str, options: Mapping[str, Any]) -> None:
    """Refuses a solver or options that there are not, without building anything.

    Args:
        name: As of :func:`make_solver`.
        options: Options of that solver's constructor.

    Raises:
        UnknownIdError: For an unknown name.
        InvalidArgumentError: For an option that the solver has not, or a value out of range.
    """
    check_known("solver", name, ["auto", *SOLVERS])
    known = _options(name) if name != "auto" else sorted({option for each in SOLVERS for option in _options(each)})
    if unknown := [option for option in options if option not in known]:
        kind = "the solvers" if name == "auto" else f"the {name} solver"
        raise InvalidArgumentError(
            f"options of {kind}", expected=f"some of {', '.join(known)}", actual=", ".join(unknown)
        )
    check_options(options)


def _fastest(mpc: MPC, options: dict[str, Any]) -> Solver:
    """The first of :data:`SOLVERS` that supports the problem."""
    refusals: list[str] = []
    no_compiler = ""
    for name, solver_class in SOLVERS.items():
        if unknown := _unknown_options(name, options):
            refusals.append(f"{name} has no option {', '.join(unknown)}")
            continue
        try:
            solver = solver_class(mpc, **options)
        except CompilerError as error:
            no_compiler = str(error)
            refusals.append(f"{name} has no compiler")
            options = {key: value for key, value in options.items() if key in _options("ipopt")}
        except InvalidArgumentError as error:
            if error.name in options or name == "ipopt":
                raise
            refusals.append(f"{name} does not support {error.actual}")
        else:
            if no_compiler and name == "ipopt":  # the warnings module shows the same text once
                text = f"Solving with ipopt, which is about 500 times slower than ddp: {no_compiler}"
                warnings.warn(text, stacklevel=3)
            solver.reason = f"{name} is the fastest that fits" + "".join(f"; {refusal}" for refusal in refusals)
            logger.info("Solver: %s.", solver.reason)
            return solver
    raise InvalidArgumentError("options", expected="options of one solver", actual="; ".join(refusals))


def _options(name: str) -> list[str]:
    """The options of a solver's constructor."""
    parameters = inspect.signature(SOLVERS[name].__init__).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]


def _unknown_options(name: str, options: dict[str, Any]) -> list[str]:
    return [option for option in options if option not in _options(name)]
