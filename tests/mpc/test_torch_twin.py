"""The torch twin of a CasADi function: equal values, equal gradients, any batch."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs import ENV_IDS
from mpcoffline.mpc import MPC
from mpcoffline.mpc.integrators import rk4_expression
from mpcoffline.mpc.torch_twin import TorchTwin
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]


def sq(a: ca.SX) -> ca.SX:
    return a**2


# Each keeps its argument in its domain, and its value within about 10, so that errors stay near rounding.
UNARY: dict[str, Any] = {
    "neg": lambda a: -a,
    "square": lambda a: sq(ca.tanh(a)),
    "twice": lambda a: 2 * a,
    "inverse": lambda a: 1 / (1 + sq(a)),
    "sqrt": lambda a: ca.sqrt(1 + sq(a)),
    "exp": lambda a: ca.exp(-sq(a)),
    "log": lambda a: ca.log(1 + sq(a)),
    "log1p": lambda a: ca.log1p(sq(a)),
    "expm1": lambda a: ca.expm1(ca.tanh(a)),
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": lambda a: ca.tan(ca.tanh(a)),
    "asin": lambda a: ca.asin(0.9 * ca.tanh(a)),
    "acos": lambda a: ca.acos(0.9 * ca.tanh(a)),
    "atan": ca.atan,
    "sinh": lambda a: ca.sinh(ca.tanh(a)),
    "cosh": lambda a: ca.cosh(ca.tanh(a)),
    "tanh": ca.tanh,
    "asinh": ca.asinh,
    "acosh": lambda a: ca.acosh(2 + sq(ca.tanh(a))),
    "atanh": lambda a: ca.atanh(0.9 * ca.tanh(a)),
    "erf": ca.erf,
    "fabs": ca.fabs,
    "floor": lambda a: ca.floor(3 * ca.tanh(a)),
    "ceil": lambda a: ca.ceil(3 * ca.tanh(a)),
    "sign": ca.sign,
    "power": lambda a: (1 + sq(a)) ** 0.3,
    "cube": lambda a: ca.tanh(a) ** 3,
    "base": lambda a: 1.5 ** ca.tanh(a),
}
BINARY: dict[str, Any] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: ca.tanh(a) * b,
    "div": lambda a, b: a / (1 + sq(b)),
    "pow": lambda a, b: (1 + sq(ca.tanh(a))) ** ca.tanh(b),
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "atan2": lambda a, b: ca.atan2(a, 1 + sq(b)),
    "hypot": lambda a, b: ca.hypot(a, 1 + sq(b)),
    "fmod": lambda a, b: ca.fmod(a, 1.5),
    "copysign": lambda a, b: ca.copysign(a, b),
    "lt": lambda a, b: ca.if_else(a < b, a, 2 * b),
    "le": lambda a, b: ca.if_else(a <= b, ca.sin(a), b),
    "and": lambda a, b: ca.if_else(ca.logic_and(a > 0, b > 0), a, b),
    "or": lambda a, b: ca.if_else(ca.logic_or(a > 0, b > 0), a, b),
    "not": lambda a, b: ca.if_else(ca.logic_not(a > b), a, 0.5 * b),
    "eq": lambda a, b: a + (a == b),
    "ne": lambda a, b: a + b * (a != b),
}


@st.composite
def expressions(draw: st.DrawFn) -> ca.Function:
    """A random function of x (3), p (2) with two outputs, built from up to 12 operations."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    pool = [*ca.vertsplit(x), *ca.vertsplit(p), ca.SX(0.7), ca.SX(-1.3)]
    for _ in range(draw(st.integers(1, 12))):
        name = draw(st.sampled_from([*UNARY, *BINARY]))
        operands = [draw(st.sampled_from(pool)) for _ in range(1 if name in UNARY else 2)]
        pool.append((UNARY if name in UNARY else BINARY)[name](*operands))
    return ca.Function("random", [x, p], [ca.vertcat(pool[-1], pool[-2])])


