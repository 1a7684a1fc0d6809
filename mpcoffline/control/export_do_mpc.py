"""A learned MPC as a controller of do-mpc: a script, and its functions as CasADi's files."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from mpcoffline.core.outputs import check_output_folder, write_file

from .casadi_functions import parts_of, save_functions
from .controller_script import script_of
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
    sizes = f"{mpc.nx}, {mpc.nu}, {parts.n_slacks}, {parts.n_limits}"
    script = write_file(Path(folder) / _SCRIPT, script_of(mpc, "do_mpc_controller.txt", SIZES=sizes))
    return [script, *save_functions(parts.functions, folder)]
