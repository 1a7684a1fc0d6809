"""The C source of a DDP solver for one MPC: its functions and derivatives, in front of the fixed kernel."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import resources

import casadi as ca
import numpy as np

from mpcoffline.core import limits
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC
from mpcoffline.mpc.expressions import Instruction, expanded
from mpcoffline.solvers.linear_quadratic import promises_convexity
from mpcoffline.solvers.scaling import costs_of

from .elimination import arithmetic, value_and_jacobian

_INFIX = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*"}
_FORMATS = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
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


# GCC's effort grows with the square of a function's length. Only functions of costs that are networks are so long.
_LONGEST = 2500
_PIECE = 500
_LARGEST_BENT = 2000  # nodes of a model whose second derivatives are taken: they double the code
# Inlined, the time of a cart-pole's expansion depends on where the linker puts it, by a quarter.
_ATTRIBUTES = {"gen_q": "NOINLINE "}


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
    z = ca.vertcat(x, u)
    reached = mpc.dynamics_function(x, u, theta)
    cost, final, *_ = costs_of(mpc, x, u, theta)
    _check_size(mpc, ca.vertcat(reached, cost, final))
    final_hessian, final_gradient = ca.hessian(final, x)
    hessian, slope = ca.hessian(cost, z)
    linearised = value_and_jacobian(reached, z, theta)
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
    }
    exact = not hessian[: mpc.nx, : mpc.nx].nnz() and ca.n_nodes(reached) <= _LARGEST_BENT
    as_is = exact or promises_convexity(mpc.stage_cost)
    if not as_is:  # gen_q takes the expansion as the kernel changed it
        inputs["gen_stage_expand"], outputs["gen_stage_expand"] = [x, u], _stacked(slope, _triangle(hessian))
        stage = ca.SX.sym("stage", outputs["gen_stage_expand"].numel())
        inputs["gen_q"].append(stage)
        slope, hessian = stage[: mpc.nx + mpc.nu], _symmetric(stage[mpc.nx + mpc.nu :], mpc.nx + mpc.nu)
    bent = _bent(reached, z) if exact else None
    outputs["gen_q"] = _action_value(*linearised, slope, hessian, following, gradient, curvature, discount, bent)
    bodies, symbols, prepared = _hoisted(list(outputs.values()), theta)
    parameters = ca.vertcat(theta, symbols)
    convex = int(as_is), int(promises_convexity(mpc.terminal_cost))
    parts = [
        f"#define STAGE_CONVEX {convex[0]}\n#define TERMINAL_CONVEX {convex[1]}",
        f"#define NX {mpc.nx}\n#define NU {mpc.nu}\n#define NP {mpc.space.size}\n#define NQ {symbols.numel()}",
        emit("gen_prepare", [theta], prepared),
        *(
            emit(name, [*inputs[name], parameters], body, _ATTRIBUTES.get(name, ""))
            for name, body in zip(outputs, bodies, strict=True)
        ),
    ]
    return "\n\n".join(parts)


def _check_size(mpc: MPC, functions: ca.SX) -> None:
    """Refuses what no compiler is through with in minutes, before its derivatives are taken."""
    dynamics = mpc.dynamics_function
    derivatives = sum(dynamics.jac_sparsity(0, i).nnz() for i in (0, 1))
    for what, found, most in (
        ("operations", ca.n_nodes(functions), limits.COMPILED_NODES),
        ("products of derivatives", 2 * derivatives * (mpc.nx + mpc.nu), limits.COMPILED_PRODUCTS),
    ):
        if found > most:
            raise InvalidArgumentError(
                "mpc",
                expected=f"at most {most} {what} for the ddp solver",
                actual=f"{found} {what}",
                hint='Use the solver "ipopt".',
            )


def _action_value(
    reached: ca.SX,
    jacobian: ca.SX,
    stage_gradient: ca.SX,
    stage_hessian: ca.SX,
    following: ca.SX,
    gradient: ca.SX,
    curvature: ca.SX,
    discount: ca.SX,
    bent: Callable[[ca.SX], ca.SX] | None,
) -> ca.SX:
    """The quadratic model of Q(x, u) = L + gamma V(f(x, u)), V expanded at the successor that the trajectory names.

    f is given by its value and Jacobian, L by its gradient and Hessian, all with respect to (x, u).

    Gauss-Newton: the curvature of f is left out, unless ``bent`` gives it. In the order that the kernel expects: the
    defect, Qx, Qu, Qxx (upper triangle), Qux, Quu.
    """
    nx = reached.numel()
    discounted = _symmetric(discount * curvature, nx)
    fx, fu = jacobian[:, :nx], jacobian[:, nx:]
    lx, lu = stage_gradient[:nx], stage_gradient[nx:]
    lxx, lux, luu = stage_hessian[:nx, :nx], stage_hessian[nx:, :nx], stage_hessian[nx:, nx:]
    defect = reached - following
    slope = discount * gradient + discounted @ defect
    weighted_fx, weighted_fu = discounted @ fx, discounted @ fu
    if bent is not None:
        model = bent(slope)
        lxx, lux, luu = lxx + model[:nx, :nx], lux + model[nx:, :nx], luu + model[nx:, nx:]
    return _stacked(
        defect,
        lx + fx.T @ slope,
        lu + fu.T @ slope,
        _triangle(lxx + fx.T @ weighted_fx),
        lux + fu.T @ weighted_fx,
        luu + fu.T @ weighted_fu,
    )


def _bent(reached: ca.SX, z: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """The Hessian of y'f by (x, u), for a column y.

    Where the stage cost is linear in the states (prices), the curvature of f is all that there is inland of the bounds:
    without it no step ends in a minimum.
    """
    y = ca.SX.sym("y", reached.numel())
    hessian, _ = ca.hessian(ca.dot(y, reached), z)
    return lambda slope: ca.substitute(hessian, y, slope)


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


def emit(name: str, inputs: list[ca.SX], output: ca.SX, attribute: str = "") -> str:
    """One C function ``name(i0, i1, ..., out)`` of vectors of doubles; a long one calls pieces of itself in turn.

    The attribute stands in front of it, e.g. ``"NOINLINE "``.

    Raises:
        InvalidArgumentError: For an operation without a counterpart in C.
    """
    function = expanded(ca.Function(name, inputs, [output]))
    program = arithmetic(function)
    pointers = [f"i{k}" for k in range(len(inputs))]
    arguments = "".join(f"const vd *{pointer}, " for pointer in pointers) + "vd *out"
    if len(program) <= _LONGEST:
        return _function(name, arguments, _statements(name, program, len(program)), pointers, attribute)
    work, pieces, calls = f"vd w[{function.sz_w()}];", [], []
    statements = _statements(name, program, _PIECE)
    for k, start in enumerate(range(0, len(program), _PIECE)):
        lines = statements[start : start + _PIECE]
        pieces.append(
            _function(f"{name}_{k}", f"{arguments}, vd *RESTRICT w", lines, [*pointers, "out", "w"], "NOINLINE ")
        )
        calls.append(f"{name}_{k}({', '.join(pointers)}, out, w);")
    return "\n\n".join([*pieces, _function(name, arguments, [work, *calls], [])])


def _function(name: str, arguments: str, statements: list[str], unused: list[str], attribute: str = "") -> str:
    """A C function; of ``unused``, those that the statements do not name are marked so."""
    named = set(re.findall(r"\b(?:i\d+|out|w)\b", " ".join(statements)))
    marks = [f"(void){argument};" for argument in unused if argument not in named]
    lines = [f"    {line}" for line in (*marks, *statements)]
    return "\n".join([f"{attribute}static void {name}({arguments}) {{", *lines, "}"])


def _statements(name: str, program: list[Instruction], piece: int) -> list[str]:
    """One C statement an instruction; values that a later piece reads go through the array ``w`` of all pieces.

    Divisions multiply by reciprocals, as a model's derivatives divide by the same few numbers again and again.
    """
    value_in: dict[int, int] = {}  # by place in the work vector: the instruction whose value is there
    read: list[dict[int, int]] = []  # of each instruction: the places that it reads, and whose values they are
    last_read: dict[int, int] = {}
    for k, (op, sources, targets, _) in enumerate(program):
        read.append({} if op in (ca.OP_INPUT, ca.OP_CONST) else {place: value_in[place] for place in sources})
        last_read.update(dict.fromkeys(read[-1].values(), k))
        if op != ca.OP_OUTPUT:
            value_in[targets[0]] = k
    statements = []
    reciprocals: set[tuple[int, int]] = set()  # those that are known: piece, number of the divisor
    for k, (op, sources, targets, constant) in enumerate(program):
        start = k - k % piece
        first = ""
        names = [
            f"v{read[k][place]}" if read[k][place] >= start else f"w[{place}]" for place in sources if place in read[k]
        ]
        if op == ca.OP_OUTPUT:
            statements.append(f"out[{targets[1]}] = {names[0]};")
            continue
        if op == ca.OP_CONST:
            result = f"V({_literal(constant)})"
        elif op == ca.OP_INPUT:
            result = f"i{sources[0]}[{sources[1]}]"
        elif op in _INFIX:
            result = f"{names[0]} {_INFIX[op]} {names[1]}"
        elif op in (ca.OP_DIV, ca.OP_INV):
            divisor = read[k][sources[-1]]
            if (start, divisor) not in reciprocals:
                reciprocals.add((start, divisor))
                first = f"const vd r{divisor} = 1.0 / {names[-1]}; "
            result = " * ".join([*names[:-1], f"r{divisor}"])
        elif op in _FORMATS:
            result = _FORMATS[op].format(*names)
        else:
            raise InvalidArgumentError(name, expected="operations that C has", actual=f"CasADi operation {op}")
        kept = f" w[{targets[0]}] = v{k};" if last_read.get(k, k) >= start + piece else ""
        statements.append(f"{first}const vd v{k} = {result};{kept}")
    return statements


def _literal(value: float) -> str:
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def text(name: str) -> str:
    """A C file of this package."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
