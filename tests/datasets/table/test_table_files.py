"""Tables at scale: fast reading, cache, memory maps, block shuffle, several tables as one."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings, strategies as st
from minari.data_collector import EpisodeBuffer
from pendulum_data import resealed

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError, StorageError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.store.writing import write_dataset
from mpcoffline.datasets.table import build as table_build, cache as table_cache
from mpcoffline.datasets.table.hdf5_episodes import COLUMNS, read_episodes
from mpcoffline.datasets.table.math import innermost, middles

NY, NU = 3, 2


def buffer(length: int, rng: np.random.Generator, **changes: Any) -> EpisodeBuffer:
    columns: dict[str, Any] = {
        "observations": rng.normal(size=(length + 1, NY)).astype(np.float32),
        "actions": rng.uniform(-1, 1, size=(length, NU)).astype(np.float32),
        "rewards": rng.normal(size=length),
        "terminations": rng.uniform(size=length) < 0.1,
        "truncations": np.zeros(length, bool),
        "infos": {"cost": rng.normal(size=(length + 1, 1))},
        **changes,
    }
    return EpisodeBuffer(**columns)


def stored(lengths: list[int], dataset_id: str = "test/set-v0", seed: int = 0) -> minari.MinariDataset:
    rng = np.random.default_rng(seed)
    return write_dataset(
        dataset_id,
        (buffer(length, rng) for length in lengths),
        env_spec=None,
        observation_space=spaces.Box(-np.inf, np.inf, (NY,), np.float32),
        action_space=spaces.Box(-1, 1, (NU,), np.float32),
        overwrite=True,
    )


def by_minari(dataset: minari.MinariDataset) -> tuple[Any, Any]:
    """The same table by Minari's own episode objects."""
    rows, ids = [], []
    for e in dataset.iterate_episodes():
        columns = (e.observations[:-1], e.actions, -e.rewards[:, None], e.observations[1:], e.terminations[:, None])
        rows.append(np.concatenate(columns, axis=1))
        ids += [e.id] * len(e.rewards)
    return np.concatenate(rows).astype(np.float32), np.array(ids)


