"""Costs of one's own: saved by their expression, or as their class says where it is registered."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.mpc import COSTS, MPC, Block, ExpressionCost, Model, ParameterSpace, QuadraticCost
from mpcoffline.mpc.component import Component
from mpcoffline.mpc.seen import sees_memory
from mpcoffline.mpc.signals import Signal


class Huber(Component):
    """c + sum of w_i (sqrt(1 + z_i^2) - 1) + |C'z|^2 with W = C C', in the state alone or in state and input."""

    convex = True

    def __init__(self, n: int) -> None:
        rng = np.random.default_rng(n)
        half = rng.normal(size=(n, n))
        blocks = [Block.free("c", np.array(0.5), "cost"), Block.free("w", rng.uniform(1.0, 2.0, n), "cost")]
        blocks += [Block.psd("W", half @ half.T, "cost"), Block.free("M", rng.normal(size=(2, n)), "reference")]
        self.space = ParameterSpace(blocks)

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        return self.terminal_expression(ca.vertcat(x, u), p)

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        bent = ca.dot(p["w"], ca.sqrt(1.0 + x**2) - 1.0)
        return p["c"] + bent + ca.sumsqr(p["W"].T @ x) + ca.sumsqr(p["M"] @ x)


def truth(cost: Huber, z: np.ndarray[Any, Any]) -> float:
    v = cost.values
    return float(v["c"] + v["w"] @ (np.sqrt(1.0 + z**2) - 1.0) + z @ v["W"] @ z + ((v["M"] @ z) ** 2).sum())


def problem(**changes: Any) -> MPC:
    arguments: dict[str, Any] = {
        "model": Model(lambda x, u, p: 0.9 * x + ca.vertcat(0.0, u[0]), 2, 1, 0.1, discrete=True),
        "stage_cost": Huber(3),
        "terminal_cost": Huber(2),
        "horizon": 3,
        "discount": 0.9,
        "action_low": [-1.0],
        "action_high": [1.0],
    }
    return MPC(**(arguments | changes))


def again(document: dict[str, Any]) -> MPC:
    return MPC.from_json(json.loads(json.dumps(document)))


def test_an_own_cost_is_saved_by_its_expression() -> None:
    mpc = problem()
    loaded = again(mpc.to_json())
    assert [type(cost) for cost in (loaded.stage_cost, loaded.terminal_cost)] == [ExpressionCost] * 2
    assert loaded.stage_cost.convex is True  # type: ignore[attr-defined]
    assert loaded.space.names == mpc.space.names
    assert loaded.to_json() == again(loaded.to_json()).to_json()
    rng = np.random.default_rng(1)
    values = {name: rng.uniform(1.0, 2.0, np.shape(v)) for name, v in mpc.values.items() if not name.endswith(".W")}
    for one in (mpc.theta, mpc.with_values(values).theta):  # parameters stay parameters
        x, u = rng.normal(size=2), rng.normal(size=1)
        changed = mpc.with_theta(one)
        expected = truth(changed.stage_cost, np.r_[x, u]), truth(changed.terminal_cost, x)  # type: ignore[arg-type]
        found = float(loaded.stage_function(x, u, one)), float(loaded.terminal_function(x, one))
        np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_what_is_no_arithmetic_is_refused() -> None:
    class Loud(Huber):
        def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
            return super().terminal_expression(x, p).printme(0.0)

    with pytest.raises(InvalidArgumentError, match="cost: expected a function of plain arithmetic"):
        problem(terminal_cost=Loud(2)).to_json()


def test_a_registered_cost_is_saved_as_its_class_says(monkeypatch: pytest.MonkeyPatch) -> None:
    class Named(QuadraticCost):
        pass

    mpc = problem(stage_cost=Named(np.eye(2), [[1.0]]), terminal_cost=QuadraticCost(np.eye(2)))
    assert mpc.to_json()["stage_cost"]["kind"] == "ExpressionCost"
    monkeypatch.setattr(COSTS, "_things", dict(COSTS.items()))
    COSTS.add("tests.Named", Named)
    document = mpc.to_json()
    assert document["stage_cost"]["kind"] == "tests.Named"
    assert type(again(document).stage_cost) is Named
    assert mpc.to_json(portable=True)["stage_cost"]["kind"] == "ExpressionCost"
    assert mpc.to_json(portable=True)["terminal_cost"] == document["terminal_cost"]
    monkeypatch.undo()
    with pytest.raises(FileFormatError, match=r"got 'tests\.Named'\. .* import what registers"):
        again(document)


@pytest.mark.parametrize(
    "change",
    [
        lambda f: f.update(inputs=[2, 1, 3]),
        lambda f: f.update(inputs=[10**9, 1, 16]),
        lambda f: f.update(inputs=[2, 1, 1, 16]),
        lambda f: f.update(inputs=[16]),
        lambda f: f.update(inputs=["2", 1, 16]),
        lambda f: f.update(inputs=[3, 1, 16]),
        lambda f: f.update(output=2),
        lambda f: f.update(instructions=[["import", 0, "os"]]),
    ],
)
def test_damaged_functions_are_refused(change: Any) -> None:
    document = json.loads(json.dumps(problem().to_json()))
    assert document["stage_cost"]["function"]["inputs"] == [2, 1, 16]
    change(document["stage_cost"]["function"])
    with pytest.raises(FileFormatError):
        MPC.from_json(document)


class Priced(Component):
    """(x_1 - d.goal)^2 + (u - u_before)'(u - u_before)."""

    uses_previous = uses_signals = True

    def __init__(self) -> None:
        self.space = ParameterSpace([])

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX], *before: ca.SX, d: Any = None) -> ca.SX:
        return ca.SX((x[1] - d.goal) ** 2 + ca.sumsqr(u - before[0]))

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX], *, d: Any = None) -> ca.SX:
        return ca.SX((x[1] - d.goal) ** 2)


@pytest.mark.parametrize("delay", [None, 0, (2, 1)])
def test_a_cost_that_was_saved_fits_another_dead_time(delay: tuple[int, int] | None) -> None:
    """As when a learner that was saved before its fit finds one."""
    model = Model(lambda x, u, p: x + u, 2, 2, 1.0, discrete=True, delay=delay, signals=[Signal("goal", preview=1)])
    mpc = MPC(model, Priced(), Priced(), 5, 0.9, [-1.0, -1.0], [1.0, 1.0])
    read = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    assert read.layout == mpc.layout
    assert sees_memory(read.layout, read.stage_cost)
    for other in (read, read.with_delay((0, 3)), read.with_delay(0)):
        past = np.arange(1.0, 1.0 + other.layout.n_memory)
        z, u = other.state([0.1, 0.2, 0.7, 0.9], past), np.array([0.4, -0.3])
        before = past[[list(other.layout.names).index(name) for name in ("u0[k-1]", "u1[k-1]")]]
        expected = 0.5**2 + np.sum((u - before) ** 2)
        assert float(other.stage_function(z, u, other.theta)) == pytest.approx(expected)
        assert float(other.terminal_function(z, other.theta)) == pytest.approx(0.25)
