"""Numbers that are small against their offset keep their increments, whichever way they become a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable, dataset_from_arrays, from_csv
from mpcoffline.datasets.interop.convert import to_dict
from mpcoffline.datasets.table import build as table_build
from mpcoffline.datasets.table.centring import Centring

Array = NDArray[np.float64]


def episodes(offset: float, n: int = 4, length: int = 50, seed: int = 0) -> list[tuple[Array, Array, Array]]:
    """A position at an offset and its speed, inputs, and costs."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        u, x = rng.uniform(-1.0, 1.0, (length, 1)), np.zeros((length + 1, 2))
        x[0] = rng.uniform(-1.0, 1.0), 0.0
        for t in range(length):
            x[t + 1] = 0.8 * x[t, 0] + 0.5 * x[t, 1], 0.5 * x[t, 1] + u[t, 0]
        found.append((x + np.array([offset, 0.0]), u, x[:-1, 0] ** 2))
    return found


def table_of(data: list[tuple[Array, Array, Array]], cost_offset: float = 0.0) -> TransitionTable:
    s, s_next = (np.concatenate([e[0][part] for e in data]) for part in (slice(None, -1), slice(1, None)))
    a, cost = (np.concatenate([e[k] for e in data]) for k in (1, 2))
    ids = np.repeat(np.arange(len(data)), [len(e[1]) for e in data])
    return TransitionTable.from_arrays(s, a, cost + cost_offset, s_next, np.zeros(len(s)), ids)


def increments(table: TransitionTable) -> Array:
    return np.asarray(table.next_observations.astype(np.float64) - table.observations)


def check_increments(table: TransitionTable, data: list[tuple[Array, Array, Array]]) -> None:
    """Right to 1e-6 of their spread."""
    truth = np.concatenate([np.diff(e[0], axis=0) for e in data])
    s = np.concatenate([e[0][:-1] for e in data])
    for found, right in ((increments(table), truth), (table.observations, s)):
        assert (np.sqrt(np.mean((found - right) ** 2, axis=0)) <= 1e-6 * right.std(axis=0)).all()


# ---------------------------------------------------------------- packing


@settings(deadline=None, max_examples=25)
@given(st.floats(-1e9, 1e9), st.integers(0, 100))
def test_increments_are_right_at_any_offset(offset: float, seed: int) -> None:
    data = episodes(offset, seed=seed)
    table = table_of(data)
    assert table.rows.dtype == np.float32
    check_increments(table, data)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 50), st.floats(1e2, 1e9))
def test_the_rows_of_a_shifted_plant_are_the_same(seed: int, offset: float) -> None:
    """What minibatches are made of does not depend on the offset."""
    first, second = (table_of(episodes(o, seed=seed)) for o in (offset, 3.0 * offset))
    rounding = 20.0 * np.spacing(3.0 * offset) + 1e-6  # of the sums that the means are made of
    np.testing.assert_allclose(second.rows, first.rows, atol=rounding)
    np.testing.assert_allclose(second.centring.centre[0] - first.centring.centre[0], 2.0 * offset, atol=rounding)


def test_what_float32_holds_is_packed_as_it_is() -> None:
    data = [tuple(part.astype(np.float32).astype(np.float64) for part in e) for e in episodes(1e6)]
    for table in (table_of(data), table_of(episodes(0.0))):  # type: ignore[arg-type]
        assert table.centring.is_none
        for name in ("observations", "actions", "costs", "next_observations"):
            assert getattr(table, name).base is table.rows


def test_only_the_columns_that_need_it_are_centred() -> None:
    table = table_of(episodes(1e6))
    assert table.centring.increments.tolist() == [True, False]
    assert np.flatnonzero(table.centring.centre).tolist() == [0, 4]  # the position, and its mean increment
    assert table.actions.base is table.costs.base is table.rows


