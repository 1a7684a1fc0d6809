"""Box spaces of every type of number survive a file, and so do the policies that use them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest
from gymnasium import spaces

from mpcoffline import MPCPolicy
from mpcoffline.core.archive import box_from_json, box_to_json
from mpcoffline.core.errors import FileFormatError


def again(space: spaces.Box) -> spaces.Box:
    return box_from_json(json.loads(json.dumps(box_to_json(space), allow_nan=False)))


def same(a: spaces.Box, b: spaces.Box) -> bool:
    bounded = np.array_equal(a.bounded_below, b.bounded_below) and np.array_equal(a.bounded_above, b.bounded_above)
    return a == b and a.dtype == b.dtype and bounded


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.uint64])
def test_integers_keep_every_digit(dtype: Any) -> None:
    limits = np.iinfo(dtype)
    space = spaces.Box(np.array([limits.min, 0], dtype), np.array([limits.max - 1, 1], dtype), dtype=dtype)
    assert same(again(space), space)


@pytest.mark.parametrize("dtype", [np.int8, np.int32, np.int64, np.float16, np.float32, np.float64])
@pytest.mark.parametrize(("low", "high"), [(-np.inf, np.inf), (0, np.inf), (-np.inf, 7)])
def test_bounds_that_are_none_stay_none(dtype: Any, low: float, high: float) -> None:
    space = spaces.Box(low, high, (2,), dtype)
    assert same(again(space), space)


def test_booleans_and_half_floats_come_back() -> None:
    flags = spaces.Box(0, 1, (3,), np.bool_)
    assert same(again(flags), flags)
    halves = spaces.Box(np.array([-0.1, -np.inf], np.float16), np.array([65504.0, 0.3], np.float16), dtype=np.float16)
    assert same(again(halves), halves)


@pytest.mark.parametrize(
    "data",
    [
        {"low": [0], "high": [256], "dtype": "uint8"},
        {"low": [-1], "high": [1], "dtype": "uint16"},
        {"low": [0.5], "high": [1.5], "dtype": "int32"},
        {"low": [0], "high": [1], "dtype": "bool"},
        {"low": ["0"], "high": [1], "dtype": "int32"},
        {"low": [[0]], "high": [[1]], "dtype": "int32"},
        {"low": [2], "high": [1], "dtype": "int64"},
        {"low": [0, 0], "high": [1], "dtype": "int64"},
        {"low": [0.0], "high": [1.0], "dtype": "complex64"},
        {"low": [0.0], "high": [1.0], "dtype": "O"},
        {"low": [0.0], "high": [1.0], "dtype": "datetime64[s]"},
    ],
)
def test_what_is_no_space_is_refused(data: dict[str, Any]) -> None:
    with pytest.raises(FileFormatError, match="space"):
        box_from_json(data)


@pytest.mark.parametrize(
    ("observed", "acted"),
    [(np.int32, np.float32), (np.uint8, np.float16), (np.float16, np.float64), (np.int64, np.int16)],
)
def test_a_policy_of_other_numbers_acts_the_same_once_loaded(observed: Any, acted: Any, tmp_path: Path) -> None:
    mpc = lq_plant.make_mpc()
    policy = MPCPolicy(
        mpc,
        observation_space=spaces.Box(0, 100, (mpc.nx,), observed),
        action_space=spaces.Box(-1, 1, (mpc.nu,), acted),
    )
    policy.save(tmp_path / "policy.zip")
    loaded = MPCPolicy.load(tmp_path / "policy.zip")
    states = np.array([[3, 1], [0, 0], [1, 2]])
    actions, _ = policy.predict(states)
    assert actions.dtype == acted
    np.testing.assert_array_equal(loaded.predict(states)[0], actions)
    assert same(loaded.observation_space, policy.observation_space)  # type: ignore[arg-type]
