"""(MPC) as data: what it refuses, that it is immutable, and that JSON keeps it bit for bit."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.envs import ENV_IDS
from mpcoffline.mpc import MPC, Constraint, Model, NormCost, Parameter, Penalty, QuadraticCost, StateBounds
from mpcoffline.mpc.parameters import ParameterSpace
from mpcoffline.plants.nominal import nominal_mpc


def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return ca.vertcat(x[1], (u[0] - p["c"] * x[1]) / p["m"])


def make_mpc(**changes: Any) -> MPC:
    arguments: dict[str, Any] = {
        "model": Model(ode, 2, 1, 0.05, {"m": Parameter(1.0, low=0.1), "c": 0.1}),
        "stage_cost": QuadraticCost(np.diag([1.0, 0.1]), [[0.2]], x_ref=[0.3, 0.0], constant=0.7),
        "terminal_cost": NormCost([0.3, 0.0]),
        "horizon": 5,
        "discount": 0.95,
        "action_low": [-2.0],
        "action_high": [np.inf],
    }
    return MPC(**(arguments | changes))


def speed_limit(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return ca.vertcat(x[1] - p["m"], -x[1] - 1.0)


def scalar_dynamics() -> Model:
    return Model(lambda x, u, p: x + u, 1, 1, 0.1, discrete=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, "horizon: expected a positive integer, got 0"),
        ({"horizon": -3}, "horizon"),
        ({"horizon": 2.5}, "horizon"),
        ({"horizon": True}, "horizon"),
        ({"horizon": "10"}, "horizon"),
        ({"horizon": np.nan}, "horizon"),
        ({"discount": 0.0}, r"discount: expected a number in \(0, 1\], got 0.0"),
        ({"discount": 1.0001}, "discount"),
        ({"discount": -0.5}, "discount"),
        ({"discount": np.nan}, "discount"),
        ({"discount": "0.9"}, "discount"),
        ({"action_low": [-1.0, -1.0]}, "action_low: expected 1 numbers, one an input"),
        ({"action_high": [np.nan]}, "action_high"),
        ({"action_low": [3.0], "action_high": [2.0]}, "action_low: expected values below action_high"),
        ({"action_low": [2.0], "action_high": [2.0]}, "action_low"),
        ({"stage_cost": QuadraticCost(np.eye(3), [[1.0]])}, "stage_cost: expected a cost for nx = 2, nu = 1"),
        ({"stage_cost": QuadraticCost(np.eye(2), np.eye(2))}, "stage_cost"),
        ({"stage_cost": QuadraticCost(np.eye(2), np.eye(2), np.zeros((2, 2)))}, "stage_cost"),
        ({"terminal_cost": NormCost([0.0] * 3)}, "terminal_cost: expected a cost for nx = 2"),
        ({"terminal_cost": QuadraticCost(np.eye(3))}, "terminal_cost"),
        ({"terminal_cost": NormCost([0.0])}, "terminal_cost"),
        ({"model": scalar_dynamics(), "stage_cost": QuadraticCost(np.eye(2), [[1.0]])}, "stage_cost"),
        ({"constraints": lambda x, u, p: x.T}, "constraints: expected a column"),
        ({"constraints": lambda x, u, p: math.sin(x[0])}, "constraints"),
        ({"constraints": lambda x, u, p: None}, "constraints"),
        ({"constraints": lambda x, u, p: x[5]}, "constraints"),
    ],
)
def test_bad_problems_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        make_mpc(**changes)


def test_replace_is_checked_too() -> None:
    with pytest.raises(InvalidArgumentError, match="horizon"):
        make_mpc().replace(horizon=0)
    with pytest.raises(InvalidArgumentError, match="discount"):
        make_mpc().replace(discount=2.0)


def test_the_problem_is_immutable() -> None:
    mpc = make_mpc()
    with pytest.raises(dataclasses.FrozenInstanceError):
        mpc.horizon = 3  # type: ignore[misc]
    other = mpc.replace(horizon=7)
    assert (mpc.horizon, other.horizon) == (5, 7)
    mpc.theta[:] = 0.0
    assert mpc.values["model.m"] == 1.0


def test_arrays_given_are_copied() -> None:
    low, W = np.array([-2.0]), np.eye(2)
    mpc = make_mpc(action_low=low, stage_cost=QuadraticCost(W, [[1.0]]))
    low[:], W[:] = 5.0, 7.0
    assert mpc.action_low == -2.0
    np.testing.assert_array_equal(mpc.values["stage_cost.W"], np.eye(2))


def test_theta_is_named_and_ordered() -> None:
    mpc = make_mpc()
    assert [block.name for block in mpc.space] == [
        *("model.m", "model.c"),
        *("stage_cost.W", "stage_cost.R", "stage_cost.u_ref", "stage_cost.x_ref", "stage_cost.constant"),
        "terminal_cost.x_ref",
    ]
    assert [block.group for block in mpc.space] == [
        *("model", "model", "cost", "cost", "reference", "reference", "cost", "reference")
    ]
    quadratic_terminal = make_mpc(terminal_cost=QuadraticCost(np.eye(2)))
    assert quadratic_terminal.space[-3].name == "terminal_cost.W"
    assert quadratic_terminal.space[-3].group == "terminal"


def test_with_theta() -> None:
    mpc = make_mpc()
    theta = mpc.space.pack({"model.m": 3.0, "stage_cost.R": [[4.0]], "terminal_cost.x_ref": [1.0, 1.0]})
    other = mpc.with_theta(theta)
    np.testing.assert_array_equal(other.theta, theta)
    assert other.values["model.m"] == 3.0
    assert mpc.values["model.m"] == 1.0
    assert other.model.values["m"] == 3.0
    # The functions take theta as an argument: the numbers of one problem give the other's values.
    x, u = np.array([0.1, 0.2]), np.array([0.5])
    for name in ("dynamics_function", "stage_function"):
        np.testing.assert_array_equal(getattr(mpc, name)(x, u, theta), getattr(other, name)(x, u, other.theta))
    np.testing.assert_array_equal(other.dynamics_function(x, u, theta).full().ravel(), other.model(x, u))
    for bad in (theta[:-1], np.where(np.arange(len(theta)) == 0, 0.01, theta), theta * np.nan):
        with pytest.raises(InvalidArgumentError, match="theta"):
            mpc.with_theta(bad)


def test_with_values_replaces_by_name_and_keeps_the_rest() -> None:
    mpc = make_mpc().with_values({"model.m": 3.0})
    again = mpc.with_values({"stage_cost.R": [[4.0]]})
    assert (again.values["model.m"], again.values["stage_cost.R"].item()) == (3.0, 4.0)
    assert mpc.values["stage_cost.R"].item() == pytest.approx(0.2)
    with pytest.raises(UnknownIdError, match=r"model\.mass"):
        mpc.with_values({"model.mass": 1.0})
    with pytest.raises(InvalidArgumentError):
        mpc.with_values({"model.m": 0.01})


def test_the_reference_is_the_stage_costs_else_the_terminal_costs() -> None:
    class InputCost(QuadraticCost):
        """u^2, which pulls the state nowhere."""

        def __init__(self) -> None:
            self.space = ParameterSpace([])

        def expression(self, x: ca.SX, u: ca.SX, p: Any) -> ca.SX:
            return ca.sumsqr(u)

        def terminal_expression(self, x: ca.SX, p: Any) -> ca.SX:
            return ca.SX(0)

    there = NormCost([9.0, 8.0])
    np.testing.assert_array_equal(make_mpc(terminal_cost=there).reference, [0.3, 0.0])
    np.testing.assert_array_equal(make_mpc(stage_cost=InputCost(), terminal_cost=there).reference, [9.0, 8.0])
    assert make_mpc(stage_cost=InputCost(), terminal_cost=InputCost()).reference is None


def test_stage_and_terminal_functions() -> None:
    mpc = make_mpc()
    x, u = np.array([1.0, -2.0]), np.array([0.5])
    stage = 0.7**2 + 0.1 * 4.0 + 0.2 * 0.25 + 0.7
    assert float(mpc.stage_function(x, u, mpc.theta)) == pytest.approx(stage, rel=1e-14)
    np.testing.assert_allclose(mpc.stage_costs(np.array([x, 2.0 * x]), np.array([u, u]))[0], stage, rtol=1e-14)
    terminal = np.sqrt(0.7**2 + 4.0 + 0.01) - 0.1
    assert float(mpc.terminal_function(x, mpc.theta)) == pytest.approx(terminal, rel=1e-14)


def test_constraints_see_the_model_parameters() -> None:
    mpc = make_mpc(constraints=speed_limit)
    h = mpc.constraint_function
    assert h is not None
    np.testing.assert_allclose(h([0, 3], [0], mpc.theta).full().ravel(), [2.0, -4.0])
    heavier = mpc.with_values({"model.m": 2.0})
    np.testing.assert_allclose(h([0, 3], [0], heavier.theta).full().ravel(), [1.0, -4.0])
    assert make_mpc().constraint_function is None


def json_roundtrip(mpc: MPC) -> MPC:
    return MPC.from_json(json.loads(json.dumps(mpc.to_json(), allow_nan=False)))


def assert_same(left: MPC, right: MPC) -> None:
    np.testing.assert_array_equal(left.theta, right.theta)
    np.testing.assert_array_equal(left.space.low, right.space.low)
    np.testing.assert_array_equal(left.space.high, right.space.high)
    assert left.space.names == right.space.names
    assert [b.group for b in left.space] == [b.group for b in right.space]
    assert (left.horizon, left.discount) == (right.horizon, right.discount)
    np.testing.assert_array_equal(left.action_low, right.action_low)
    np.testing.assert_array_equal(left.action_high, right.action_high)
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(left.nx, 50)), rng.normal(size=(left.nu, 50))
    for name, inputs in (
        ("dynamics_function", (x, u)),
        ("stage_function", (x, u)),
        ("terminal_function", (x,)),
        ("constraint_function", (x, u)),
    ):
        f, g = getattr(left, name), getattr(right, name)
        assert (f is None) == (g is None)
        if f is not None:
            np.testing.assert_array_equal(f(*inputs, left.theta).full(), g(*inputs, left.theta).full())


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_json_of_the_tasks(env_id: str) -> None:
    mpc = nominal_mpc(env_id, seed=0)
    assert_same(mpc, json_roundtrip(mpc))
    assert json_roundtrip(mpc).to_json() == mpc.to_json()


def test_json_with_constraints_and_odd_numbers() -> None:
    mpc = make_mpc(constraints=speed_limit, discount=1.0 / 3.0, terminal_cost=QuadraticCost(np.diag([1.0 / 3.0, 0.0])))
    assert_same(mpc, json_roundtrip(mpc))
    assert_same(mpc, json_roundtrip(json_roundtrip(mpc)))


@pytest.mark.parametrize("key", list(make_mpc().to_json()))
def test_json_that_lacks_something(key: str) -> None:
    data = make_mpc().to_json()
    del data[key]
    with pytest.raises(FileFormatError, match="MPC: expected the JSON form of an MPC"):
        MPC.from_json(data)


@pytest.mark.parametrize(
    "path",
    [
        ("horizon",),
        ("discount",),
        ("action_low",),
        ("model",),
        ("model", "nx"),
        ("model", "dt"),
        ("model", "function"),
        ("model", "function", "instructions"),
        ("model", "blocks"),
        ("model", "blocks", 0),
        ("model", "blocks", 0, "theta"),
        ("model", "blocks", 0, "low"),
        ("stage_cost",),
        ("stage_cost", "kind"),
        ("stage_cost", "blocks"),
        ("terminal_cost", "eps"),
        ("constraints",),
    ],
)
@pytest.mark.parametrize("value", ["scrap", 0, [], {}, [[[]]], -1.5])
def test_damaged_json_is_refused(path: tuple[Any, ...], value: Any) -> None:
    data = json.loads(json.dumps(make_mpc(constraints=speed_limit).to_json()))
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(FileFormatError):
        MPC.from_json(data)


@pytest.mark.parametrize("data", [None, [], "text", 3, {}])
def test_anything_else_is_refused(data: Any) -> None:
    with pytest.raises(FileFormatError):
        MPC.from_json(data)


# ---------------------------------------------------------------- constraints and thetas along the horizon


def limits() -> list[Constraint | StateBounds]:
    return [
        Constraint(speed_limit, "speed limit"),
        Constraint(lambda x, u, p: u[0] * x[0] - 1.0, "power", Penalty(l1=2.0, l2=1.0 / 3.0)),
        Constraint(lambda x, p: x[0] - p["c"], "goal", terminal=True),
        StateBounds([-np.inf, -1.0], [2.0, np.inf]),
        StateBounds([-1.0, -1.0], [1.0, 1.0], "comfort", Penalty(l2=0.5)),
    ]


def test_constraints_by_place() -> None:
    mpc = make_mpc(constraints=limits())
    assert [c.name for c in mpc.constraints_at("stages")] == ["speed limit", "power"]
    assert [c.name for c in mpc.constraints_at("end")] == ["goal"]
    assert [b.name for b in mpc.state_bounds] == ["state bounds", "comfort"]
    assert mpc.constraint_function is not None
    np.testing.assert_allclose(mpc.constraint_function([0, 3], [0], mpc.theta).full().ravel(), [2.0, -4.0])
    (goal,) = mpc.constraints_at("end")
    assert float(mpc.constraint_expression(goal)(ca.SX([0.7, 0.0]), ca.SX(mpc.theta))) == pytest.approx(0.6)
    assert make_mpc(constraints=[]).constraints is None
    assert make_mpc(constraints=limits()[4]).constraint_function is None
    assert len(mpc.replace(horizon=7).constraints) == 5  # fitted ones are kept
    with pytest.raises(InvalidArgumentError, match="speed limit: expected a function of inputs of sizes"):
        mpc.replace(model=Model(lambda x, u, p: ca.vertcat(x[1], u), 2, 1, 0.1), constraints=mpc.constraints[:1])


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        (lambda: Constraint(speed_limit, ""), "name of a constraint: expected from 1 to 100 characters"),
        (
            lambda: Constraint(speed_limit, soft=Penalty()),
            "constraints.soft: expected weights >= 0, one of them positive",
        ),
        (lambda: Constraint(speed_limit, soft=Penalty(-1.0, 2.0)), "constraints.soft"),
        (lambda: Constraint(speed_limit, soft=Penalty(np.inf)), "constraints.soft"),
        (lambda: Constraint(speed_limit, "goal", terminal=True), "goal: expected a function of CasADi SX"),
        (lambda: Constraint(lambda x, u, p: ca.SX(0, 1)), "constraints: expected a column"),
        (lambda: StateBounds([1.0, 1.0], [0.0, 2.0]), "state bounds: expected low <= high"),
        (lambda: StateBounds([0.0], [1.0, 2.0]), "state bounds: expected low <= high of one shape"),
        (lambda: StateBounds([0.0, np.nan], [1.0, 2.0]), "state bounds: expected low <= high"),
        (lambda: StateBounds([0.0], [1.0]), r"state bounds: expected 2 numbers, one a state, got shape \(1,\)"),
        (lambda: [Constraint(speed_limit), Constraint(speed_limit)], "names of constraints: expected unique names"),
        (lambda: [speed_limit], "expected a function .* or a list of Constraint and StateBounds"),
        (lambda: 3.0, "constraints: expected constraints, got 3.0"),
        (lambda: ca.Function("h", [ca.SX.sym("x", 2)], [1]), r"expected a function of inputs of sizes \[2, 1, 2\]"),
    ],
)
def test_bad_constraints_are_refused(constraints: Any, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        make_mpc(constraints=constraints())


def test_json_of_all_constraints() -> None:
    mpc = make_mpc(constraints=limits())
    read = json_roundtrip(mpc)
    assert_same(mpc, read)
    assert read.to_json() == mpc.to_json()
    for left, right in zip(mpc.constraints, read.constraints, strict=True):
        assert (left.name, left.soft) == (right.name, right.soft)
    np.testing.assert_array_equal(read.state_bounds[0].low, [-np.inf, -1.0])
    np.testing.assert_array_equal(read.state_bounds[0].high, [2.0, np.inf])


@pytest.mark.parametrize("place", range(5))
@pytest.mark.parametrize("value", ["scrap", 0, {}, [[[]]], -1.5])
def test_damaged_constraints_are_refused(place: int, value: Any) -> None:
    entry = make_mpc(constraints=limits()).to_json()["constraints"][place]
    for key in entry:
        if (key, value) in (("name", "scrap"), ("terminal", 0)):
            continue
        data = json.loads(json.dumps(make_mpc(constraints=limits()).to_json()))
        data["constraints"][place][key] = value
        with pytest.raises(FileFormatError):
            MPC.from_json(data)
        del data["constraints"][place][key]
        with pytest.raises(FileFormatError):
            MPC.from_json(data)


def test_theta_along_the_horizon() -> None:
    mpc = make_mpc()
    path = np.arange(10.0).reshape(5, 2)
    theta = mpc.theta_along({"stage_cost.x_ref": path, "model.m": np.arange(1.0, 7.0), "stage_cost.R": [[3.0]]})
    assert theta.shape == (1, 6, mpc.space.size)
    for k in range(6):
        values = mpc.space.unpack(theta[0, k])
        np.testing.assert_array_equal(values["stage_cost.x_ref"], path[min(k, 4)])
        assert values["model.m"] == 1.0 + k
        np.testing.assert_allclose(values["stage_cost.R"], [[3.0]], rtol=1e-15)
        np.testing.assert_array_equal(values["terminal_cost.x_ref"], [0.3, 0.0])
    with pytest.raises(InvalidArgumentError, match=r"stage_cost.x_ref: expected shape \(2,\), \(5, 2\) or \(6, 2\)"):
        mpc.theta_along({"stage_cost.x_ref": np.zeros((4, 2))})
    with pytest.raises(UnknownIdError, match=r"stage_cost\.x_ref"):
        mpc.theta_along({"stage_cost.xref": np.zeros((5, 2))})
    with pytest.raises(InvalidArgumentError, match=r"model\.m"):
        mpc.theta_along({"model.m": np.zeros(5)})