def assert_equal(
    function: ca.Function, inputs: list[Array], value_tol: float = 1e-12, gradient_tol: float = 1e-10
) -> None:
    """Values and Jacobians of the twin against CasADi's, input rows being problems (B, n)."""
    expected = function(*[a.T for a in inputs]).full().T
    tensors = [torch.tensor(a, requires_grad=True) for a in inputs]
    value = TorchTwin(function)(*tensors)
    assert value.dtype == torch.float64
    scale = 1.0 + np.abs(expected)
    np.testing.assert_array_less(np.abs(value.detach().numpy() - expected), value_tol * scale)
    jacobians = function.jacobian()
    outputs = np.zeros_like(expected)
    for row in range(len(expected)):
        exact = jacobians(*[a[row] for a in inputs], outputs[row])
        exact = [exact] if len(inputs) == 1 else list(exact)
        for j in range(expected.shape[1]):
            gradients: Any = [None] * len(tensors)  # a constant
            if value.requires_grad:
                gradients = torch.autograd.grad(value[row, j], tensors, retain_graph=True, allow_unused=True)
            for gradient, block in zip(gradients, exact, strict=True):
                given_row = np.zeros(block.shape[1]) if gradient is None else gradient[row].numpy()
                wanted = block.full()[j]
                np.testing.assert_array_less(np.abs(given_row - wanted), gradient_tol * (1.0 + np.abs(wanted)))


@settings(max_examples=200)
@given(expressions(), st.integers(0, 2**31))
def test_random_expressions(function: ca.Function, seed: int) -> None:
    rng = np.random.default_rng(seed)  # floats drawn by a generator miss kinks with probability one
    assert_equal(function, [rng.normal(size=(2, 3)), rng.normal(size=(2, 2))])


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_each_operation(name: str) -> None:
    x = ca.SX.sym("x", 2)
    expression = UNARY[name](x[0]) if name in UNARY else BINARY[name](x[0], x[1])
    assert_equal(ca.Function(name, [x], [expression]), [np.random.default_rng(0).normal(size=(20, 2))])


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_each_operation_on_single_precision(name: str) -> None:
    x = ca.SX.sym("x", 2)
    expression = UNARY[name](x[0]) if name in UNARY else BINARY[name](x[0], x[1])
    function = ca.Function(name, [x], [expression])
    points = torch.tensor(np.random.default_rng(1).normal(size=(20, 2)), dtype=torch.float32)
    value = TorchTwin(function)(points)
    assert value.dtype == torch.float32
    np.testing.assert_allclose(value.numpy(), function(points.double().numpy().T).full().T, rtol=1e-4, atol=1e-5)


def points_of(mpc: MPC, n: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    x = rng.uniform(-3, 3, size=(n, mpc.nx))
    if mpc.nx > 4 or mpc.nx == 3:  # swing-ups: (cos, sin) near the unit circle, where the model is used
        angle, radius = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.8, 1.2, n)
        first = 0 if mpc.nx == 3 else 2
        x[:, first], x[:, first + 1] = radius * np.cos(angle), radius * np.sin(angle)
    return x, rng.uniform(mpc.action_low, mpc.action_high, size=(n, mpc.nu))


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("name", ["dynamics_function", "stage_function", "terminal_function"])
def test_tasks(env_id: str, name: str) -> None:
    mpc = nominal_mpc(env_id, seed=0)
    x, u = points_of(mpc, 10)
    theta = np.broadcast_to(mpc.theta, (10, mpc.space.size)).copy()
    inputs = [x, theta] if name == "terminal_function" else [x, u, theta]
    assert_equal(getattr(mpc, name), inputs)


