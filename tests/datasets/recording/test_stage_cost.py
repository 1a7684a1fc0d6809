"""Which number is the stage cost: the rule itself, and what recordings make of it."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets.recording.stage_cost import PlantInfo, number_of, reward_of, same_in_float32

NUMBERS = st.floats(-1e30, 1e30)


@given(NUMBERS)
def test_a_cost_that_is_minus_the_reward_keeps_its_digits(cost: float) -> None:
    for reward in (-cost, float(np.float32(-cost))):
        rule = PlantInfo("test")
        assert rule.cost({"cost": cost}, reward) == cost
        assert rule.has_cost


@given(st.lists(NUMBERS, min_size=1, max_size=8), st.data())
def test_from_the_first_mismatch_on_the_reward_counts(costs: list[float], data: st.DataObject) -> None:
    """Whatever the key says afterwards: costs of 0 and 1 coincide with rewards now and then."""
    other = data.draw(NUMBERS.filter(lambda reward: not same_in_float32(reward, 1.0)))
    rule = PlantInfo("test")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert rule.cost({"cost": -1.0}, other) == -other
        assert [rule.cost({"cost": cost}, -cost) for cost in costs] == costs  # the reward, which is the same
        assert rule.has_cost is False
    assert len(told) == 1


@pytest.mark.parametrize("factor", [1e-20, 1.0, 1e20])
def test_the_unit_of_the_cost_does_not_matter(factor: float) -> None:
    rule = PlantInfo("test")
    assert rule.cost({"cost": 0.1 * factor}, float(np.float32(-0.1 * factor))) == 0.1 * factor
    with pytest.warns(UserWarning, match="the reward counts"):
        assert rule.cost({"cost": 0.1 * factor}, -0.1001 * factor) == 0.1001 * factor


def test_the_warning_names_the_key_and_both_numbers() -> None:
    with pytest.warns(UserWarning, match=r"test: info\['cost'\] is 1\.0, .* a reward of -9\.25: the reward counts"):
        PlantInfo("test").cost({"cost": 1.0}, -9.25)


@pytest.mark.parametrize(
    "value", [None, "1.0", {"of": 1.0}, [1.0, 2.0], [[1.0], [2.0, 3.0]], np.array([]), 1j, object()]
)
def test_what_is_no_number_is_told_of_once_and_left_out(value: Any) -> None:
    rule = PlantInfo("test")
    with pytest.warns(UserWarning, match=r"info\['cost'\] is ") as told:
        assert [rule.cost({"cost": value}, -1.0) for _ in range(3)] == [1.0] * 3
    assert len(told) == 1
    assert rule.has_cost is False


@pytest.mark.parametrize(
    "value", [1, 1.0, np.float32(1.0), np.array([1.0]), np.array([[1]]), np.array(1.0), True, [1.0]]
)
def test_arrays_of_one_are_numbers(value: Any) -> None:
    assert number_of(value) == 1.0
    assert PlantInfo("test").cost({"cost": value}, -1.0) == 1.0
    assert reward_of("test", value) == 1.0


def test_a_reward_must_be_a_number() -> None:
    with pytest.raises(InvalidDataError, match="env: reward: expected a number, got None"):
        reward_of("env", None)


def test_a_plant_without_the_key_is_not_told_anything() -> None:
    rule = PlantInfo("test")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rule.cost({}, -2.0) == 2.0
    assert rule.has_cost is False


def test_a_key_that_comes_and_goes_does_not_count() -> None:
    for infos in ([{"cost": 1.0}, {}], [{}, {"cost": 1.0}]):
        rule = PlantInfo("test")
        with pytest.warns(UserWarning, match="the reward counts"):
            assert [rule.cost(info, -1.0) for info in infos] == [1.0, 1.0]
        assert rule.has_cost is False


def test_a_reward_that_a_wrapper_changed_is_told_of_where_it_would_have_counted() -> None:
    with pytest.warns(UserWarning, match=r"a wrapper makes -0\.5 of the plant's reward of -5\.0"):
        assert PlantInfo("test").cost({}, -5.0, given=-0.5) == 5.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert PlantInfo("test").cost({"cost": 5.0}, -5.0, given=-0.5) == 5.0


def test_a_claim_is_held_to() -> None:
    rule = PlantInfo("test", "energy")
    assert rule.cost({"energy": 2.0, "cost": 0.0}, -2.0) == 2.0
    with pytest.raises(InvalidArgumentError, match=r"info\['energy'\].*cost_key names it, got the keys \['cost'\]"):
        rule.cost({"cost": 2.0}, -2.0)
    with pytest.raises(InvalidArgumentError, match=r"info\['energy'\].*got 'much'"):
        rule.cost({"energy": "much"}, -2.0)
    with pytest.raises(InvalidDataError, match=r"minus the reward that the plant paid \(-2\.5\).*got 2\.0"):
        rule.cost({"energy": 2.0}, -2.5)
    for wrong in (3, b"cost", ["cost"]):
        with pytest.raises(InvalidArgumentError, match="cost_key"):
            PlantInfo("test", wrong)  # type: ignore[arg-type]


def test_nan_is_not_another_number() -> None:
    rule = PlantInfo("test")
    assert math.isnan(rule.cost({"cost": math.nan}, math.nan))
    assert rule.has_cost


# ---------------------------------------------------------------- states


def test_states_of_one_shape_count() -> None:
    rule = PlantInfo("test")
    assert rule.state({}, reset=True) is None
    for value in (3.0, [4], np.float32(5.0)):
        found = rule.state({"state": value})
        assert found is not None
        assert found.tolist() == [float(np.squeeze(value))]
    assert rule.has_state


@pytest.mark.parametrize("value", [None, "rest", {"x": 1.0}, [1.0, 2.0, 3.0], np.zeros((2, 2)), [[1.0], [2.0, 3.0]]])
def test_states_of_another_kind_are_told_of_once_and_left_out(value: Any) -> None:
    rule = PlantInfo("test")
    assert rule.state({"state": [1.0, 2.0]}, reset=True) is not None
    with pytest.warns(UserWarning, match=r"info\['state'\] is .*numbers of shape \(2,\)") as told:
        found = [rule.state({"state": each}) for each in (value, value, [1.0, 2.0])]
    assert found == [None] * 3
    assert len(told) == 1
    assert rule.has_state is False


def test_a_state_that_is_missing_at_a_step_is_told_of() -> None:
    rule = PlantInfo("test")
    rule.state({"state": [1.0]})
    with pytest.warns(UserWarning, match=r"info\['state'\] is None"):
        assert rule.state({}) is None
    assert rule.has_state is False
