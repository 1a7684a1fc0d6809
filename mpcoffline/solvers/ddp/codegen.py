"""The C source of a DDP solver for one MPC: its functions and derivatives, in front of the fixed kernel."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core import limits
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.layers import layered
from mpcoffline.solvers.limits import Limits, limits_of
from mpcoffline.solvers.linear_quadratic import promises_convexity
from mpcoffline.solvers.scaling import costs_of

from .elimination import value_and_jacobian
from .emission import emit, literal
from .layered import LayeredCode
from .terminal import COMPOSED, TerminalNetwork

_LARGEST_BENT = 2000  # nodes of a model whose second derivatives are taken: they double the code
# Inlined, the time of a cart-pole's expansion depends on where the linker puts it, by a quarter.
_ATTRIBUTES = {"gen_q": "NOINLINE "}
# What is emitted of a model with layers instead: the rest of the functions, which are composed of it and the layers.
_WITH_LAYERS = {"gen_step": "gen_cost", "gen_q": "gen_q_of_model"}
# Likewise of a terminal cost that is a network.
_WITH_NETWORK = {"gen_final": "gen_final_of_network", "gen_final_expand": "gen_final_expand_of_network"}
# What was generated last, by what it was generated from: the MPCs of a fit differ in theta, bounds and horizon, mostly.
_KNOWN: dict[tuple[object, ...], str] = {}
_MOST_KNOWN = 32


def source(mpc: MPC) -> str:
    """The complete C source for an MPC; horizon, discount, bounds and theta are arguments of the compiled functions.

    Raises:
        InvalidArgumentError: If a function of the MPC cannot be expanded to SX or has no counterpart in C.
    """
    return "\n\n".join([text("vector.h"), generated(mpc), algorithm(mpc), text("kernel.c")])


def algorithm(mpc: MPC) -> str:
    """What iterates: ``core.c``, with what limits need around it, if there are any."""
    names = ["core.c"] if mpc.constraints is None else ["constraints.h", "core.c", "constraints.c", "rates.c"]
    return "\n\n".join(text(name) for name in names)


def generated(mpc: MPC) -> str:
    """The functions that ``core.c`` expects, of ``vd``: a double, or a vector of them.

    What depends on theta alone is computed once a problem, in ``gen_prepare``; the products of the Riccati recursion
    are generated too, so that zeros in the model's derivatives cost nothing.

    Raises:
        InvalidArgumentError: If a function of the MPC cannot be expanded to SX or has no counterpart in C.
    """
    problem = _Problem.of(mpc)
    key = problem.key
    code = _KNOWN.pop(key, None) or _generated(mpc, problem)
    _KNOWN[key] = code  # as the last one
    for oldest in list(_KNOWN)[:-_MOST_KNOWN]:
        _KNOWN.pop(oldest, None)
    return code


class _Problem(NamedTuple):
    """All of an MPC that C is generated from: expressions in x, u and theta, and what its costs promise."""

    x: ca.SX
    u: ca.SX
    theta: ca.SX
    reached: ca.SX
    cost: ca.SX
    final: ca.SX
    kept: Limits | None
    convex: tuple[bool, bool]

    @classmethod
    def of(cls, mpc: MPC) -> _Problem:
        """Of an MPC."""
        x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
        reached, (cost, final, *_) = mpc.dynamics_function(x, u, theta), costs_of(mpc, x, u, theta)
        convex = promises_convexity(mpc.stage_cost), promises_convexity(mpc.terminal_cost)
        return cls(x, u, theta, reached, cost, final, limits_of(mpc, x, u, theta), convex)

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for problems of which the same C is generated."""
        outputs: list[ca.SX] = [self.reached, self.cost, self.final]
        others: tuple[object, ...] = ()
        if self.kept is not None:
            outputs += [self.kept.stage, self.kept.end]
            numbers = self.kept.l1, self.kept.l2, self.kept.by_input, *self.kept.rates
            others = (self.kept.n_stage, *(array.tobytes() for array in numbers))
        return ca.Function("problem", [self.x, self.u, self.theta], outputs).serialize(), self.convex, others


