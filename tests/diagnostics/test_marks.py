"""Set-points, limits and signals beside closed loops, as the description tells them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mpcoffline import Input, Limit, Parameter, Plant, Signal, State
from mpcoffline.diagnostics.marks import INPUT, STATE, marks_of


def room(**changes: Any) -> Plant:
    """Two masses, of which the air is to follow a set-point; outside and tariff come from elsewhere."""
    parts: dict[str, Any] = {
        "dt": 60.0,
        "states": [State("air", "K", 0, 50), State("wall", "K", 0, 50)],
        "inputs": [Input("power", "kW", 0, 3, rate=1.0, delay=2), Input("fan", "", -np.inf, np.inf)],
        "signals": [Signal("tariff", "EUR"), Signal("wanted", "K"), Signal("outside", "K", preview=2)],
        "parameters": {"a": Parameter(0.1)},
        "dynamics": lambda x, u, d, p: [p.a * (x.wall - x.air) + u.power, d.outside - x.wall + u.fan],
        "cost": {"air": 2.0, "power": 0.1},
        "references": {"air": "wanted"},
        "limits": [
            Limit("warm", "air", low=17.0, high=24.0, soft=5.0),
            Limit("above outside", lambda x, d: 2.0 * (x.wall - d.outside), low=4.0, soft=1.0),
            Limit("both", lambda x: x.air + x.wall, high=50.0, soft=1.0),
            Limit("squared", lambda x: x.wall**2, high=900.0, soft=1.0),
            Limit("fan", "fan", high=7.0),
        ],
    }
    return Plant("room", **parts | changes)


def observations(n: int = 5) -> np.ndarray:
    """States that are no matter, and signals: tariff, wanted, outside now and two steps ahead."""
    k = np.arange(n, dtype=np.float64)
    return np.stack([k + 900.0, k - 900.0, 0.1 * k, 20.0 + k, k, k + 1.0, k + 2.0], axis=1)


def test_set_points_limits_and_signals_are_those_of_the_description() -> None:
    found = marks_of(room().mpc(), observations())
    assert list(found.wanted) == [0]  # the wall has no weight
    np.testing.assert_allclose(found.wanted[0], [20.0, 21.0, 22.0, 23.0, 24.0])
    assert sorted(found.outside) == [2, 4]  # the tariff, and what it is like outside now
    np.testing.assert_allclose(found.outside[2], [0.0, 0.1, 0.2, 0.3, 0.4])
    ends = {place: sorted(course.tolist() for course in courses) for place, courses in found.limits.items()}
    assert ends == {
        (STATE, 0): [[17.0] * 5, [24.0] * 5],
        (STATE, 1): [[2.0, 3.0, 4.0, 5.0, 6.0]],  # it moves with a signal; what is not a line in one state is none
        (INPUT, 0): [[0.0] * 5, [3.0] * 5],
        (INPUT, 1): [[7.0] * 5],
    }


def test_a_fixed_goal_is_wanted_throughout() -> None:
    plant = room(references={"air": 21.0}, signals=[Signal("outside", "K")], limits=[])
    found = marks_of(plant.mpc(), observations()[:, :3])
    np.testing.assert_allclose(found.wanted[0], 21.0)
    assert list(found.outside) == [2]


def test_a_cost_without_a_goal_has_none() -> None:
    plant = room(cost=lambda x, u, d: d.tariff * u.power + abs(x.air - d.wanted), references={}, limits=[])
    found = marks_of(plant.mpc(), observations())
    assert found.wanted == {}
    assert sorted(found.outside) == [2, 3, 4]


def test_clocks_are_not_drawn() -> None:
    plant = room(signals=[Signal("wanted", "K"), Signal("day", period=10), Signal("outside", "K")], limits=[])
    mpc = plant.mpc()
    assert mpc.ny == 6
    found = marks_of(mpc, np.zeros((3, 6)))
    assert list(found.outside) == [5]


@pytest.mark.parametrize("delay", [0, 3])
def test_past_inputs_are_no_matter(delay: int) -> None:
    mpc = room(limits=[]).mpc().with_delay([delay, 0])
    assert set(marks_of(mpc, observations()).limits) == {(INPUT, 0)}