def main_file(dataset: minari.MinariDataset) -> Path:
    return Path(dataset.spec.data_path) / "main_data.hdf5"


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every table counts as large enough for the cache, and blocks are small."""
    monkeypatch.setattr(table_build, "CACHED_ROWS", 1)
    monkeypatch.setattr(table_cache, "READ_BYTES", 40 * 7)


def test_reading_without_objects_is_minaris_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = stored([5, 5, 1, 2000, 7, 300, 5])
    for block in (1 << 24, 500):
        rows, ids = by_minari(dataset)
        found = [(r.copy(), i.copy()) for r, i in table_build.row_blocks(dataset, "x", NY, NU, block)]
        np.testing.assert_array_equal(np.concatenate([r for r, _ in found]), rows)
        np.testing.assert_array_equal(np.concatenate([i for _, i in found]), ids)


@pytest.mark.parametrize(
    "layout", ["contiguous", "compressed", "float16", "big-endian", "chunks across", "version 3", "many members"]
)
def test_other_layouts_of_the_file(tmp_path: Path, layout: str) -> None:
    rng = np.random.default_rng(1)
    episodes = [buffer(30, rng) for _ in range(3)]
    options: dict[str, Any] = {
        "contiguous": {},
        "compressed": {"compression": "gzip", "chunks": True},
        "float16": {"chunks": (31, NY), "dtype": np.float16},
        "big-endian": {"chunks": (31, NY), "dtype": ">f4"},
        "chunks across": {"chunks": (7, 1)},
        "version 3": {"chunks": (31, NY)},
        "many members": {"chunks": (8, NY)},
    }[layout]
    path = tmp_path / "x.hdf5"
    with h5py.File(path, "w", track_order=True, libver="latest" if layout == "version 3" else None) as file:
        for i, episode in enumerate(episodes):
            group = file.create_group(f"episode_{i}")
            for extra in range(40 if layout == "many members" else 0):
                group[f"extra_{extra}"] = extra
            group.create_dataset("observations", data=episode.observations, **options)
            for column in COLUMNS[1:]:
                group[column] = getattr(episode, column)
    with h5py.File(path) as file:
        for i, columns in read_episodes(path, [2, 0, 1]):
            for column in COLUMNS:
                np.testing.assert_array_equal(getattr(columns, column), file[f"episode_{i}/{column}"][()])


@settings(max_examples=60, deadline=None)
@given(changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_damaged_file_gives_values_or_the_projects_error(
    damaged_file: tuple[bytes, Path], changes: list[tuple[float, int]]
) -> None:
    content, path = bytearray(damaged_file[0]), damaged_file[1]
    for where, value in changes:
        content[int(where * len(content))] = value
    path.write_bytes(content)
    try:
        for _, columns in read_episodes(path, range(3)):
            assert all(isinstance(column, np.ndarray) for column in columns)
    except FileFormatError:
        pass


@pytest.fixture(scope="module")
def damaged_file(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Path]:
    folder = tmp_path_factory.mktemp("damaged")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        content = main_file(stored([4, 4, 9])).read_bytes()
    return content, folder / "x.hdf5"


def test_a_cut_file_and_wrong_counts_are_refused() -> None:
    dataset = stored([5, 6])
    path = main_file(dataset)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match=r"main_data.hdf5: expected an intact HDF5 file.*datasets repair"):
        TransitionTable.from_minari(dataset)
    path.write_bytes(content)
    with h5py.File(path, "a") as file:
        del file["episode_1"]
    with pytest.raises(
        FileFormatError, match=r"expected 2 episodes of 11 steps, as its metadata say, got 1 of 5.*datasets repair"
    ):
        TransitionTable.from_minari(dataset)


def test_numbers_of_other_types_are_refused() -> None:
    dataset = stored([5, 6])
    with h5py.File(main_file(dataset), "a") as file:
        del file["episode_1/terminations"]
        file["episode_1/terminations"] = np.arange(6)
    resealed()
    with pytest.raises(InvalidDataError, match="episode 1: terminations: expected booleans, got values such as 5"):
        TransitionTable.from_minari(dataset)
    with h5py.File(main_file(dataset), "a") as file:
        del file["episode_0/actions"]
        file["episode_0/actions"] = np.zeros((5, 3))
    resealed()
    with pytest.raises(InvalidDataError, match=r"episode 0: actions: .*\(5, 2\), got float64 of shape \(5, 3\)"):
        TransitionTable.from_minari(dataset)


def test_an_error_in_a_later_block_names_episode_and_step(large: None, tmp_path: Path) -> None:
    dataset = stored([4, 3000])
    with h5py.File(main_file(dataset), "a") as file:
        file["episode_1/actions"][2500, 1] = np.nan
    resealed()
    with pytest.raises(InvalidDataError, match="episode 1, step 2500: action 1"):
        list(table_build.row_blocks(dataset, "x", NY, NU, 1000))
    with pytest.raises(InvalidDataError, match="episode 1, step 2500: action 1"):
        TransitionTable.from_minari(dataset, cache=tmp_path / "cache")
    assert not [path for path in (tmp_path / "cache").iterdir() if path.is_dir()]


@pytest.mark.parametrize("memory", [10**9, 1000])
def test_the_cache_is_used_until_the_data_change(
    large: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, memory: int
) -> None:
    cache = tmp_path / "cache"
    dataset = stored([50, 60])
    first = TransitionTable.from_minari(dataset, memory=memory, cache=cache)
    assert first.is_mapped == (memory == 1000)
    np.testing.assert_array_equal(first.rows, by_minari(dataset)[0])

    copy = stored([50, 60], "test/copy-v0")
    main_file(copy).write_bytes(main_file(dataset).read_bytes())
    subset = dataset.filter_episodes(lambda episode: episode.id == 1)
    part = TransitionTable.from_minari(subset, memory=memory, cache=cache)
    assert set(part.episode_ids) == {1}

    def never(*arguments: Any) -> Any:
        raise AssertionError("read again")

    with monkeypatch.context() as patch:
        patch.setattr(table_build, "_episodes", never)
        for again in (dataset, copy):
            found = TransitionTable.from_minari(again, memory=memory, cache=cache)
            np.testing.assert_array_equal(found.rows, first.rows)
            np.testing.assert_array_equal(found.episode_ids, first.episode_ids)
    # The same size, the same date, one other number.
    before = main_file(dataset).stat()
    with h5py.File(main_file(dataset), "a") as file:
        file["episode_1/rewards"][3] = 77.0
    os.utime(main_file(dataset), ns=(before.st_atime_ns, before.st_mtime_ns))
    assert main_file(dataset).stat().st_size == before.st_size
    with pytest.raises(FileFormatError, match=r"main_data.hdf5: expected sha256"):
        TransitionTable.from_minari(dataset, memory=memory, cache=cache)
    resealed()
    assert TransitionTable.from_minari(dataset, memory=memory, cache=cache).costs[53] == -77.0


@pytest.mark.parametrize("damage", ["flipped", "cut", "ids", "meta", "no rows"])
def test_a_damaged_cache_is_never_believed(large: None, tmp_path: Path, damage: str) -> None:
    dataset = stored([50, 60])
    for memory in (10**9, 1000):
        cache = tmp_path / f"cache-{memory}"
        TransitionTable.from_minari(dataset, memory=memory, cache=cache)
        (folder,) = (path for path in cache.iterdir() if path.is_dir())
        rows, ids, meta = folder / "rows.f32", folder / "episodes.i64", folder / "table.json"
        if damage in ("flipped", "ids"):
            file = rows if damage == "flipped" else ids
            content = bytearray(file.read_bytes())
            content[400] ^= 1
            file.write_bytes(content)
        elif damage == "cut":
            rows.write_bytes(rows.read_bytes()[:-1])
        elif damage == "meta":
            meta.write_text(json.dumps(json.loads(meta.read_text()) | {"version": 99}))
        else:
            rows.unlink()
        if memory == 10**9:
            if damage in ("flipped", "ids"):
                with pytest.warns(UserWarning, match=r"intact packed table.*It is built again"):
                    table = TransitionTable.from_minari(dataset, memory=memory, cache=cache)
            else:
                table = TransitionTable.from_minari(dataset, memory=memory, cache=cache)
            np.testing.assert_array_equal(table.rows, by_minari(dataset)[0])
            np.testing.assert_array_equal(table.episode_ids, by_minari(dataset)[1])
        elif damage == "flipped":
            table = TransitionTable.from_minari(dataset, memory=memory, cache=cache)
            with pytest.raises(FileFormatError, match=r"block \d with another CRC-32. Remove that folder"):
                list(table.batches(10, 0, epochs=1))


@pytest.mark.parametrize(("memory", "batch"), [(1, 8), (3000, 8), (10**6, 8), (3000, 500)])
def test_block_shuffle_gives_each_row_once(large: None, tmp_path: Path, memory: int, batch: int) -> None:
    rows = np.zeros((1001, 2 * NY + NU + 2), np.float32)
    rows[:, 0] = np.arange(1001)
    ids = np.arange(1001) // 10
    file = table_cache.scratch_table(NY, NU, [(rows[:300], ids[:300]), (rows[300:], ids[300:])], tmp_path)
    assert not list(tmp_path.iterdir())  # it has no name any more
    table = TransitionTable(file.rows, NY, NU, file.episode_ids, file=file, memory=memory)
    epoch = [block.numpy() for block in table.batches(batch, 0, epochs=1)]
    assert {len(block) for block in epoch} == {batch}
    seen = np.concatenate(epoch)[:, 0]
    assert len(seen) == len(set(seen)) == 1001 // batch * batch
    again = [block.numpy() for block in table.batches(batch, 0, epochs=2)]
    np.testing.assert_array_equal(np.concatenate(epoch), np.concatenate(again[: len(epoch)]))
    assert len(again) == 2 * len(epoch)
    # Not in order, and the two epochs differ.
    assert np.abs(np.diff(seen)).mean() > 5
    assert not np.array_equal(np.concatenate(again[: len(epoch)]), np.concatenate(again[len(epoch) :]))


def test_a_mapped_table_does_what_one_in_memory_does(large: None, tmp_path: Path) -> None:
    dataset = stored([50, 60, 1, 200])
    inside = TransitionTable.from_minari(dataset)
    mapped = TransitionTable.from_minari(dataset, memory=1000, cache=tmp_path)
    assert (inside.is_mapped, mapped.is_mapped) == (False, True)
    pairs = [
        (inside.trim(0.8), mapped.trim(0.8)),
        *zip(inside.split(0.5, 3), mapped.split(0.5, 3), strict=True),
        (TransitionTable.concat([inside, inside]), TransitionTable.concat([inside, mapped])),
    ]
    for a, b in ((inside.sample(30, 1), mapped.sample(30, 1)), (inside.take(slice(3, 9)), mapped.take(slice(3, 9)))):
        assert (a.is_mapped, b.is_mapped) == (False, False)
        np.testing.assert_array_equal(a.rows, b.rows)
    for a, b in pairs:
        assert (a.is_mapped, b.is_mapped) == (False, True)
        np.testing.assert_array_equal(a.rows, b.rows)
        np.testing.assert_array_equal(a.episode_ids, b.episode_ids)
        np.testing.assert_array_equal(a.statistics().mean.observations, b.statistics().mean.observations)
    assert pairs[-1][0].n_episodes == 8


def test_concatenation_refuses_other_plants() -> None:
    one = TransitionTable.from_arrays(np.ones((2, 1)), np.ones((2, 1)), [1, 2], np.ones((2, 1)), [0, 0], [4, 4])
    two = TransitionTable.from_arrays(np.ones((2, 2)), np.ones((2, 1)), [1, 2], np.ones((2, 2)), [0, 0], name="two")
    with pytest.raises(InvalidDataError, match="two: observations: expected 1 coordinates, as in transitions, got 2"):
        TransitionTable.concat([one, two])
    with pytest.raises(InvalidArgumentError, match="at least one"):
        TransitionTable.concat([])
    both = TransitionTable.concat([one, one], name="both")
    assert list(both.episode_ids) == [0, 0, 1, 1]
    assert both.name == "both"


@given(
    values=st.lists(st.floats(-(2.0**127), 2.0**127, width=32), min_size=1, max_size=40),
    fraction=st.floats(0.01, 1.0),
)
def test_quartiles_are_exact_and_trimming_is_by_definition(values: list[float], fraction: float) -> None:
    rows = np.array([[v, 0.5, 1.0, v / 2, 0.0] for v in values], np.float32)
    column = np.sort(rows[:, 0].astype(np.float64))
    low, high = column[(len(column) - 1) // 4], column[len(column) - 1 - (len(column) - 1) // 4]
    middle = (low + high) / 2
    scale = (high - low) / 2 or np.abs(column - middle).mean() or 1.0
    np.testing.assert_allclose(middles(rows, 1), [[middle], [scale]], rtol=1e-15)
    np.testing.assert_array_equal(middles(rows.view(np.memmap), 1), middles(rows, 1))
    kept = innermost(rows, 1, 1, fraction)
    score = np.abs(rows[:, [0, 3]].astype(np.float64) - middle).max(axis=1) / scale
    assert len(kept) == max(1, round(fraction * len(values)))
    assert list(kept) == sorted(sorted(range(len(score)), key=score.__getitem__)[: len(kept)])  # ties by order


def test_statistics_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    rows = (rng.normal(size=(150_000, 9)) + 1000.0).astype(np.float32)
    table = TransitionTable(rows, 3, 1, np.zeros(len(rows), np.int64))
    found, exact = table.statistics(), rows.astype(np.float64)
    np.testing.assert_allclose(found.mean.next_observations, exact[:, 5:8].mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.std.observations, exact[:, :3].std(axis=0), rtol=1e-9)
    assert found.low.costs == exact[:, 4].min()
    np.testing.assert_array_equal(found.high.actions, exact[:, 3:4].max(axis=0))


def test_a_cache_that_cannot_be_written_is_named(large: None, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    dataset = stored([5])
    with pytest.raises(StorageError, match="file/cache: expected to be written"):
        TransitionTable.from_minari(dataset, memory=1, cache=tmp_path / "file" / "cache")
    with pytest.warns(UserWarning, match="The table is not kept in the cache"):
        table = TransitionTable.from_minari(dataset, cache=tmp_path / "file" / "cache")
    np.testing.assert_array_equal(table.rows, by_minari(dataset)[0])
