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
from .interface import SOLVERS, Solution, Solver
from .ipopt.solver import IpoptSolver
from .lqr import LQRSolver
from .options import check_options
from .plan import Plan
from .softening import softened
from .status import Stats, Status

__all__ = [
    "SOLVERS",
    "CompilerError",
    "DDPSolver",
    "IpoptSolver",
    "LQRSolver",
    "Plan",
    "Solution",
    "Solver",
    "Stats",
    "Status",
    "make_solver",
    "softened",
]

logger = logging.getLogger(__name__)


def make_solver(mpc: MPC, name: str = "auto", **options: Any) -> Solver:
    """A solver for an MPC.

    Args:
        mpc: The problem.
        name: ``"lqr"`` (linear model, quadratic costs, input bounds: exact), ``"ddp"`` (any smooth
            problem of plain arithmetic; generated C, hundreds of times faster than ipopt), ``"ipopt"`` (any smooth
            problem), any other in ``mpcoffline.solvers.SOLVERS``, or ``"auto"`` for the fastest that takes the problem
            and has the options given; its ``reason`` and the log say why not a faster one. The choice rests on the
            problem's structure alone, not on how solves go: that depends on states that nobody knows yet, and changing
            over would be hundreds of times slower unasked. Where ddp often fails, name ipopt, or give the policy
            ``rescue="ipopt"``.
        **options: Options of that solver's constructor.

    Returns:
        The solver; its ``name`` says which.

    Raises:
        UnknownIdError: For an unknown name.
        InvalidArgumentError: If the solver named does not support the problem, or for an option that it has not.
        CompilerError: If ``"ddp"`` is named and there is no working C compiler; ``"auto"`` warns and takes another.
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
    kinds = [kind for each, kind in SOLVERS.items() if name in (each, "auto")]
    known = sorted({option for kind in kinds for option in _defaults(kind)})
    if unknown := [option for option in options if option not in known]:
        kind = "the solvers" if name == "auto" else f"the {name} solver"
        raise InvalidArgumentError(
            f"options of {kind}", expected=f"some of {', '.join(known)}", actual=", ".join(unknown)
        )
    check_options(options)


def changed_options(solver: Solver) -> dict[str, Any]:
    """The options with which a solver was made, as far as they are not its class's defaults."""
    defaults = _defaults(type(solver))
    return {name: value for name, value in solver.options.items() if name not in defaults or value != defaults[name]}


def _fastest(mpc: MPC, options: dict[str, Any]) -> Solver:
    """The first of :data:`SOLVERS` that takes the problem, by their ``relative_speed``."""
    refusals: list[str] = []
    lost: tuple[type[Solver], str] | None = None  # a faster one that there is no compiler for
    for name, kind in sorted(SOLVERS.items(), key=lambda item: -item[1].relative_speed):
        known = _defaults(kind)
        given = {o: value for o, value in options.items() if o in known or lost is None or o not in _defaults(lost[0])}
        if unknown := [option for option in given if option not in known]:
            refusals.append(f"{name} has no option {', '.join(unknown)}")
            continue
        try:
            solver = kind(mpc, **given)
        except CompilerError as error:
            lost = kind, f"{name}: {error}"
            refusals.append(f"{name} has no compiler")
        except InvalidArgumentError as error:
            if error.name in options:
                raise
            refusals.append(f"{name} does not support {error.actual}")
        else:
            if lost is not None:  # the warnings module shows the same text once
                slower = lost[0].relative_speed / kind.relative_speed
                text = f"Solving with {name}, which is about {slower:.0f} times slower than {lost[1]}"
                warnings.warn(text, stacklevel=3)
            solver.reason = f"{name} is the fastest that fits" + "".join(f"; {refusal}" for refusal in refusals)
            logger.info("Solver: %s.", solver.reason)
            return solver
    raise InvalidArgumentError("options", expected="options of one solver", actual="; ".join(refusals))


def _defaults(kind: type[Solver]) -> dict[str, Any]:
    """The options of a solver's constructor, and their defaults."""
    parameters = inspect.signature(kind.__init__).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY}
