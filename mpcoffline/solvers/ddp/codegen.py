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
    ca.OP_REMAINDER: "vd_remainder({0}, {1})",
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
    return "\n\n".join([text("vector.h"), generated(mpc), text("core.c"), text("kernel.c")])


def generated(mpc: MPC) -> str:
    """The functions that ``core.c`` expects, of ``vd``: a double, or a vector of them.

    What depends on theta alone is computed once a problem, in ``gen_prepare``; the products of the Riccati recursion
    are generated too, so that zeros in the model's derivatives cost nothing.

    Raises:
        InvalidArgumentError: If a function of the MPC cannot be expanded to SX or has no counterpart in C.
    """
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
    following, gradient = ca.SX.sym("following", mpc.nx), ca.SX.sym("Vx", mpc.nx)
    curvature, discount = ca.SX.sym("Vxx", mpc.nx * (mpc.nx + 1) // 2), ca.SX.sym("discount")
    reached, cost = mpc.dynamics_function(x, u, theta), mpc.stage_function(x, u, theta)
    final = mpc.terminal_function(x, theta)
    final_hessian, final_gradient = ca.hessian(final, x)
    inputs = {
        "gen_step": [x, u],
        "gen_final": [x],
        "gen_final_expand": [x],
        "gen_q": [x, u, following, gradient, curvature, discount],
    }
    outputs = {
        "gen_step": _stacked(reached, cost),
        "gen_final": _stacked(final),
        "gen_final_expand": _stacked(final_gradient, _triangle(final_hessian)),
        "gen_q": _action_value(reached, cost, x, u, following, gradient, curvature, discount),
    }
    bodies, symbols, prepared = _hoisted(list(outputs.values()), theta)
    parameters = ca.vertcat(theta, symbols)
    parts = [
        f"#define NX {mpc.nx}\n#define NU {mpc.nu}\n#define NP {mpc.space.size}\n#define NQ {symbols.numel()}",
        emit("gen_prepare", [theta], prepared),
        *(emit(name, [*inputs[name], parameters], body) for name, body in zip(outputs, bodies, strict=True)),
    ]
    return "\n\n".join(parts)


def _action_value(
    reached: ca.SX,
    cost: ca.SX,
    x: ca.SX,
    u: ca.SX,
    following: ca.SX,
    gradient: ca.SX,
    curvature: ca.SX,
    discount: ca.SX,
) -> ca.SX:
    """The quadratic model of Q(x, u) = L + gamma V(f(x, u)), V expanded at the successor that the trajectory names.

    Gauss-Newton: the curvature of f is left out. In the order that the kernel expects: the defect, Qx, Qu, Qxx (upper
    triangle), Qux, Quu.
    """
    Vxx = _symmetric(curvature, x.numel())
    fx, fu = ca.jacobian(reached, x), ca.jacobian(reached, u)
    lxx, lx = ca.hessian(cost, x)
    luu, lu = ca.hessian(cost, u)
    defect = reached - following
    slope = discount * (gradient + Vxx @ defect)
    weighted_fx, weighted_fu = discount * (Vxx @ fx), discount * (Vxx @ fu)
    return _stacked(
        defect,
        lx + fx.T @ slope,
        lu + fu.T @ slope,
        _triangle(lxx + fx.T @ weighted_fx),
        ca.jacobian(lu, x) + fu.T @ weighted_fx,
        luu + fu.T @ weighted_fu,
    )


def _triangle(matrix: ca.SX) -> ca.SX:
    """The upper triangle of a symmetric matrix as a column, column by column."""
    return ca.vertcat(*(matrix[i, j] for j in range(matrix.shape[1]) for i in range(j + 1)))


def _symmetric(triangle: ca.SX, n: int) -> ca.SX:
    """The inverse of :func:`_triangle`."""
    matrix, k = ca.SX(n, n), 0
    for column in range(n):
        for row in range(column + 1):
            matrix[row, column] = matrix[column, row] = triangle[k]
            k += 1
    return matrix


def _hoisted(bodies: list[ca.SX], theta: ca.SX) -> tuple[list[ca.SX], ca.SX, ca.SX]:
    """Takes out what depends on theta alone: the rest, the symbols that stand for it, and what they stand for."""
    sizes = [0, *np.cumsum([body.numel() for body in bodies]).tolist()]
    rest, symbols, prepared = ca.extract_parametric(ca.cse(ca.vertcat(*bodies)), theta)
    return ca.vertsplit(rest, sizes), ca.vertcat(*symbols), ca.vertcat(*prepared)


def _stacked(*parts: ca.SX) -> ca.SX:
    """Matrices as one dense column, each column-major."""
    return ca.vertcat(*(ca.vec(ca.densify(part)) for part in parts))


def emit(name: str, inputs: list[ca.SX], output: ca.SX) -> str:
    """One C function ``name(i0, i1, ..., out)`` of vectors of doubles.

    Raises:
        InvalidArgumentError: For an operation without a counterpart in C.
    """
    function = expanded(ca.Function(name, inputs, [output]))
    arguments = ", ".join(f"const vd *i{k}" for k in range(len(inputs)))
    lines = [f"static void {name}({arguments}, vd *out) {{"]
    lines.append("    vd " + ", ".join(f"w{k}" for k in range(max(1, function.sz_w()))) + ";")
    read = {sources[0] for op, sources, _, _ in instructions(function) if op == ca.OP_INPUT}
    lines.extend(f"    (void)i{k};" for k in range(len(inputs)) if k not in read)
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


def text(name: str) -> str:
    """A C file of this package."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
