"""The C source of a DDP solver for one MPC: its functions and derivatives, in front of the fixed kernel."""

from __future__ import annotations

from importlib import resources

import casadi as ca
import numpy as np

from mpcoffline.errors import InvalidArgumentError
from mpcoffline.mpc import MPC
from mpcoffline.mpc.expressions import expanded, instructions

_INFIX = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
_FORMATS = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_FABS: "vd_abs({0})",
    ca.OP_SIGN: "vd_bool({0} > 0.0) - vd_bool({0} < 0.0)",
    ca.OP_NOT: "vd_bool({0} == 0.0)",
    ca.OP_FMIN: "vd_min({0}, {1})",
    ca.OP_FMAX: "vd_max({0}, {1})",
    ca.OP_POW: "vd_pow({0}, {1})",
    ca.OP_CONSTPOW: "vd_pow({0}, {1})",
    ca.OP_ATAN2: "vd_atan2({0}, {1})",
    ca.OP_HYPOT: "vd_hypot({0}, {1})",
    ca.OP_FMOD: "vd_fmod({0}, {1})",
    ca.OP_COPYSIGN: "vd_copysign({0}, {1})",
    ca.OP_LT: "vd_bool({0} < {1})",
    ca.OP_LE: "vd_bool({0} <= {1})",
    ca.OP_EQ: "vd_bool({0} == {1})",
    ca.OP_NE: "vd_bool({0} != {1})",
    ca.OP_AND: "vd_bool(({0} != 0.0) & ({1} != 0.0))",
    ca.OP_OR: "vd_bool(({0} != 0.0) | ({1} != 0.0))",
    ca.OP_IF_ELSE_ZERO: "vd_select({0} != 0.0, {1}, V(0.0))",
} | {
    getattr(ca, f"OP_{name.upper()}"): f"vd_{name}({{0}})"
    for name in (
        "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil erf".split()  # noqa: SIM905
    )
}


def source(mpc: MPC) -> str:
    """The complete C source for an MPC; horizon, discount, bounds and theta are arguments of the compiled functions.

    Raises:
        InvalidArgumentError: If a function of the MPC cannot be expanded to SX or has no counterpart in C.
    """
    x, u = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu)
    p = ca.SX.sym("p", mpc.space.size)
    reached, cost = mpc.dynamics_function(x, u, p), mpc.stage_function(x, u, p)
    final = mpc.terminal_function(x, p)
    lxx, lx = ca.hessian(cost, x)
    luu, lu = ca.hessian(cost, u)
    lux = ca.jacobian(lu, x)
    txx, tx = ca.hessian(final, x)
    fx, fu = ca.jacobian(reached, x), ca.jacobian(reached, u)
    parts = [
        f"#define NX {mpc.nx}\n#define NU {mpc.nu}\n#define NP {mpc.space.size}",
        _text("vector.h"),
        emit("gen_step", [x, u, p], [reached, cost]),
        emit("gen_expand", [x, u, p], [reached, fx, fu, lx, lu, lxx, lux, luu]),
        emit("gen_final", [x, p], [final]),
        emit("gen_final_expand", [x, p], [tx, txx]),
        _text("kernel.c"),
    ]
    return "\n\n".join(parts)


def emit(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> str:
    """One C function ``name(i0, i1, ..., out)`` whose result is the outputs one behind the other, column-major.

    Raises:
        InvalidArgumentError: For an operation without a counterpart in C.
    """
    stacked = ca.vertcat(*(ca.vec(ca.densify(output)) for output in outputs))
    function = expanded(ca.Function(name, inputs, [stacked]))
    arguments = ", ".join(f"const vd *i{k}" for k in range(len(inputs)))
    lines = [f"static void {name}({arguments}, vd *out) {{"]
    lines.append("    vd " + ", ".join(f"w{k}" for k in range(max(1, function.sz_w()))) + ";")
    for op, sources, targets, constant in instructions(function):
        if op == ca.OP_CONST:
            lines.append(f"    w{targets[0]} = V({_literal(constant)});")
        elif op == ca.OP_INPUT:
            lines.append(f"    w{targets[0]} = i{sources[0]}[{sources[1]}];")
        elif op == ca.OP_OUTPUT:
            lines.append(f"    out[{targets[1]}] = w{sources[0]};")
        elif op in _INFIX:
            lines.append(f"    w{targets[0]} = w{sources[0]} {_INFIX[op]} w{sources[1]};")
        elif op in _FORMATS:
            lines.append(f"    w{targets[0]} = {_FORMATS[op].format(*(f'w{k}' for k in sources))};")
        else:
            raise InvalidArgumentError(name, expected="operations that C has", actual=f"CasADi operation {op}")
    return "\n".join([*lines, "}"])


def _literal(value: float) -> str:
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def _text(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