def _generated(mpc: MPC, problem: _Problem) -> str:
    """See :func:`generated`."""
    x, u, theta, reached, cost, final, kept, promised = problem
    following, gradient = ca.SX.sym("following", mpc.nx), ca.SX.sym("Vx", mpc.nx)
    curvature, discount = ca.SX.sym("Vxx", mpc.nx * (mpc.nx + 1) // 2), ca.SX.sym("discount")
    z = ca.vertcat(x, u)
    layers = _layers(mpc, theta) if ca.n_nodes(reached) > _LARGEST_BENT else None
    _check_size(mpc, ca.vertcat(cost, final), layers.n_scalars if layers else ca.n_nodes(reached))
    network, found = TerminalNetwork.of(mpc, x, theta), ca.SX()
    if network is None:
        final_hessian, final_gradient = ca.hessian(final, x)
    else:
        final, found = network.cost, ca.SX.sym("found", network.size)  # in which network_expand hands it over
        final_gradient, final_hessian = network.expansion(found)
    hessian, slope = ca.hessian(cost, z)
    array = ca.SX.sym("model", mpc.nx * (1 + mpc.nx + mpc.nu))  # in which model_slopes hands them over
    linearised = value_and_jacobian(reached, z, theta) if layers is None else _in_array(mpc, array)
    inputs = {
        "gen_step": [x, u],
        "gen_final": [x],
        "gen_final_expand": [x],
        "gen_q": [x, u, following, gradient, curvature, discount],
    }
    outputs = {
        "gen_step": _stacked(*([] if layers else [reached]), cost),
        "gen_final": _stacked(final),
        "gen_final_expand": _stacked(final_gradient, _triangle(final_hessian)),
    }
    exact = not hessian[: mpc.nx, : mpc.nx].nnz() and ca.n_nodes(reached) <= _LARGEST_BENT
    as_is = exact or promised[0]
    if not as_is:  # gen_q takes the expansion as the kernel changed it
        inputs["gen_stage_expand"], outputs["gen_stage_expand"] = [x, u], _stacked(slope, _triangle(hessian))
        stage = ca.SX.sym("stage", outputs["gen_stage_expand"].numel())
        inputs["gen_q"].append(stage)
        slope, hessian = stage[: mpc.nx + mpc.nu], _symmetric(stage[mpc.nx + mpc.nu :], mpc.nx + mpc.nu)
    bent = _bent(reached, z) if exact else None
    outputs["gen_q"] = _action_value(*linearised, slope, hessian, following, gradient, curvature, discount, bent)
    if layers is not None:
        inputs["gen_q"].append(array)
        inputs |= {name: [read] for name, (read, _) in layers.functions.items()}
        outputs |= {name: given for name, (_, given) in layers.functions.items()}
    if network is not None:
        inputs |= {"gen_final": [x, network.y], "gen_final_expand": [x, found], "gen_network_inputs": [x]}
        outputs["gen_network_inputs"] = _stacked(network.z)
    if kept is not None:
        for name, (read, given) in limit_functions(kept, x, u).items():
            inputs[name], outputs[name] = read, given
    bodies, symbols, prepared = _hoisted(list(outputs.values()), theta)
    parameters = ca.vertcat(theta, symbols)
    convex = int(as_is), int(promised[1])
    names = (_WITH_LAYERS if layers else {}) | (_WITH_NETWORK if network else {})
    parts = [
        f"#define STAGE_CONVEX {convex[0]}\n#define TERMINAL_CONVEX {convex[1]}",
        limit_constants(kept),
        f"#define NX {mpc.nx}\n#define NU {mpc.nu}\n#define NP {mpc.space.size}\n#define NQ {symbols.numel()}",
        *([] if layers is None else [text("layers.c"), *layers.maps()]),
        *([] if network is None else [network.tables(), text("network.c")]),
        emit("gen_prepare", [theta], prepared),
        *(
            emit(names.get(name, name), [*inputs[name], parameters], body, _ATTRIBUTES.get(name, ""))
            for name, body in zip(outputs, bodies, strict=True)
        ),
        *([] if layers is None else [layers.drivers(), _composed(stage_expansion=not as_is)]),
        *([] if network is None else [COMPOSED]),
    ]
    return "\n\n".join(parts)


def limit_functions(limits: Limits, x: ca.SX, u: ca.SX) -> dict[str, tuple[list[ca.SX], ca.SX]]:
    """The functions that ``constraints.h`` expects: what each reads besides the parameters, and gives.

    Gauss-Newton: the curvature of h is left out, so that what they add to the Hessians is positive semidefinite.
    """
    nx, z = x.numel(), ca.vertcat(x, u)
    y, dy = (ca.SX.sym(name, limits.stage.numel()) for name in ("y", "dy"))
    y_end, dy_end = (ca.SX.sym(name, limits.end.numel()) for name in ("y", "dy"))
    slope = ca.jacobian(limits.stage, z)
    slope[np.flatnonzero(limits.rates.elements).tolist(), :] = 0.0  # rates are bounds, which cost nothing
    gradient, hessian = slope.T @ y, slope.T @ ca.diag(dy) @ slope
    end_slope = ca.jacobian(limits.end, x)
    return {
        "gen_h": ([x, u], _stacked(limits.stage)),
        "gen_h_end": ([x], _stacked(limits.end)),
        "gen_limits": (
            [x, u, y, dy],
            _stacked(gradient, _triangle(hessian[:nx, :nx]), hessian[nx:, :nx], hessian[nx:, nx:]),
        ),
        "gen_limits_end": (
            [x, y_end, dy_end],
            _stacked(end_slope.T @ y_end, _triangle(end_slope.T @ ca.diag(dy_end) @ end_slope)),
        ),
    }


def limit_constants(limits: Limits | None) -> str:
    """How many limits there are, and their prices."""
    if limits is None:
        return "#define LIMITS 0\n#define RATES 0"
    arrays = [_doubles("limit_l1", limits.l1), _doubles("limit_l2", limits.l2)]
    sizes = {
        "LIMITS": len(limits.labels),
        "STAGE_LIMITS": limits.stage.numel(),
        "END_FIRST": limits.n_stage,
    }
    sizes["RATES"] = int(limits.rates.elements.sum())
    arrays.append(_integers("limit_by_input", limits.by_input))
    arrays.append(_integers("limit_is_rate", limits.rates.elements))
    if sizes["RATES"]:
        arrays.append(_integers("rate_place", limits.rates.places))
        arrays.append(_doubles("rate_up", limits.rates.up))
        arrays.append(_doubles("rate_down", limits.rates.down))
    return "\n".join([*(f"#define {name} {value}" for name, value in sizes.items()), *arrays])


def _doubles(name: str, values: Array) -> str:
    return f"static const double {name}[] = {{{', '.join(map(literal, values))}}};"


def _integers(name: str, values: NDArray[Any]) -> str:
    return f"static const int {name}[] = {{{', '.join(str(int(value)) for value in values)}}};"


def _layers(mpc: MPC, theta: ca.SX) -> LayeredCode | None:
    """The model as loops over its layers' matrices, if it has any."""
    structure = layered(mpc.dynamics_function)
    return None if structure is None else LayeredCode(structure, mpc.nx, mpc.nu, theta)


def _in_array(mpc: MPC, array: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The successor and its Jacobian by (x, u), row by row in an array; what is zero in any case is so."""
    pattern = ca.horzcat(*(ca.DM(mpc.dynamics_function.jac_sparsity(0, i), 1.0) for i in (0, 1)))
    full = ca.reshape(array[mpc.nx :], mpc.nx + mpc.nu, mpc.nx).T
    return array[: mpc.nx], full * ca.SX(pattern)


def _composed(*, stage_expansion: bool) -> str:
    """``gen_step`` and ``gen_q``, of the model's layers and the functions in :data:`_WITH_LAYERS`."""
    typed, passed = ("const vd *stage, ", "stage, ") if stage_expansion else ("", "")
    return f"""static void gen_step(const vd *x, const vd *u, const vd *p, vd *out) {{
    model_values(x, u, p, out);
    gen_cost(x, u, p, out + NX);
}}

static NOINLINE void gen_q(const vd *x, const vd *u, const vd *following, const vd *Vx, const vd *Vxx,
                           const vd *discount, {typed}const vd *p, vd *out) {{
    vd model[NX * (1 + NZ)];
    model_slopes(x, u, p, model);
    gen_q_of_model(x, u, following, Vx, Vxx, discount, {passed}model, p, out);
}}"""


def _check_size(mpc: MPC, costs: ca.SX, n_model: int) -> None:
    """Refuses what no compiler is through with in minutes, before its derivatives are taken.

    Args:
        mpc: The problem.
        costs: Expressions of its costs.
        n_model: Scalar operations of its model, without those of layers.
    """
    dynamics = mpc.dynamics_function
    derivatives = sum(dynamics.jac_sparsity(0, i).nnz() for i in (0, 1))
    for what, found, most in (
        ("operations", ca.n_nodes(costs) + n_model, limits.COMPILED_NODES),
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


def text(name: str) -> str:
    """A C file of this package."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