def test_sites_far_apart_and_counters_keep_their_increments() -> None:
    """No one centre helps there: s+ - s is what is kept."""
    sites = [episodes(offset, n=1, seed=k)[0] for k, offset in enumerate((-3e6, 0.0, 2e6, 8e6))]
    truth = np.concatenate([np.diff(e[0], axis=0) for e in sites])
    assert (np.abs(increments(table_of(sites)) - truth) <= 1e-6 * truth.std(axis=0)).all()
    rng = np.random.default_rng(0)
    count = 1e9 + np.cumsum(1.0 + 1e-3 * rng.standard_normal(101))[:, None]
    a = np.zeros((100, 1))
    table = TransitionTable.from_arrays(count[:-1], a, a[:, 0], count[1:], a[:, 0])
    error = increments(table) - np.diff(count, axis=0)
    assert np.abs(error).max() < 1e-6  # spacing of float64 at 1e9 is 1.2e-7
    assert table.n_episodes == 1


def test_costs_actions_and_constants_keep_their_digits() -> None:
    data = episodes(0.0)
    s = np.concatenate([e[0][:-1] for e in data])
    costs = np.concatenate([e[2] for e in data])
    table = table_of(data, cost_offset=1e6)
    assert np.abs(table.costs - 1e6 - costs).max() < 1e-6 * costs.std()
    assert table.statistics().std.costs == pytest.approx(costs.std(), rel=1e-6)
    actions = 1e7 + np.concatenate([e[1] for e in data])
    constant = np.column_stack([s, np.full(len(s), 1e6 + 0.3)])
    table = TransitionTable.from_arrays(constant, actions, costs, constant, np.zeros(len(s)))
    assert np.abs(table.actions - actions).max() < 1e-6 * actions.std()
    assert (table.observations[:, 2] == 1e6 + 0.3).all()
    assert (table.next_observations[:, 2] == 1e6 + 0.3).all()


