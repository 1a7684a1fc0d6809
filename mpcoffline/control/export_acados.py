"""A learned MPC as a controller of acados: a script, and its functions as CasADi's files."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .casadi_functions import PLAIN, learned_limits, plain_functions, save_functions
from .controller_script import array_text, script_of
from .loading import Acting, load_policy

_SCRIPT = "acados_controller.py"


def export_acados(policy: Acting | str | PathLike[str], folder: str | PathLike[str]) -> list[Path]:
    """Writes a policy's MPC as a script for `acados <https://docs.acados.org>`_, with all that was learned as numbers.

    ``acados_controller.py`` holds ``ocp()``, an ``AcadosOcp`` of the same problem (MPC): model, costs, discount, input
    bounds, and limits, hard and soft, these with acados's own slacks; ``solver()``, its ``AcadosOcpSolver``, which
    compiles the C that acados writes; and ``Controller``, which decides step by step. ``dynamics.casadi`` (x, u) ->
    x_next, ``stage_cost.casadi`` (x, u) -> cost, ``terminal_cost.casadi`` (x) -> cost, ``limits.casadi`` (x, u) -> h
    and ``end_limits.casadi`` (x) -> h, with h <= 0, are its functions, which any program with CasADi loads. The state
    is z = [y, past inputs], see :class:`~mpcoffline.MPC`. From the same plan it finds the same inputs.

    Example:
        >>> export_acados(learner.policy, "controller")
        >>> from acados_controller import Controller  # where acados and its acados_template are installed
        >>> u = Controller().solve(x)

    Args:
        policy: The policy, or the file of one or of a learner; of one that sees outputs, its MPC, which takes states.
        folder: Where to write; made if missing. Files of the same names are overwritten.

    Returns:
        The files written.

    Raises:
        FileFormatError: If the file is damaged or foreign.
        StorageError: If nothing could be written there.
    """
    check_output_folder(folder, (_SCRIPT, *(f"{name}.casadi" for name in (*PLAIN, "limits", "end_limits"))))
    mpc = (policy if isinstance(policy, Acting) else load_policy(policy)).mpc
    limits = _limits(mpc)
    text = script_of(
        mpc,
        "acados_controller.txt",
        SIZES=f"{mpc.nx}, {mpc.nu}",
        PRICES=", ".join(map(array_text, limits.prices)),
        ENDPRICES=", ".join(map(array_text, limits.end_prices)),
        FIRST=repr(limits.first),
    )
    functions = plain_functions(mpc) | {"limits": limits.along, "end_limits": limits.end}
    return [write_file(Path(folder) / _SCRIPT, text), *save_functions(functions, folder)]


class _Limits(NamedTuple):
    """What acados takes: h <= 0 along the horizon and at its end, each with its prices, ``(l1, l2)``.

    ``first`` says which of those along the horizon the first input can change; the state there is given.
    """

    along: ca.Function
    end: ca.Function
    prices: tuple[Array, Array]
    end_prices: tuple[Array, Array]
    first: list[int]


def _limits(mpc: MPC) -> _Limits:
    x, u = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu)
    along, end, l1, l2 = ca.SX(0, 1), ca.SX(0, 1), np.zeros(0), np.zeros(0)
    skipped, first = 0, []
    limits = learned_limits(mpc, x, u)
    if limits is not None:
        along, end, l1, l2 = limits.stage, limits.end, limits.l1, limits.l2
        skipped, first = limits.n_stage, np.flatnonzero(limits.by_input).tolist()
    n = along.numel()
    return _Limits(
        ca.Function("limits", [x, u], [ca.densify(along)], ["x", "u"], ["h"]),
        ca.Function("end_limits", [x], [ca.densify(end)], ["x"], ["h"]),
        (l1[:n], l2[:n]),
        (l1[skipped:], l2[skipped:]),
        first,
    )
