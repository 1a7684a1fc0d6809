"""A learned MPC as a controller of do-mpc: a script, and its functions as CasADi's files."""

from __future__ import annotations

import re
from importlib import resources
from importlib.metadata import version
from os import PathLike
from pathlib import Path

import numpy as np

from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.mpc import MPC
from mpcoffline.mpc.rest import at_rest

from .casadi_functions import parts_of, save_functions
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
        policy: The policy, or the file of one or of a learner; of one that sees outputs, its MPC, which takes states.
        folder: Where to write; made if missing. Files of the same names are overwritten.

    Returns:
        The files written.

    Raises:
        FileFormatError: If the file is damaged or foreign.
        StorageError: If nothing could be written there.
    """
    check_output_folder(folder, (_SCRIPT, *(f"{name}.casadi" for name in _FUNCTIONS)))
    mpc = (policy if isinstance(policy, Acting) else load_policy(policy)).mpc
    parts = parts_of(mpc)
    script = write_file(Path(folder) / _SCRIPT, _script(mpc, (parts.n_slacks, parts.n_limits)))
    return [script, *save_functions(parts.functions, folder)]


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
