"""A learned MPC as plain CasADi functions: its parts, and the whole nonlinear program for any solver of CasADi's."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import casadi as ca
import numpy as np

from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.mpc import MPC

from .casadi_functions import PLAIN, Parts, parts_of, plain_functions, save_functions
from .controller_script import script_of
from .loading import Acting, load_policy

_PROGRAM = ("nlp", "bounds", "start", "plan")
_SCRIPT = "casadi_controller.py"


def export_casadi(policy: Acting | str | PathLike[str], folder: str | PathLike[str]) -> list[Path]:
    """Writes a policy's MPC as CasADi's files, which CasADi loads in Python, MATLAB and C++, without this package.

    ``dynamics.casadi`` (x, u) -> x_next, ``stage_cost.casadi`` (x, u) -> cost and ``terminal_cost.casadi`` (x) -> cost
    are the parts of (MPC), with all that was learned as numbers. The state x is z = [y, past inputs], see
    :class:`~mpcoffline.MPC`. Costs are without discount and without the price of violated soft limits.

    ``nlp.casadi`` is the whole problem, discount and limits included, as CasADi's ``nlpsol`` takes it::

        min_w f(w, p)   s.t.   lbx <= w <= ubx,   lbg <= g(w, p) <= ubg,   p the state now

    with ``bounds.casadi`` () -> lbx, ubx, lbg, ubg; ``start.casadi`` (p, u) -> w of an input sequence ``(nu, N)``, the
    model run with it; and ``plan.casadi`` (w, p) -> x ``(nx, N + 1)``, u ``(nu, N)``. ``casadi_controller.py`` puts
    them together: ``controller()`` is a function of a state and the plan before. From the same plan, ipopt finds the
    inputs that the policy finds.

    Example:
        >>> export_casadi(learner.policy, "controller")
        >>> from casadi_controller import controller  # where CasADi and numpy are installed
        >>> u, plan = controller()(x)

    Args:
        policy: The policy, or the file of one or of a learner; of one that sees outputs, its MPC.
        folder: Where to write; made if missing. Files of the same names are overwritten.

    Returns:
        The files written.

    Raises:
        FileFormatError: If the file is damaged or foreign.
        StorageError: If nothing could be written there.
    """
    check_output_folder(folder, (_SCRIPT, *(f"{name}.casadi" for name in (*PLAIN, *_PROGRAM))))
    mpc = (policy if isinstance(policy, Acting) else load_policy(policy)).mpc
    functions = plain_functions(mpc) | program_of(mpc, parts_of(mpc))
    sizes = f"{mpc.nx}, {mpc.nu}, {mpc.horizon}"
    script = write_file(Path(folder) / _SCRIPT, script_of(mpc, "casadi_controller.txt", SIZES=sizes))
    return [script, *save_functions(functions, folder)]


def program_of(mpc: MPC, parts: Parts) -> dict[str, ca.Function]:
    """Multiple shooting: the functions ``nlp``, ``bounds``, ``start`` and ``plan``.

    w holds v_0, x_1, v_1, ..., v_{N-1}, x_N, where v = [u, slacks]; g holds x_{k+1} - f(x_k, u_k) and the limits of
    stage k, stage by stage. The parts are called, not written out, so that files grow with the problem, not with its
    horizon.
    """
    N, nx, nu, ns, nh = mpc.horizon, mpc.nx, mpc.nu, parts.n_slacks, parts.n_limits
    w, p, inputs = ca.MX.sym("w", N * (nu + ns + nx)), ca.MX.sym("p", nx), ca.MX.sym("u", nu, N)
    pieces = ca.vertsplit(w, nu + ns + nx)
    x, cost, xs, reached = p, ca.MX(0), [p], p
    g: list[ca.MX] = []
    us: list[ca.MX] = []
    rolled: list[ca.MX] = []
    for k, piece in enumerate(pieces):
        v, ahead = piece[: nu + ns], piece[nu + ns :]
        flags = float(k > 0), float(k == N - 1)
        cost += mpc.discount**k * parts.stage_cost(x, v, *flags)
        g += [ahead - parts.ahead(x, v[:nu]), parts.limits(x, v, *flags)]
        xs, us, x = [*xs, ahead], [*us, v[:nu]], ahead
        u = inputs[:, k]
        h = parts.limits(reached, ca.vertcat(u, ca.MX.zeros(ns)), *flags)
        violated = ca.fmax(h[list(parts.soft)], 0.0) if ns else ca.MX(0, 1)
        reached = parts.ahead(reached, u)
        rolled += [u, violated, reached]
    cost += mpc.discount**N * parts.terminal_cost(x)
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    free = np.full(nx, np.inf)
    bounds = [
        np.tile(np.concatenate([low, np.zeros(ns), -free]), N),
        np.tile(np.concatenate([high, np.full(ns, np.inf), free]), N),
        np.tile(np.concatenate([np.zeros(nx), np.full(nh, -np.inf)]), N),
        np.zeros(N * (nx + nh)),
    ]
    return {
        "nlp": ca.Function("nlp", [w, p], [cost, ca.vertcat(*g)], ["x", "p"], ["f", "g"]),
        "bounds": ca.Function("bounds", [], [ca.DM(each) for each in bounds], [], ["lbx", "ubx", "lbg", "ubg"]),
        "start": ca.Function("start", [p, inputs], [ca.vertcat(*rolled)], ["p", "u"], ["x"]),
        "plan": ca.Function("plan", [w, p], [ca.horzcat(*xs), ca.horzcat(*us)], ["w", "p"], ["x", "u"]),
    }
