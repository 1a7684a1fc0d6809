"""Plants without equations: what they are described by, and what a log makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import (
    BlackBoxPlant,
    Constraint,
    Input,
    InvalidArgumentError,
    InvalidDataError,
    Limit,
    Output,
    Signal,
    TransitionTable,
    load_plant,
)
from mpcoffline.estimation import LinearModel
from mpcoffline.plants import load_description

FOUND = LinearModel(
    A=np.array([[0.9, 0.1], [0.0, 0.8]]),
    B=np.array([[0.0], [0.5]]),
    E=np.array([[0.2], [0.0]]),
    b=np.array([0.01, 0.02]),
    C=np.array([[10.0, 2.0]]),
    c=np.array([60.0]),
    K=np.zeros((2, 1)),
    delay=(2,),
    inputs=np.array([30.0]),
    noise=np.array([0.3]),
    start=np.array([1.0, -1.0]),
    start_spread=np.array([0.5, 0.25]),
    missed=np.array([0.05]),
    steps=15,
)


def oven(**changes: Any) -> BlackBoxPlant:
    parts: dict[str, Any] = {
        "dt": 30.0,
        "outputs": [Output("T", unit="degC", low=0, high=400)],
        "inputs": [Input("power", "%", 0, 100)],
        "signals": [Signal("set_point", "degC", low=50, high=80)],
        "cost": lambda y, u, d: (y.T - d.set_point) ** 2 + 1e-3 * u.power**2,
    }
    return BlackBoxPlant("oven", **parts | changes)


def test_the_plant_is_the_model_with_the_described_cost_and_limits() -> None:
    box = oven(
        cost=lambda y, u, d, du: (y.T - d.set_point) ** 2 + 0.1 * du.power**2,
        limits=[
            Limit("hot", "T", high=90.0, soft=3.0),
            Limit("both", lambda y, u: y.T + u.power, high=120.0, soft=1.0),
        ],
    )
    plant = box.modelled(FOUND)
    x, u, d, before = np.array([0.3, -0.2]), 40.0, 61.0, 35.0
    gain = 1.2
    after = plant.rates_function(x, u, d, gain).full().ravel()
    expected = FOUND.A @ x + FOUND.B[:, 0] * (30.0 + gain * 10.0) + FOUND.E[:, 0] * d + FOUND.b
    np.testing.assert_allclose(after, expected)
    y = 10.0 * x[0] + 2.0 * x[1] + 60.0
    np.testing.assert_allclose(plant.outputs_function(x), y)
    np.testing.assert_allclose(plant.cost_function(x, u, d, before), (y - d) ** 2 + 0.1 * 25.0)
    assert [each.delay for each in plant.inputs] == [2]
    assert plant.states[0].starts == pytest.approx((1.0 - 0.5 * np.sqrt(3.0), 1.0 + 0.5 * np.sqrt(3.0)))
    mpc = plant.mpc()
    assert mpc.layout.delay == (2,)
    hot, both = mpc.constraints  # type: ignore[misc]
    state = ca.SX([*x, d, before, before, before][: mpc.ny])
    for constraint, most, value in ((hot, 90.0, y), (both, 120.0, y + u)):
        assert isinstance(constraint, Constraint)
        excess = mpc.constraint_expression(constraint)(state, ca.SX(u), ca.SX(mpc.theta))
        assert float(excess) == pytest.approx(value - most)


def test_weights_by_name() -> None:
    box = oven(
        cost={"T": 2.0, "power": 0.01},
        references={"T": "set_point", "power": 20.0},
        changes={"power": 0.5},
        signals=[Signal("set_point", "degC", low=50, high=80)],
    )
    plant = box.modelled(FOUND)
    x = np.array([0.3, -0.2])
    y = float(plant.outputs_function(x))
    expected = 2.0 * (y - 61.0) ** 2 + 0.01 * 20.0**2 + 0.5 * 25.0
    np.testing.assert_allclose(plant.cost_function(x, 40.0, 61.0, 35.0), expected)


def table(n: int = 600, seed: int = 0) -> TransitionTable:
    """A first-order oven, one step late, around its set-points."""
    rng, T, past, rows = np.random.default_rng(seed), 60.0, [30.0], []
    for k in range(n + 1):
        if k % 10 == 0:
            power, set_point = float(rng.uniform(0.0, 100.0)), float(rng.uniform(50.0, 80.0))
        rows.append((T + 0.05 * rng.normal(), set_point, power))
        past.append(power)
        T = 60.0 + 0.95 * (T - 60.0) + 0.04 * (past[k] - 30.0)
    seen = np.array(rows)
    return TransitionTable.from_arrays(
        observations=seen[:-1, :2],
        actions=seen[:-1, 2:],
        costs=np.zeros(n),
        next_observations=seen[1:, :2],
        terminations=np.zeros(n),
        episode_ids=np.arange(n) // 60,
    )


def test_a_log_gives_model_states_and_costs() -> None:
    box, log = oven(), table()
    plant = box.modelled(log)
    assert len(plant.states) == 1
    assert plant.inputs[0].delay == 1
    model = box.model(log)
    assert float(model.A[0, 0]) == pytest.approx(0.95, abs=0.01)
    assert float(model.C[0, 0] * model.B[0, 0]) == pytest.approx(0.04, rel=0.05)
    assert (model.E == 0.0).all()  # a set-point moves nothing
    found = plant.identify(log)
    shown = plant.outputs_function(found.table.values().observations[:, :1].T).full().ravel()
    c = log.values()
    assert np.median(np.abs(shown - c.observations[:, 0])) < 0.05  # what acted before an episode is not known
    costs = (shown - c.observations[:, 1]) ** 2 + 1e-3 * c.actions[:, 0] ** 2
    np.testing.assert_allclose(found.table.values().costs, costs, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"outputs": []}, "outputs"),
        ({"outputs": "T"}, "outputs"),
        ({"outputs": [Output("T", lambda x: x.h)]}, "outputs"),
        ({"cost": lambda x, u: x.T}, r"cost \(test_black_box.py, line \d+\)"),
        ({"cost": lambda y: y.t**2}, r"cost \(test_black_box.py, line \d+\)"),
        ({"cost": {"pressure": 1.0}}, "cost"),
        ({"limits": [Limit("hot", "t", high=90.0)]}, "limit 'hot'"),
        ({"columns": {"t": "TI-1"}}, "columns"),
        ({"inputs": []}, "inputs"),
    ],
)
def test_what_does_not_fit_is_named(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(InvalidArgumentError, match=what):
        oven(**changes)


def test_a_log_of_other_columns_is_refused() -> None:
    box = oven(signals=[], cost=lambda y, u: y.T**2)
    with pytest.raises(InvalidDataError):
        box.model(table())


FILE = """
from mpcoffline import BlackBoxPlant, Input, Output

plant = BlackBoxPlant(
    "oven", dt=30.0, outputs=[Output("T", unit="degC")], inputs=[Input("power", "%", 0, 100)], cost={"T": 1.0}
)
"""


def test_plant_files_may_hold_one(tmp_path: Path) -> None:
    file = tmp_path / "oven.py"
    file.write_text(FILE)
    assert isinstance(load_description(file), BlackBoxPlant)
    with pytest.raises(InvalidDataError, match="mpcoffline check"):
        load_plant(file)
