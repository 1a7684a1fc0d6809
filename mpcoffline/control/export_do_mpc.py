"""A learned MPC as a controller of do-mpc: a script, and its functions as CasADi's files."""

from __future__ import annotations

import re
from importlib import resources
from importlib.metadata import version
from os import PathLike
from pathlib import Path

import casadi as ca
import numpy as np

from mpcoffline.core.errors import StorageError
from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.mpc import MPC
from mpcoffline.mpc.rest import at_rest
from mpcoffline.solvers.limits import limits_of

from .loading import Acting, load_policy

_FUNCTIONS = ("ahead", "stage_cost", "terminal_cost", "limits")
_SCRIPT = "do_mpc_controller.py"


def export_do_mpc(policy: Acting | str | PathLike[str], folder: str | PathLike[str]) -> list[Path]:
    """Writes a policy's MPC as a script for `do-mpc <https://www.do-mpc.com>`_, with all that was learned as numbers.

    ``do_mpc_controller.py`` holds ``controller()``, a ``do_mpc.controller.MPC`` of the same problem (MPC): model,
    costs, discount, input bounds, and limits, hard and soft; ``ahead.casadi``, ``stage_cost.casadi``,
    ``terminal_cost.casadi`` and ``limits.casadi`` are its functions, which any program with CasADi loads. The state is
    z = [y, past inputs], see :class:`~mpcoffline.MPC`. From the same plan it finds the same inputs.

    Example:
        >>> export_do_mpc(learner.policy, "controller")
        >>> from do_mpc_controller import controller  # where do-mpc is installed
        >>> u = controller().make_step(x)

    Args:
        policy: The policy, or the file of one or of a learner; of one that sees outputs, its MPC.
        folder: Where to write; made if missing. Files of the same names are overwritten.

    Returns:
        The files written.

    Raises:
        FileFormatError: If the file is damaged or foreign.
        StorageError: If nothing could be written there.
    """
    names = (_SCRIPT, *(f"{name}.casadi" for name in _FUNCTIONS))
    check_output_folder(folder, names)
    mpc = (policy if isinstance(policy, Acting) else load_policy(policy)).mpc
    functions, sizes = _functions(mpc)
    script = write_file(Path(folder) / _SCRIPT, _script(mpc, sizes))
    paths = [script]
    for name, function in functions.items():
        path = Path(folder) / f"{name}.casadi"
        try:
            function.save(str(path))
        except RuntimeError as error:
            raise StorageError(str(path), expected="a file that can be written", actual=str(error)[:200]) from error
        paths.append(path)
    return paths


def _functions(mpc: MPC) -> tuple[dict[str, ca.Function], tuple[int, int]]:
    """The functions of x and v = [u, slacks], and the numbers of slacks and limits.

    What holds at the end is imposed on the successor of the last stage: do-mpc knows no other limits there.
    """
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX(mpc.theta)
    imposed, last = ca.SX.sym("imposed"), ca.SX.sym("last")
    reached, cost = mpc.dynamics_function(x, u, theta), mpc.stage_function(x, u, theta)
    h, slacks = ca.SX(0, 1), ca.SX(0, 1)
    limits = limits_of(mpc, x, u, theta)
    if limits is not None:
        n, bounds = limits.n_stage, limits.n_bounds
        stages = ca.vertsplit(limits.stage) if limits.stage.numel() else []
        # At the first stage, what no input changes is no matter of the controller.
        along = [each if free else imposed * each for each, free in zip(stages, limits.by_input, strict=False)]
        end = last * ca.substitute(limits.end, x, reached)
        h = ca.vertcat(*along, end)
        places = [*range(n + bounds), *range(n, len(limits.labels))]  # whose limit each element of h is
        soft = [i for i, j in enumerate(places) if np.isfinite(limits.l1[j])]
        slacks = ca.SX.sym("slacks", len(soft))
        for k, i in enumerate(soft):
            h[i] -= slacks[k]
            weight = mpc.discount if i >= n + bounds else 1.0  # at the end, a step later
            cost += weight * (limits.l1[places[i]] * slacks[k] + limits.l2[places[i]] * slacks[k] ** 2)
    v = ca.vertcat(u, slacks)
    given = [x, v, imposed, last]
    functions = {
        "ahead": ca.Function("ahead", [x, u], [ca.densify(reached)]),
        "stage_cost": ca.Function("stage_cost", given, [ca.densify(cost)]),
        "terminal_cost": ca.Function("terminal_cost", [x], [ca.densify(mpc.terminal_function(x, theta))]),
        "limits": ca.Function("limits", given, [ca.densify(h)]),
    }
    return functions, (slacks.numel(), h.numel())


def _script(mpc: MPC, sizes: tuple[int, int]) -> str:
    layout = mpc.layout
    states = [*map(str, layout.y_labels), *(f"{name}, an input of an earlier step" for name in layout.names)]
    arrays = ", ".join(map(_array, (mpc.action_low, mpc.action_high, mpc.usual_input)))
    replaced = {
        "CASADI": version("casadi"),
        "STATES": "\n".join(f"    x[{i}]  {name}" for i, name in enumerate(states)),
        "INPUTS": "\n".join(f"    u[{i}]  {label}" for i, label in enumerate(layout.u_labels)),
        "SIZES": f"{mpc.nx}, {mpc.nu}, {sizes[0]}, {sizes[1]}",
        "DT": repr(float(mpc.model.dt)),
        "HORIZON": str(mpc.horizon),
        "DISCOUNT": repr(float(mpc.discount)),
        "BOUNDS": arrays,
        "REST": _array(at_rest(mpc)),
    }
    text = resources.files(__package__).joinpath("do_mpc_controller.txt").read_text(encoding="utf-8")
    return re.sub(r"@([A-Z]+)@", lambda match: replaced[match[1]], text)


def _array(values: object) -> str:
    numbers = [repr(float(v)).replace("inf", "np.inf") for v in np.asarray(values, dtype=np.float64).ravel()]
    return f"np.array([{', '.join(numbers)}])"
