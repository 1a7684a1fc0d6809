"""The transition table: packing, trimming, splitting, minibatches, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp
from minari.data_collector import EpisodeBuffer
from pendulum_data import resealed

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.store.writing import write_dataset

Arrays = dict[str, np.ndarray[Any, Any]]


def finite(shape: Any) -> st.SearchStrategy[Any]:
    return hnp.arrays(np.float32, shape, elements=st.floats(-1e6, 1e6, width=32, allow_subnormal=False))


@st.composite
def arrays(draw: st.DrawFn) -> Arrays:
    n, ny, nu = draw(st.integers(1, 12)), draw(st.integers(1, 4)), draw(st.integers(1, 3))
    return {
        "observations": draw(finite((n, ny))),
        "actions": draw(finite((n, nu))),
        "costs": draw(finite(n)),
        "next_observations": draw(finite((n, ny))),
        "terminations": draw(hnp.arrays(np.bool_, n)),
    }


def example(n: int = 30, ny: int = 3, nu: int = 2, episodes: int = 3) -> Arrays:
    rng = np.random.default_rng(0)
    return {
        "observations": rng.normal(size=(n, ny)),
        "actions": rng.uniform(-1, 1, size=(n, nu)),
        "costs": rng.uniform(size=n),
        "next_observations": rng.normal(size=(n, ny)),
        "terminations": np.zeros(n, bool),
        "episode_ids": np.repeat(np.arange(episodes), n // episodes),
    }


@given(arrays())
def test_columns_come_back_bit_for_bit_as_views(data: Arrays) -> None:
    table = TransitionTable.from_arrays(**data)
    assert len(table) == len(data["costs"])
    assert (table.ny, table.nu) == (data["observations"].shape[1], data["actions"].shape[1])
    assert table.rows.dtype == np.float32
    assert table.rows.flags.c_contiguous
    for name, values in data.items():
        column = getattr(table, name)
        np.testing.assert_array_equal(column, values)
        assert column.base is table.rows


@given(arrays(), st.floats(0.01, 1.0))
def test_trimming_keeps_the_rows_nearest_to_the_middle(data: Arrays, fraction: float) -> None:
    table = TransitionTable.from_arrays(**data)
    trimmed = table.trim(fraction)
    assert len(trimmed) == max(1, round(fraction * len(table)))
    # Independent: score every row with plain loops.
    middle, scale = [], []
    for i in range(table.ny):
        column = sorted(float(v) for v in table.observations[:, i])
        first = (len(column) - 1) // 4
        low, high = column[first], column[-1 - first]
        middle.append((low + high) / 2)
        scale.append((high - low) / 2 or float(np.mean([abs(v - middle[i]) for v in column])) or 1.0)
    scores = [
        max(max(abs(s[i] - middle[i]), abs(t[i] - middle[i])) / scale[i] for i in range(table.ny))
        for s, t in zip(table.observations.astype(float), table.next_observations.astype(float), strict=True)
    ]
    kept = [row.tobytes() for row in trimmed.rows]
    rows = [row.tobytes() for row in table.rows]
    worst_kept = max(score for score, row in zip(scores, rows, strict=True) if row in kept)
    assert sum(score < worst_kept * (1 - 1e-5) for score in scores) <= len(trimmed)
    iterator = iter(rows)
    assert all(row in iterator for row in kept)  # the order stays


def test_trimming_drops_the_outliers() -> None:
    data = example(n=100, episodes=1)
    data["next_observations"][17] = 1e3
    data["observations"][40, 1] = -1e3
    data["observations"][:, 2] = data["next_observations"][:, 2] = 0.0  # a coordinate without a median
    table = TransitionTable.from_arrays(**data)
    rows = np.delete(table.rows, [17, 40], axis=0)
    np.testing.assert_array_equal(table.trim(0.98).rows, rows)
    np.testing.assert_array_equal(table.trim(1.0).rows, table.rows)
    assert len(table) == 100


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.1, float("nan")])
def test_trim_refuses_other_fractions(fraction: float) -> None:
    with pytest.raises(InvalidArgumentError, match="fraction"):
        TransitionTable.from_arrays(**example()).trim(fraction)


def test_split_is_by_episode_and_repeatable() -> None:
    table = TransitionTable.from_arrays(**example(n=100, episodes=10))
    first, second = table.split(0.7, seed=3)
    assert first.n_episodes == 7
    assert second.n_episodes == 3
    assert not set(first.episode_ids) & set(second.episode_ids)
    rebuilt = np.concatenate([first.rows, second.rows])[
        np.argsort(np.concatenate([first.episode_ids, second.episode_ids]), kind="stable")
    ]
    np.testing.assert_array_equal(rebuilt, table.rows)
    np.testing.assert_array_equal(first.rows, table.split(0.7, seed=3)[0].rows)
    assert set(first.episode_ids) != set(table.split(0.7, seed=4)[0].episode_ids)
    assert table.split(0.999, seed=0)[1].n_episodes == 1
    with pytest.raises(InvalidArgumentError, match="two or more"):
        TransitionTable.from_arrays(**example(episodes=1)).split(0.5, seed=0)
    with pytest.raises(InvalidArgumentError, match="fraction"):
        table.split(1.0, seed=0)


def test_episodes_are_found_where_none_are_given() -> None:
    s = np.arange(8.0)[:, None]
    s_next = s + 1.0
    s_next[2] = 100.0  # the row after does not start there
    terminated = np.zeros(8, bool)
    terminated[5] = True
    table = TransitionTable.from_arrays(s, s, s[:, 0], s_next, terminated)
    np.testing.assert_array_equal(table.episode_ids, [0, 0, 0, 1, 1, 1, 2, 2])


def test_an_epoch_of_batches_is_a_permutation() -> None:
    table = TransitionTable.from_arrays(**example(n=30))
    blocks = list(table.batches(7, rng=0, epochs=1))
    assert [tuple(block.shape) for block in blocks] == [(7, table.rows.shape[1])] * 4
    seen = {row.numpy().tobytes() for block in blocks for row in block}
    assert len(seen) == 28
    assert seen <= {row.tobytes() for row in table.rows}
    again = list(table.batches(7, rng=np.random.default_rng(0), epochs=1))
    assert all(torch.equal(a, b) for a, b in zip(blocks, again, strict=True))
    columns = table.columns(blocks[0])
    assert columns.observations.shape == columns.next_observations.shape == (7, 3)
    assert columns.actions.shape == (7, 2)
    assert columns.costs.shape == columns.terminations.shape == (7,)
    endless = table.batches(100, rng=0)
    assert [len(next(endless)) for _ in range(3)] == [30] * 3  # a batch is never larger than the table
    with pytest.raises(InvalidArgumentError, match="batch_size"):
        table.batches(0, rng=0)


@pytest.mark.parametrize(
    ("column", "index", "label"),
    [
        ("observations", (14, 2), "observation 2"),
        ("actions", (14, 1), "action 1"),
        ("costs", 14, "cost"),
        ("next_observations", (14, 0), "next observation 0"),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_not_finite_is_refused_with_its_place(column: str, index: Any, label: str, value: float) -> None:
    data = example()
    data[column][index] = value
    with pytest.raises(InvalidDataError, match=rf"episode 1, step 4: {label}: expected a finite number"):
        TransitionTable.from_arrays(**data)
    del data["episode_ids"]
    with pytest.raises(InvalidDataError, match=rf"row 14: {label}"):
        TransitionTable.from_arrays(**data)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("observations", np.zeros(30), r"observations: expected shape \(n, columns\), got \(30,\)"),
        ("actions", np.zeros((30, 1, 1)), r"actions: expected shape \(n, columns\)"),
        ("costs", np.zeros((30, 1)), r"costs: expected shape \(n,\), got \(30, 1\)"),
        ("costs", np.zeros(29), r"costs: expected 30 rows, as in observations, got 29"),
        ("next_observations", np.zeros((30, 2)), r"next_observations: expected shape \(30, 3\), got \(30, 2\)"),
        ("next_observations", np.zeros((31, 3)), r"next_observations: expected 30 rows"),
        ("terminations", np.full(30, 0.5), r"terminations: expected booleans"),
        ("actions", [["a"]], r"actions: expected an array of numbers"),
        ("episode_ids", np.zeros(29, int), r"episode_ids: expected 30 integers"),
        ("episode_ids", np.zeros(30), r"episode_ids: expected 30 integers, got float64"),
    ],
)
def test_wrong_shapes_are_refused(column: str, value: Any, message: str) -> None:
    with pytest.raises(InvalidDataError, match=message):
        TransitionTable.from_arrays(**{**example(), column: value})


def test_no_rows_are_refused() -> None:
    with pytest.raises(InvalidDataError, match="at least one transition"):
        TransitionTable.from_arrays(np.zeros((0, 2)), np.zeros((0, 1)), [], np.zeros((0, 2)), [])


def test_check_fits_names_what_differs() -> None:
    data = example()
    data["actions"][22, 1] = -1.5
    table = TransitionTable.from_arrays(**data, name="data set 'a/b-v0'")
    table.check_fits(3, 2)
    table.check_fits(3, 2, [-2, -1.5], [2, 2])
    with pytest.raises(InvalidDataError, match=r"'a/b-v0': observations: expected 4 coordinates, as in the MPC, got 3"):
        table.check_fits(4, 2)
    with pytest.raises(InvalidDataError, match=r"actions: expected 1 coordinates, as in the MPC, got 2"):
        table.check_fits(3, 1)
    with pytest.raises(InvalidDataError, match=r"episode 2, step 2: action 1: .* above the MPC's bound -1, got -1.5"):
        table.check_fits(3, 2, [-1, -1], [1, 1])
    with pytest.raises(InvalidDataError, match=r"action 0: .* below the MPC's bound"):
        table.check_fits(3, 2, [-2, -2], [0.01, 2])


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_bounds_are_in_the_unit_of_the_input(unit: float) -> None:
    s, u = np.zeros((3, 1)), unit * np.array([[-1e-8], [0.5], [1.0]])  # -1e-8 is rounding of a range of 1
    table = TransitionTable.from_arrays(s, u, np.zeros(3), s, np.zeros(3))
    table.check_fits(1, 1, [0.0], [unit])
    table.check_fits(1, 1, [-np.inf], [np.inf])
    with pytest.raises(InvalidDataError, match="action 0"):
        table.check_fits(1, 1, [0.0], [0.99 * unit])
    with pytest.raises(InvalidDataError, match="action 0"):
        table.check_fits(1, 1, [0.1 * unit], None)


def test_a_bound_rounded_to_float32_is_no_excess() -> None:
    data = example()
    data["actions"][:] = np.float32(0.1)  # 0.10000000149
    TransitionTable.from_arrays(**data).check_fits(3, 2, [-0.1, -0.1], [0.1, 0.1])


def minari_set(**changes: Any) -> Any:
    episodes = []
    for length, terminated in ((4, True), (3, False)):
        columns = {
            "observations": np.arange(2.0 * (length + 1), dtype=np.float32).reshape(-1, 2),
            "actions": np.full((length, 1), 0.5, np.float32),
            "rewards": -np.arange(1.0, length + 1),
            "terminations": np.array([False] * (length - 1) + [terminated]),
            "truncations": np.array([False] * (length - 1) + [not terminated]),
            "infos": {},
            **changes,
        }
        episodes.append(EpisodeBuffer(**columns))
    box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    return write_dataset(
        "test/table-v0", episodes, env_spec=None, observation_space=box, action_space=spaces.Box(-1, 1, (1,))
    )


def test_from_minari_is_aligned_and_turns_reward_into_cost() -> None:
    dataset = minari_set()
    for source in (dataset, "test/table-v0"):
        table = TransitionTable.from_minari(source)
        np.testing.assert_array_equal(table.costs, [1, 2, 3, 4, 1, 2, 3])
        np.testing.assert_array_equal(table.observations[:, 0], [0, 2, 4, 6, 0, 2, 4])
        np.testing.assert_array_equal(table.next_observations[:, 0], [2, 4, 6, 8, 2, 4, 6])
        np.testing.assert_array_equal(table.terminations, [0, 0, 0, 1, 0, 0, 0])  # truncated: not terminated
        np.testing.assert_array_equal(table.episode_ids, [0, 0, 0, 0, 1, 1, 1])


def test_from_minari_names_data_set_episode_and_step() -> None:
    dataset = minari_set()
    path = Path(dataset.spec.data_path) / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        file["episode_1/rewards"][1] = np.nan
    resealed("test/table-v0")
    with pytest.raises(InvalidDataError, match=r"data set 'test/table-v0', episode 1, step 1: cost: expected a finite"):
        TransitionTable.from_minari(dataset)
    with h5py.File(path, "a") as file:
        file["episode_1/observations"].resize(3, axis=0)
    resealed("test/table-v0")
    with pytest.raises(InvalidDataError, match="episode 1: observations: expected the length that belongs to 3"):
        TransitionTable.from_minari(dataset)


def test_an_episode_in_two_pieces_is_refused() -> None:
    columns = (np.zeros((4, 1)), np.zeros((4, 1)), np.zeros(4), np.zeros((4, 1)), np.zeros(4))
    with pytest.raises(InvalidDataError, match=r"transitions, row 3: episode_ids: .*in one piece, got episode 7 again"):
        TransitionTable.from_arrays(*columns, [7, 7, 2, 7])


def test_importing_the_package_stays_light() -> None:
    code = (
        "import sys, mpcoffline, mpcoffline.datasets, mpcoffline.datasets.table.transitions\n"
        "heavy = {'torch', 'minari', 'stable_baselines3', 'casadi', 'h5py', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(heavy)) or 0)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def numbered(lengths: list[int], ids: list[int]) -> TransitionTable:
    """A table whose row k holds s = k."""
    k = np.arange(float(sum(lengths)))[:, None]
    return TransitionTable.from_arrays(
        k, -k, k[:, 0], k + 1, np.zeros(len(k)), np.repeat(ids, lengths), name="numbered"
    )


def test_episodes_lie_where_they_say() -> None:
    table = numbered([3, 1, 4], [7, 2, 5])
    assert [part.tolist() for part in table.episodes] == [[2, 5, 7], [3, 4, 0], [1, 4, 3]]
    assert table.n_episodes == 3
    for number, wanted in ((0, [3]), (1, [4, 5, 6, 7]), (2, [0, 1, 2]), (-1, [0, 1, 2])):
        part = table.take(table.episodes.rows(number))
        assert part.observations[:, 0].tolist() == wanted
        assert part.n_episodes == 1


def test_rows_are_taken_in_the_order_asked_for() -> None:
    table = numbered([3, 1, 4], [7, 2, 5])
    taken = table.take(np.array([6, 0, 0]))
    assert taken.observations[:, 0].tolist() == [6, 0, 0]
    assert taken.next_observations[:, 0].tolist() == [7, 1, 1]
    assert taken.episode_ids.tolist() == [5, 7, 7]
    assert taken.name == "numbered"


def test_a_sample_has_each_row_once_and_in_order() -> None:
    table = numbered([100], [0])
    times = np.zeros(100)
    for seed in range(500):
        drawn = table.sample(20, seed).observations[:, 0].astype(int)
        assert len(drawn) == 20
        assert (np.diff(drawn) > 0).all()
        times[drawn] += 1
    assert abs(times - 100.0).max() < 5 * np.sqrt(100 * 0.8)  # every row alike: binomial of 500 draws at 1/5
    np.testing.assert_array_equal(table.sample(20, 3).rows, table.sample(20, np.random.default_rng(3)).rows)
    np.testing.assert_array_equal(table.sample(1000, 0).rows, table.rows)
    generator = np.random.default_rng(3)
    first, second = (table.sample(20, generator).rows for _ in range(2))
    assert not np.array_equal(first, second)
    with pytest.raises(InvalidArgumentError, match="count: expected a positive integer, got 0"):
        table.sample(0, 0)
