"""Tables written out as arithmetic against CasADi's own evaluation of them."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch

from mpcoffline.mpc import MPC, Model, QuadraticCost, tables
from mpcoffline.mpc.expressions import instructions, without_tables
from mpcoffline.mpc.torch_twin import TorchTwin

CASES = [(kind, n, m) for kind in ("linear", "bspline") for n in (1, 2, 3) for m in (1, 2)]


def interpolant(kind: str, n: int, m: int = 1, seed: int = 0) -> tuple[ca.Function, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    grid = [np.sort(rng.uniform(-2, 2, 5 + d)) for d in range(n)]
    values = rng.normal(size=m * int(np.prod([len(axis) for axis in grid])))
    return ca.interpolant("table", kind, grid, values), grid


def calls(function: ca.Function) -> bool:
    return any(instruction.op == ca.OP_CALL for instruction in instructions(function))


@pytest.mark.parametrize(("kind", "n", "m"), CASES)
def test_values_and_slopes_are_casadis(kind: str, n: int, m: int) -> None:
    table, grid = interpolant(kind, n, m)
    x = ca.SX.sym("x", n)
    called = ca.Function("f", [x], [ca.vertcat(2 * table(x), ca.sin(x[0]), table(ca.cos(x)))])
    written = without_tables(called)
    assert calls(called)
    assert not calls(written)
    slopes = [ca.Function("J", [x], [ca.densify(ca.jacobian(f(x), x))]) for f in (called, written)]
    rng = np.random.default_rng(1)
    low, high = (np.array([axis[k] for axis in grid]) for k in (0, -1))
    points = [*rng.uniform(low - 1, high + 1, (60, n)), low, high]  # beyond the grid, too, and at its ends
    for point in points:
        np.testing.assert_allclose(written(point).full(), called(point).full(), rtol=1e-12, atol=1e-13)
    for point in points[:60]:
        np.testing.assert_allclose(slopes[1](point).full(), slopes[0](point).full(), rtol=1e-11, atol=1e-11)


def model(kind: str, n: int) -> tuple[Model, ca.Function]:
    table, _ = interpolant(kind, n, seed=3)

    def step(x: Any, u: Any, p: dict[str, Any]) -> Any:
        return ca.vertcat(x[0] + 0.1 * x[1], p["a"] * x[1] + 0.1 * u - 0.05 * table(ca.vertcat(x, u)[:n]))

    return Model(step, 2, 1, 0.1, {"a": 0.9}, discrete=True), table


@pytest.mark.parametrize("kind", ["linear", "bspline"])
@pytest.mark.parametrize("n", [1, 3])
def test_models_with_tables_go_through_files_and_torch(kind: str, n: int) -> None:
    given, table = model(kind, n)
    mpc = MPC(given, QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(np.eye(2)), 5, 0.95, [-1.0], [1.0])
    loaded = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (20, 1))
    lookup = np.array([float(table(row[:n])) for row in np.hstack([x, u])])
    expected = np.stack([x[:, 0] + 0.1 * x[:, 1], 0.9 * x[:, 1] + 0.1 * u[:, 0] - 0.05 * lookup], axis=1)
    np.testing.assert_allclose(loaded.model(x, u), expected, rtol=1e-12, atol=1e-13)
    twin = TorchTwin(mpc.dynamics_function)
    given_theta = torch.tensor(mpc.theta)
    np.testing.assert_allclose(twin(torch.tensor(x), torch.tensor(u), given_theta), expected, rtol=1e-12, atol=1e-13)


def test_a_very_large_table_stays_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "LARGEST", 4)
    assert calls(model("linear", 1)[0].function)


def test_a_function_that_does_more_than_look_up_is_no_table() -> None:
    table, _ = interpolant("linear", 1)
    x = ca.MX.sym("x")
    assert tables.as_arithmetic(ca.Function("f", [x], [table(x) + 1])) is None
