"""Rewards of any type of number become costs, also of types that have no minus of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from mpcoffline import TransitionTable
from mpcoffline.datasets import show
from mpcoffline.datasets.store.writing import write_dataset


@pytest.mark.parametrize("dtype", ["bool", "uint8", "int8", "int64", "float16", "float32", "float64"])
def test_costs_are_minus_the_rewards(dtype: str) -> None:
    rewards: Any = np.array([0, 1, 1, 0, 1]).astype(dtype) if dtype == "bool" else np.array([0, 3, 100, 7, 5], dtype)
    if dtype == "int8":
        rewards[2] = -128
    columns: dict[str, Any] = {
        "observations": np.arange(6, dtype=np.float32)[:, None],
        "actions": np.zeros((5, 1), np.float32),
        "rewards": rewards,
        "terminations": np.zeros(5, bool),
        "truncations": np.arange(5) == 4,
        "infos": {},
    }
    box = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    dataset = write_dataset(
        "test/rewards-v0", iter([EpisodeBuffer(**columns)]), env_spec=None, observation_space=box, action_space=box
    )
    wanted = -rewards.astype(np.float64)
    np.testing.assert_array_equal(TransitionTable.from_minari(dataset).costs, wanted)
    shown = {s.name: s for s in show(dataset).statistics}
    assert shown["cost J of an episode"].mean == wanted.sum()
    assert shown["cost L of a step"].quantiles[0] == wanted.min()