def test_parameters_broadcast_over_a_batch() -> None:
    mpc = nominal_mpc(ENV_IDS[1], alpha=1.0, seed=0)
    twin = TorchTwin(mpc.dynamics_function)
    x, u = (torch.tensor(a) for a in points_of(mpc, 12))
    theta = torch.tensor(mpc.theta, requires_grad=True)
    value = twin(x, u, theta)
    assert value.shape == (12, 3)
    np.testing.assert_allclose(value.detach().numpy(), mpc.model(x.numpy(), u.numpy()), rtol=1e-14, atol=1e-14)
    one_by_one = torch.stack([twin(a, b, theta) for a, b in zip(x, u, strict=True)])
    torch.testing.assert_close(value, one_by_one, rtol=1e-14, atol=1e-14)
    (batch,) = torch.autograd.grad(value.sum(), theta)
    (summed,) = torch.autograd.grad(one_by_one.sum(), theta)
    torch.testing.assert_close(batch, summed, rtol=1e-12, atol=1e-13)
    # Several parameter vectors against several states.
    thetas = torch.stack([theta.detach(), 1.01 * theta.detach(), 0.9 * theta.detach()])
    grid = twin(x[:, None], u[:, None], thetas)
    assert grid.shape == (12, 3, 3)
    torch.testing.assert_close(grid[:, 1], twin(x, u, thetas[1]), rtol=1e-14, atol=1e-14)


def test_constant_and_unused() -> None:
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 0)
    twin = TorchTwin(ca.Function("f", [x, p], [ca.vertcat(1.5, 0.0, x[1])]))
    value = twin(torch.zeros(4, 2, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    np.testing.assert_array_equal(value.numpy(), np.tile([1.5, 0.0, 0.0], (4, 1)))
    assert twin(torch.zeros(2), torch.zeros(0)).shape == (3,)


BRANCHES: dict[str, Any] = {  # taken for x > 0; the other side is NaN, or has an infinite slope
    "sqrt": (lambda x: ca.sqrt(x), lambda x: 2 * x),
    "log": (lambda x: ca.log(x), lambda x: x),
    "power": (lambda x: x**1.5, lambda x: ca.sin(x)),
    "division": (lambda x: 1 / ca.fmax(x, 0), lambda x: x * x),
    "asin": (lambda x: ca.asin(ca.sqrt(x) / 10), lambda x: x + 1),
    "nested": (lambda x: ca.if_else(x > 1, ca.log(x - 1), ca.sqrt(ca.log(1 + x))), lambda x: ca.exp(x)),
}


@pytest.mark.parametrize("name", BRANCHES)
def test_nan_in_the_branch_not_taken(name: str) -> None:
    x = ca.SX.sym("x", 1)
    p = ca.SX.sym("p", 1)
    taken, other = BRANCHES[name]
    twin = TorchTwin(ca.Function("f", [x, p], [p * ca.if_else(x > 0, taken(p * x), other(p * x))]))
    points = np.array([[-3.0], [-0.5], [0.0], [0.3], [0.8], [1.7], [4.0]])
    tensor = torch.tensor(points, requires_grad=True)
    parameter = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    value = twin(tensor, parameter)
    scalar_taken = ca.Function("t", [x, p], [p * taken(p * x)])
    scalar_other = ca.Function("o", [x, p], [p * other(p * x)])
    gx, gp = torch.autograd.grad(value.sum(), [tensor, parameter])
    total = 0.0
    for k, point in enumerate(points):
        branch = scalar_taken if point[0] > 0 else scalar_other
        assert value[k].item() == pytest.approx(float(branch(point, 1.0)), rel=1e-13)
        dx, dp = branch.jacobian()(point, 1.0, 0.0)
        assert gx[k].item() == pytest.approx(float(dx), rel=1e-11, abs=1e-12)
        total += float(dp)
    assert gp.item() == pytest.approx(total, rel=1e-11)


def test_a_branch_shared_with_the_output_keeps_its_gradient() -> None:
    x = ca.SX.sym("x", 1)
    root = ca.sqrt(x)
    twin = TorchTwin(ca.Function("f", [x], [ca.vertcat(root, ca.if_else(x > 1, root, x))]))
    point = torch.tensor([[0.25]], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(twin(point).sum(), point)
    assert gradient.item() == pytest.approx(1.0 + 1.0)


def test_second_derivatives() -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.if_else(x[0] > 0, ca.sin(x[0]) * x[1] ** 2, x[1])])
    point = torch.tensor([0.7, -1.2], dtype=torch.float64)
    hessian = torch.autograd.functional.hessian(lambda t: TorchTwin(function)(t)[0], point)
    exact = ca.Function("H", [x], [ca.hessian(function(x), x)[0]])(point.numpy()).full()
    np.testing.assert_allclose(hessian.numpy(), exact, rtol=1e-12)


def test_only_the_first_output_counts() -> None:
    x = ca.SX.sym("x", 1)
    twin = TorchTwin(ca.Function("f", [x], [2 * x, ca.vertcat(x, x)]))
    assert twin(torch.tensor([3.0])).tolist() == [6.0]


def test_matrix_inputs_and_mx_functions() -> None:
    A, x = ca.MX.sym("A", 2, 3), ca.MX.sym("x", 3)
    twin = TorchTwin(ca.Function("f", [A, x], [A @ ca.sin(x)]))
    matrix, vector = np.arange(6.0).reshape(2, 3), np.array([0.1, 0.2, 0.3])
    value = twin(torch.tensor(matrix.T.ravel()), torch.tensor(vector))  # CasADi stacks columns
    np.testing.assert_allclose(value.numpy(), matrix @ np.sin(vector), rtol=1e-14)


def test_operations_without_a_counterpart_are_refused() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(InvalidArgumentError, match="f: expected operations that torch has"):
        TorchTwin(ca.Function("f", [x], [ca.remainder(x, 2.0)]))
    y = ca.MX.sym("y")
    table = ca.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])
    with pytest.raises(InvalidArgumentError, match="lookup: expected"):
        TorchTwin(ca.Function("lookup", [y], [table(y)]))


