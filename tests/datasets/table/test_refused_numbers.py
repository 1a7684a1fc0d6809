"""What looks like numbers and is not is refused by name, before it becomes a cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets import TransitionTable, dataset_from_arrays, from_csv

N = 6


def columns(**changes: Any) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    given = {
        "observations": rng.normal(size=(N, 2)),
        "actions": rng.normal(size=(N, 1)),
        "costs": rng.uniform(size=N),
        "next_observations": rng.normal(size=(N, 2)),
        "terminations": np.zeros(N, bool),
    }
    return given | changes


@pytest.mark.parametrize(
    ("dtype", "values"),
    [
        ("complex", np.ones(N) + 0j),
        ("datetime64", np.arange(N).astype("datetime64[s]")),
        ("timedelta64", np.arange(N).astype("timedelta64[s]")),
        ("bool", np.ones(N, bool)),
        ("object", np.ones(N, object)),
        ("<U", np.ones(N).astype(str)),
        ("object", [1.0, None, 1.0, 1.0, 1.0, 1.0]),
    ],
)
def test_costs_of_other_types_are_refused(dtype: str, values: Any) -> None:
    with pytest.raises(InvalidDataError, match=rf"costs: expected an array of numbers, got an array of {dtype}"):
        TransitionTable.from_arrays(**columns(costs=values))


@pytest.mark.parametrize("column", ["observations", "actions", "costs", "next_observations", "terminations"])
def test_masked_entries_are_refused(column: str) -> None:
    given = columns()
    values = np.ma.masked_array(given[column], mask=False)
    values[3] = np.ma.masked
    n_masked = values[3].size
    with pytest.raises(InvalidDataError, match=rf"{column}: expected numbers, got {n_masked} masked entries"):
        TransitionTable.from_arrays(**given | {column: values})
    with pytest.raises(InvalidDataError, match=f"{column}: .*masked"):
        TransitionTable.from_arrays(**given | {column: list(values)})
    plain = TransitionTable.from_arrays(**given | {column: np.ma.masked_array(given[column], mask=False)})
    np.testing.assert_array_equal(plain.rows, TransitionTable.from_arrays(**given).rows)


def test_masked_episode_ids_are_refused() -> None:
    ids = np.ma.masked_array(np.zeros(N, int), mask=np.arange(N) == 2)
    with pytest.raises(InvalidDataError, match="episode_ids: expected numbers, got 1 masked"):
        TransitionTable.from_arrays(**columns(), episode_ids=ids)


def test_numbers_of_every_width_and_library_are_taken() -> None:
    given = columns(costs=np.arange(N))
    table = TransitionTable.from_arrays(**given)
    for convert in (np.float32, np.longdouble, lambda v: v.tolist(), torch.from_numpy, lambda v: v.astype(">f8")):
        other = given | {"costs": convert(given["costs"])}
        np.testing.assert_array_equal(TransitionTable.from_arrays(**other).rows, table.rows)
    switch = TransitionTable.from_arrays(**columns(actions=np.ones((N, 1), bool)))
    np.testing.assert_array_equal(switch.actions, 1.0)


def test_the_other_ways_in_refuse_the_same(tmp_path: Path) -> None:
    s, a = np.zeros((N + 1, 2)), np.zeros((N, 1))
    masked = np.ma.masked_array(np.zeros(N), mask=np.arange(N) == 5)
    with pytest.raises(InvalidDataError, match=r"episode 0: costs: .*1 masked"):
        dataset_from_arrays("test/masked-v0", [(s, a, masked)])
    with pytest.raises(InvalidDataError, match=r"episode 0: costs: .*complex128"):
        dataset_from_arrays("test/complex-v0", [(s, a, np.zeros(N) + 1j)])
    (tmp_path / "log.csv").write_text("x,u\n" + "1,2\n" * N)
    with pytest.raises(InvalidDataError, match=r"cost\(s, a\): .*complex128"):
        from_csv(tmp_path / "log.csv", observations=["x"], actions=["u"], cost=lambda s, a: s[:, 0] + 1j)
