"""Layers found in scalar arithmetic: evaluated step by step, they are the function."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mpcoffline.mpc.expressions import expanded
from mpcoffline.mpc.integrators import rk4_expression
from mpcoffline.mpc.layer_steps import Dense, Map, Node, Scalars
from mpcoffline.mpc.layers import Layered, layered, may_be_layered


def silu(x: ca.SX) -> ca.SX:
    return x / (1 + ca.exp(-x))


def elu(x: ca.SX) -> ca.SX:
    return ca.if_else(x > 0, x, ca.expm1(x))


ACTIVATIONS: dict[str, Callable[[ca.SX], ca.SX]] = {
    "tanh": ca.tanh,
    "relu": lambda x: ca.fmax(x, 0),
    "silu": silu,
    "elu": elu,
    "gelu": lambda x: 0.5 * x * (1 + ca.erf(x / np.sqrt(2))),
    "softplus": lambda x: ca.log1p(ca.exp(x)),
}


def network(x: ca.SX, sizes: tuple[int, ...], activation: Callable[[ca.SX], ca.SX], seed: int = 0) -> ca.SX:
    rng, h = np.random.default_rng(seed), x
    for k, size in enumerate(sizes):
        h = rng.normal(size=(size, h.numel())) / np.sqrt(h.numel()) @ h + rng.normal(size=size)
        h = activation(h) if k < len(sizes) - 1 else h
    return h


def operation(node: Node, operands: list[float]) -> float:
    a, *rest = map(ca.DM, operands)
    return float(ca.DM.binary(node.op, a, rest[0]) if rest else ca.DM.unary(node.op, a))


def replayed(structure: Layered, inputs: list[np.ndarray]) -> np.ndarray:
    """The outputs, from the steps alone; a step that reads what is not known yet raises KeyError."""
    known: dict[int, float] = {}
    for step in structure.steps:
        if isinstance(step, Scalars):
            for k in step.nodes:
                node = structure.nodes[k]
                if node.op == ca.OP_INPUT:
                    known[k] = float(inputs[node.operands[0]][node.operands[1]])
                elif node.op == ca.OP_CONST:
                    known[k] = node.constant
                else:
                    known[k] = operation(node, [known[o] for o in node.operands])
        elif isinstance(step, Dense):
            values = step.matrix @ [known[k] for k in step.sources] + step.bias
            known.update(zip(step.targets, values, strict=True))
        else:
            assert isinstance(step, Map)
            for i, source in enumerate(step.sources):
                work: list[float] = []
                for op, places in step.program:
                    operands = [
                        known[source] if o == -1 else step.constants[-2 - o, i] if o < 0 else work[o] for o in places
                    ]
                    work.append(operation(Node(op, (), 0.0), operands))
                for result, targets in zip(step.results, step.targets, strict=True):
                    known[targets[i]] = work[result]
    return np.array([known[k] for k in structure.outputs])


def checked(expression: ca.SX, *symbols: ca.SX) -> Layered:
    function = ca.Function("f", list(symbols), [expression])
    structure = layered(function)
    assert structure is not None
    inputs = [np.random.default_rng(1).normal(size=symbol.numel()) for symbol in symbols]
    np.testing.assert_allclose(replayed(structure, inputs), function(*inputs).full()[:, 0], rtol=1e-12, atol=1e-12)
    return structure


def shapes(structure: Layered) -> list[tuple[int, ...]]:
    return [step.matrix.shape for step in structure.steps if isinstance(step, Dense)]


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_networks_are_matrices_and_maps(name: str) -> None:
    x = ca.SX.sym("x", 5)
    structure = checked(network(x, (20, 30, 4), ACTIVATIONS[name]), x)
    assert shapes(structure) == [(20, 5), (30, 20), (4, 30)]
    assert structure.n_scalars == 5  # the inputs


def test_a_runge_kutta_step_calls_the_network_four_times() -> None:
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    structure = checked(rk4_expression(lambda s: network(ca.vertcat(s, u), (24, 24, 4), ca.tanh), x, 0.1), x, u)
    sizes = shapes(structure)
    assert sizes.count((24, 24)) == sizes.count((24, 6)) == 4  # no product of matrices was multiplied out
    assert structure.n_scalars < 30


def test_what_is_around_a_network_stays_scalar() -> None:
    """Physics, parameters, a skip connection, normalised inputs, a layer norm, and weights that were pruned."""
    rng = np.random.default_rng(2)
    x, theta = ca.SX.sym("x", 6), ca.SX.sym("theta", 2)
    weights = rng.normal(size=(16, 6)) * (rng.random((16, 6)) < 0.7)
    h = ca.tanh(weights @ ((x - 0.3) / rng.uniform(1, 2, 6)) * rng.uniform(1, 2, 16) + 0.1)
    h = h + ca.tanh(rng.normal(size=(16, 16)) @ h)
    h = (h - ca.sum1(h) / 16) / ca.sqrt(ca.sumsqr(h - ca.sum1(h) / 16) / 16 + 1e-5)
    out = rng.normal(size=(6, 16)) @ h
    structure = checked(x + theta[0] * ca.vertcat(out[:5], ca.sin(x[0]) / theta[1]) + 0.01 * out, x, theta)
    assert (16, 16) in shapes(structure)


def test_a_product_with_symbols_is_no_layer() -> None:
    x, weights = ca.SX.sym("x", 10), ca.SX.sym("w", 100)
    assert layered(ca.Function("f", [x, weights], [ca.reshape(weights, 10, 10) @ x])) is None


def test_small_functions_have_no_layers() -> None:
    x = ca.SX.sym("x", 4)
    assert layered(ca.Function("f", [x], [ca.vertcat(ca.sin(x[0]), x[1:] * 2)])) is None


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_any_mixture_of_sums_and_operations_is_itself(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = ca.SX.sym("x", 6)
    pool = ca.vertsplit(x)
    for _ in range(rng.integers(2, 5)):
        chosen = ca.vertcat(*(pool[i] for i in rng.integers(len(pool), size=rng.integers(8, 14))))
        matrix = rng.normal(size=(rng.integers(4, 12), chosen.numel())) * (rng.random(chosen.numel()) < 0.8)
        layer = matrix @ chosen + rng.normal() * pool[-1]
        pool += ca.vertsplit(list(ACTIVATIONS.values())[rng.integers(6)](layer) if rng.random() < 0.7 else layer)
    function = ca.Function("f", [x], [ca.vertcat(*(pool[i] for i in rng.integers(len(pool), size=12)), *pool[-4:])])
    structure = layered(function)
    if structure is not None:
        point = rng.normal(size=6)
        np.testing.assert_allclose(replayed(structure, [point]), function(point).full()[:, 0], rtol=1e-9, atol=1e-9)


def test_derivatives_of_a_plant_are_soon_seen_to_have_no_layers() -> None:
    """Ten tanks in a row: thousands of operations with a dozen numbers; a network of few weights has more of these."""
    x, p = ca.SX.sym("x", 10), ca.SX.sym("p", 10)

    def ode(x: ca.SX) -> ca.SX:
        flow = p * ca.sqrt(1.0 + x**2)
        return ca.vertcat(0, flow[:-1]) - flow + 0.1 * ca.sin(x)

    reached = rk4_expression(ode, rk4_expression(ode, x, 0.05), 0.05)
    slope = ca.vec(ca.densify(ca.jacobian(reached, x)))
    plant = expanded(ca.Function("plant", [x, p], [slope]))
    assert plant.n_instructions() > 2000
    assert not may_be_layered(plant)
    assert layered(plant) is None
    assert may_be_layered(expanded(ca.Function("net", [x], [network(x, (8, 1), ca.tanh)])))


def test_weights_of_three_values_are_layers_too() -> None:
    """Quantised ones: there is no telling by how many different numbers there are."""
    x, weights = ca.SX.sym("x", 16), np.random.default_rng(0).choice([-0.7, 0.3, 0.7], size=(16, 16))
    net = ca.Function("net", [x], [ca.tanh(weights @ ca.tanh(weights @ x))])
    assert not may_be_layered(expanded(net))
    structure = layered(net)
    assert structure is not None
    assert sum(isinstance(step, Dense) for step in structure.steps) == 2