def test_wrong_inputs_are_refused() -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    twin = TorchTwin(ca.Function("f", [x, u], [x * u]))
    with pytest.raises(InvalidArgumentError, match=r"input 1 of f: expected shape \(\.\.\., 1\), got shape \(4, 2\)"):
        twin(torch.zeros(4, 2), torch.zeros(4, 2))
    with pytest.raises(InvalidArgumentError, match="input 0 of f"):
        twin(torch.tensor(1.0), torch.zeros(1))
    with pytest.raises(InvalidArgumentError, match="f: expected 2 inputs, got 1"):
        twin(torch.zeros(4, 2))


def test_networks_are_products_of_matrices() -> None:
    """Equal to CasADi in value and gradient, with parameters around, in a few hundred operations."""
    rng = np.random.default_rng(0)
    x, u, theta = ca.SX.sym("x", 4), ca.SX.sym("u", 1), ca.SX.sym("theta", 2)
    weights = [rng.normal(size=size) / 5 for size in ((32, 5), (32, 32), (4, 32))]

    def f(state: ca.SX) -> ca.SX:
        h = ca.tanh(weights[0] @ ca.vertcat(state, u * theta[0]) + 0.1)
        h = ca.fmax(weights[1] @ h, 0.1) / (1 + theta[1] ** 2)
        return weights[2] @ h - theta[1] * ca.sin(state)

    function = ca.Function("f", [x, u, theta], [rk4_expression(f, x, 0.1)])
    twin = TorchTwin(function)
    point = [torch.tensor(rng.normal(size=size), requires_grad=True) for size in ((6, 4), (6, 1), (2,))]
    found = twin(*point)
    states, inputs, parameters = (tensor.detach().numpy() for tensor in point)
    expected = np.stack([function(*row, parameters).full()[:, 0] for row in zip(states, inputs, strict=True)])
    np.testing.assert_allclose(found.detach(), expected, rtol=1e-12, atol=1e-13)
    found[3].sum().backward()
    slope = ca.Function("g", [x, u, theta], [ca.gradient(ca.sum1(function(x, u, theta)), s) for s in (x, u, theta)])
    exact = [part.full()[:, 0] for part in slope(states[3], inputs[3], parameters)]
    for tensor, gradient in zip((point[0].grad[3], point[1].grad[3], point[2].grad), exact, strict=True):  # type: ignore[index]
        np.testing.assert_allclose(tensor, gradient, rtol=1e-10, atol=1e-12)
    assert twin._layers is not None
    assert twin._layers.n_scalars < 300