def test_numpy_and_torch_give_the_same_columns() -> None:
    table = table_of(episodes(1e6), cost_offset=1e7)
    for mine, theirs in zip(table.columns(table.rows), table.columns(torch.from_numpy(table.rows)), strict=True):
        assert theirs.dtype == torch.float64
        np.testing.assert_array_equal(mine, theirs.numpy())
    for mine, theirs in zip(table.values(), table.columns(table.rows), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for name in ("observations", "actions", "costs", "next_observations", "terminations"):
        np.testing.assert_array_equal(getattr(table, name), getattr(table.values(), name))
    np.testing.assert_array_equal(table.centring.packed(table.centring.values(table.rows)), table.rows)


def test_a_centring_survives_json_and_refuses_nonsense() -> None:
    centring = table_of(episodes(1e6)).centring
    assert Centring.from_json(centring.to_json()).equals(centring)
    for bad in ({"centre": [np.nan], "increments": []}, {"centre": 1.0, "increments": []}):
        with pytest.raises(ValueError, match="centre"):
            Centring.from_json(bad)


# ---------------------------------------------------------------- what is made of a table


def test_parts_of_a_table_keep_their_values() -> None:
    data = episodes(1e6)
    table = table_of(data)
    values = table.values()
    for part in table.split(0.5, seed=0):
        chosen = np.isin(table.episode_ids, part.episode_ids)
        np.testing.assert_array_equal(part.next_observations, values.next_observations[chosen])
    batch = next(table.batches(len(table), 0))
    found = table.columns(batch).observations.numpy()
    np.testing.assert_array_equal(np.sort(found, axis=0), np.sort(values.observations, axis=0))
    statistics = table.statistics()
    np.testing.assert_allclose(statistics.mean.next_observations, values.next_observations.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(statistics.std.observations, values.observations.std(axis=0), rtol=1e-9)
    np.testing.assert_array_equal(statistics.high.next_observations, values.next_observations.max(axis=0))
    assert table.goes_on()[:49].all()
    assert not table.goes_on()[49]
    moved = table.with_states(values.observations + 0.25, values.next_observations + 0.5)
    np.testing.assert_allclose(increments(moved), increments(table) + 0.25, atol=1e-6)


def test_trimming_does_not_depend_on_the_offset() -> None:
    offsets = (0.0, 3.0, -30.0, 1e5, 1e6, -1e7)
    kept = [table_of(episodes(offset)).trim(0.8).values() for offset in offsets]
    for offset, values in zip(offsets, kept, strict=True):
        np.testing.assert_allclose(values.observations[:, 0] - offset, kept[0].observations[:, 0], atol=5e-6)


@pytest.mark.parametrize("offsets", [(1e6, 1e6), (0.0, 1e6), (1e6, 5e6)])
def test_tables_of_different_centres_become_one(offsets: tuple[float, float]) -> None:
    parts = [episodes(offset, seed=k) for k, offset in enumerate(offsets)]
    table = TransitionTable.concat([table_of(part) for part in parts])
    truth = np.concatenate([np.diff(e[0], axis=0) for part in parts for e in part])
    assert (np.abs(increments(table) - truth) <= 1e-5 * truth.std(axis=0)).all()
    assert table.n_episodes == 8


def test_other_libraries_get_values_and_no_false_ends() -> None:
    data = episodes(1e6)
    given = to_dict(table_of(data))
    assert np.flatnonzero(given["timeouts"]).tolist() == [49, 99, 149, 199]
    np.testing.assert_allclose(given["next_observations"][-1], data[-1][0][-1], atol=1e-6)


# ---------------------------------------------------------------- stored data


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_arrays_are_stored_with_the_digits_that_they_need(offset: float) -> None:
    data = episodes(offset)
    dataset = dataset_from_arrays("test/offset-v0", data)
    wide = np.float64 if offset else np.float32
    assert dataset.observation_space.dtype == wide
    assert dataset.action_space.dtype == np.float32
    assert next(iter(dataset.iterate_episodes())).observations.dtype == wide
    check_increments(TransitionTable.from_minari(dataset), data)


def test_actions_at_an_offset_are_stored_with_their_digits() -> None:
    data = [(s, 1e6 + a, cost) for s, a, cost in episodes(0.0)]
    dataset = dataset_from_arrays("test/actions-v0", data, action_low=1e6 - 1, action_high=1e6 + 1)
    assert dataset.action_space.dtype == np.float64
    actions = TransitionTable.from_minari(dataset).actions
    np.testing.assert_allclose(actions, np.concatenate([a for _, a, _ in data]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", ["mapped", "cached", "memory"])
def test_tables_in_files_are_centred_too(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = episodes(1e6)
    data = [(s, a, cost + 1e6) for s, a, cost in data]
    dataset = dataset_from_arrays("test/file-v0", data)
    if kind == "cached":
        monkeypatch.setattr(table_build, "CACHED_ROWS", 1)
    options: dict[str, Any] = {"cache": tmp_path / "tables"} | ({"memory": 1_000} if kind == "mapped" else {})
    direct = table_of(data, cost_offset=0.0)
    for _ in range(2):  # the second time from the cache
        table = TransitionTable.from_minari(dataset, **options)
        assert table.is_mapped == (kind == "mapped")
        np.testing.assert_array_equal(table.rows, direct.rows)
        assert table.centring.equals(direct.centring)
        check_increments(table, data)
    trimmed = table.trim(0.5)
    np.testing.assert_array_equal(trimmed.values().next_observations, direct.trim(0.5).values().next_observations)
    assert len(TransitionTable.concat([trimmed, direct])) == len(direct) * 3 // 2


def test_a_log_file_keeps_its_digits(tmp_path: Path) -> None:
    data = episodes(1e6)
    lines = ["x,v,u,L,k"]
    for k, (s, a, cost) in enumerate(data):
        lines += [f"{s[t, 0]!r},{s[t, 1]!r},{a[t, 0]!r},{cost[t]!r},{k}" for t in range(len(a))]
    (tmp_path / "log.csv").write_text("\n".join(lines).replace("np.float64(", "").replace(")", ""))
    columns: dict[str, Any] = {"observations": ["x", "v"], "actions": ["u"], "cost": "L", "episode": "k"}
    table = from_csv(tmp_path / "log.csv", **columns, dataset_id="test/log-v0")
    short = [(s[:-1], a[:-1], cost[:-1]) for s, a, cost in data]
    check_increments(table, short)
    check_increments(TransitionTable.from_minari("test/log-v0"), short)
