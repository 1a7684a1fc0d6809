"""Trajectories given as arrays come back as they were, and are refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets import TransitionTable, dataset_from_arrays


def test_arrays_there_and_back() -> None:
    rng = np.random.default_rng(0)
    episodes = [(rng.normal(size=(n + 1, 2)), rng.uniform(-1, 1, (n, 1)), rng.uniform(size=n)) for n in (3, 1, 5)]
    dataset = dataset_from_arrays("test/a-v0", episodes, action_low=-1, action_high=1, terminated=[False, True, False])
    table = TransitionTable.from_minari(dataset)
    np.testing.assert_array_equal(table.observations, np.concatenate([e[0][:-1] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.next_observations, np.concatenate([e[0][1:] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.actions, np.concatenate([e[1] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.costs, np.concatenate([e[2] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.terminations, [0, 0, 0, 1, 0, 0, 0, 0, 0])
    assert dataset.action_space.high[0] == 1.0


GOOD = (np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2))


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "at least one episode"),
        ([GOOD, (GOOD[0][:2], *GOOD[1:])], r"episode 1: observations: expected 3 rows, with 2 actions, got 2"),
        ([GOOD, (*GOOD[:2], np.array([0.0, np.nan]))], r"episode 1, step 1: cost 0: .* got nan"),
        ([(GOOD[0], GOOD[1] + 3.0, GOOD[2])], r"episode 0, step 0: action 0: expected a value in \[-1, 1\], got 3"),
        ([GOOD, (np.zeros((3, 4)), *GOOD[1:])], "episode 1: expected 2 observations and 1 actions, got 4, 1"),
    ],
)
def test_arrays_that_are_refused(episodes: Any, message: str, store: Path) -> None:
    with pytest.raises(InvalidDataError, match=message):
        dataset_from_arrays("test/bad-v0", episodes, action_low=-1, action_high=1)
    assert not (store / "test").exists()
