"""Shards: rows that are read by lane, the same whoever reads them, and what is refused."""

from __future__ import annotations

import itertools
import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import lq_episodes
import numpy as np
import pytest

from mpcoffline.core.errors import (
    FileFormatError,
    InvalidArgumentError,
    InvalidDataError,
    MPCOfflineError,
    StorageError,
)
from mpcoffline.core.ranks import Ranks
from mpcoffline.datasets import ShardedTable, TransitionTable, parquet_sources, read_parquet, write_shards
from mpcoffline.datasets.table.inside import Inside
from mpcoffline.datasets.table.memory import remembering, with_memory
from mpcoffline.mpc.layout import Layout


@pytest.fixture(scope="module")
def whole() -> TransitionTable:
    return lq_episodes.episodes(n=700, steps=30)


@pytest.fixture(scope="module")
def folder(whole: TransitionTable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table in three shards, none of which ends where a block or a lane does."""
    path = tmp_path_factory.mktemp("shards")
    write_shards(path, [whole.take(slice(0, 12_330)), whole.take(slice(12_330, None))], rows=12_010)
    return path


def rows_of(batches: list[list[tuple[float, object]]]) -> np.ndarray:  # type: ignore[type-arg]
    return np.concatenate([np.asarray(rows) for parts in batches for _, rows in parts])


def test_rows_come_in_order_and_none_is_missing(folder: Path, whole: TransitionTable) -> None:
    shards = ShardedTable.open(folder, lanes=3)
    assert len(shards) == len(whole)
    pieces = [shards._rows(shards._piece(lane, i)) for lane in range(3) for i in range(shards._n_pieces(lane))]
    assert np.array_equal(np.concatenate([piece.rows for piece in pieces if piece is not None]), whole.rows)


def test_an_epoch_has_each_row_once(folder: Path, whole: TransitionTable) -> None:
    shards = ShardedTable.open(folder, lanes=4)
    drawn = list(itertools.islice(shards.batches(100, seed=3), len(whole) // 100))
    assert all(sum(share for share, _ in parts) == pytest.approx(1.0) for parts in drawn)
    assert len(np.unique(rows_of(drawn), axis=0)) == len(np.unique(whole.rows, axis=0)) == len(whole)


@pytest.mark.parametrize("size", [2, 3, 4])
def test_processes_together_draw_what_one_alone_draws(folder: Path, size: int) -> None:
    one = ShardedTable.open(folder, lanes=4)
    several = [ShardedTable(one._files, one.names, 4, Ranks(rank, size)) for rank in range(size)]
    streams, alone = [shards.batches(64, seed=1) for shards in several], one.batches(64, seed=1)
    for _ in range(5):
        parts = [next(stream) for stream in streams]
        by_lane = [parts[lane % size][lane // size] for lane in range(4)]
        for (share, rows), (other_share, other) in zip(next(alone), by_lane, strict=True):
            assert share == other_share
            assert np.array_equal(rows, other)


def test_statistics_are_those_of_all_rows(folder: Path, whole: TransitionTable) -> None:
    found, values = ShardedTable.open(folder).statistics(), whole.values()
    for name in ("observations", "actions", "costs", "next_observations", "terminations"):
        column = np.asarray(getattr(values, name), dtype=np.float64)
        truths = {"mean": column.mean(0), "std": column.std(0), "low": column.min(0), "high": column.max(0)}
        for kind, truth in truths.items():
            np.testing.assert_allclose(getattr(getattr(found, kind), name), truth, rtol=1e-12, atol=1e-14)


def test_what_is_done_to_rows_is_done_to_all_of_them(folder: Path, whole: TransitionTable) -> None:
    inside = Inside.of(whole, 0.8)
    assert np.array_equal(inside(whole).rows, whole.trim(0.8).rows)
    found = ShardedTable.open(folder).mapped(inside).statistics()
    np.testing.assert_allclose(found.std.observations, whole.trim(0.8).values().observations.std(axis=0), rtol=1e-12)


def test_an_excerpt_is_of_whole_stretches(folder: Path, whole: TransitionTable) -> None:
    excerpt = ShardedTable.open(folder).excerpt(4_000, seed=5)
    assert 3_000 < len(excerpt) <= 8_000
    first = {row.tobytes(): i for i, row in enumerate(whole.rows)}
    places = np.array([first[row.tobytes()] for row in excerpt.rows])
    same = np.diff(excerpt.episode_ids) == 0
    assert (np.diff(places)[same] == 1).all()  # an episode's rows are neighbours
    begins = places[np.append(True, ~same)]
    assert (np.asarray(whole.episode_ids)[begins] != np.append(-1, whole.episode_ids)[begins]).all()


def test_centred_shards_keep_their_digits(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    tables = []
    for offset in (1e6, 1e6 + 3.0):
        s = offset + np.cumsum(1e-2 * rng.normal(size=(501, 1)), axis=0)
        tables.append(TransitionTable.from_arrays(s[:-1], np.zeros((500, 1)), np.ones(500), s[1:], np.zeros(500)))
    write_shards(tmp_path, tables)
    shards = ShardedTable.open(tmp_path, lanes=2)
    moved = np.concatenate([np.diff(table.values().observations[:, 0]) for table in tables])
    parts = next(shards.batches(900, seed=0))
    columns = [shards.columns(rows) for _, rows in parts]
    drawn = np.concatenate([np.asarray(c.next_observations - c.observations)[:, 0] for c in columns])
    assert drawn.std() == pytest.approx(moved.std(), rel=0.1)
    assert np.abs(drawn).max() < 0.1  # float32 alone has steps of 0.06 there


def test_shards_of_other_columns_are_named(tmp_path: Path, whole: TransitionTable) -> None:
    few = whole.take(slice(0, 90))
    write_shards(tmp_path / "a", [few])
    other = TransitionTable.from_arrays(np.zeros((9, 3)), np.zeros((9, 1)), np.zeros(9), np.zeros((9, 3)), np.zeros(9))
    write_shards(tmp_path / "b", [other])
    paths = [next((tmp_path / name).iterdir()) for name in ("a", "b")]
    with pytest.raises(InvalidDataError, match=r"b.*: observations: expected 2 coordinates, as in shard .*a.*, got 3"):
        ShardedTable.open(paths)
    few.names = ("speed", "level", "valve")
    write_shards(tmp_path / "c", [few])
    paths = [next((tmp_path / name).iterdir()) for name in ("a", "c")]
    with pytest.raises(InvalidDataError, match=r"c.*: columns: expected .*without names, got speed, level, valve"):
        ShardedTable.open(paths)
    with pytest.raises(InvalidDataError, match="columns: expected 2 observations"):
        write_shards(tmp_path / "d", [whole.take(slice(0, 9)), other])


def test_what_cannot_be_opened_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match="lanes: expected 8 or more, got 4"):
        ShardedTable.open(folder, lanes=4, ranks=Ranks(0, 8))
    with pytest.raises(InvalidArgumentError, match="shards: expected at least one"):
        ShardedTable.open(tmp_path)
    with pytest.raises(InvalidArgumentError, match="a folder with shards"):
        ShardedTable.open(tmp_path / "none")
    with pytest.raises(InvalidArgumentError, match="batch_size: expected 8 or more"):
        next(ShardedTable.open(folder).batches(7, seed=0))


def test_a_damaged_block_is_found_by_whoever_reads_it(whole: TransitionTable, tmp_path: Path) -> None:
    (shard,) = write_shards(tmp_path, [whole])
    content = bytearray((shard / "rows.f32").read_bytes())
    content[-5] ^= 1
    (shard / "rows.f32").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"block .* with another CRC-32"):
        ShardedTable.open(tmp_path).statistics()


def test_what_is_written_stays_and_the_rest_follows(whole: TransitionTable, tmp_path: Path) -> None:
    parts = [whole.take(slice(0, 5_000)), whole.take(slice(5_000, 9_000))]
    (first,) = write_shards(tmp_path, parts[:1])
    before = (first / "rows.f32").stat().st_mtime_ns
    assert len(write_shards(tmp_path, parts)) == 2
    assert (first / "rows.f32").stat().st_mtime_ns == before
    with pytest.raises(InvalidArgumentError, match=r"expected 4000 rows of .*, got 5000 rows"):
        write_shards(tmp_path, parts[1:])


def test_actions_out_of_bounds_are_found_in_any_shard(folder: Path, whole: TransitionTable) -> None:
    high = float(np.sort(np.asarray(whole.actions).ravel())[-2])  # one action of all is beyond
    ShardedTable.open(folder).check_fits(2, 1, [-1e3], [1e3])
    with pytest.raises(InvalidDataError, match="action 0: expected values below the MPC's bound"):
        ShardedTable.open(folder).check_fits(2, 1, [-1e3], [high - 1e-3])


def test_parquet_files_become_transitions(tmp_path: Path) -> None:
    polars = pytest.importorskip("polars")
    columns = {"ep": [7, 7, 7, 9, 9], "x": [0.0, 1.0, 2.0, 5.0, 6.0], "u": [0.1, 0.2, 0.3, 0.5, 0.6]}
    columns |= {"c": [1.0, 2.0, 3.0, 4.0, 5.0], "end": [False, True, False, False, False]}
    polars.DataFrame(columns).write_parquet(tmp_path / "a.parquet")
    how = {"observations": ["x"], "actions": ["u"], "cost": "c", "episode": "ep"}
    table = read_parquet(tmp_path / "a.parquet", terminated="end", **how)
    np.testing.assert_allclose(table.observations[:, 0], [0.0, 1.0, 5.0])
    np.testing.assert_allclose(table.next_observations[:, 0], [1.0, 2.0, 6.0])
    np.testing.assert_allclose(table.costs, [1.0, 2.0, 4.0])
    assert table.terminations.tolist() == [0.0, 1.0, 0.0]
    assert table.episode_ids.tolist() == [7, 7, 9]
    with pytest.raises(InvalidDataError, match="expected columns x, v"):
        read_parquet(tmp_path / "a.parquet", **(how | {"actions": ["v"]}))


class Absent(Ranks):
    """One of several processes, of which nobody waits for the others."""

    def largest(self, numbers: Sequence[float]) -> list[float]:
        """What it has itself."""
        return list(numbers)


def test_parquet_files_of_any_file_system_are_packed_by_whoever_has_them(tmp_path: Path) -> None:
    polars, memory = pytest.importorskip("polars"), pytest.importorskip("fsspec").filesystem("memory")
    for day in (2, 0, 1):
        frame = polars.DataFrame({"x": [day + 0.0, day + 0.5, day + 1.0], "u": [0.0] * 3, "c": [1.0] * 3})
        with memory.open(f"/plant/day-{day}.parquet", "wb") as file:
            frame.write_parquet(file)
    how = {"observations": ["x"], "actions": ["u"], "cost": "c"}
    sources = parquet_sources("memory://plant/day-*.parquet", **how)
    np.testing.assert_allclose([source().observations[0, 0] for source in sources], [0.0, 1.0, 2.0])
    np.testing.assert_allclose(read_parquet("memory://plant/day-1.parquet", **how).observations[:, 0], [1.0, 1.5])

    with zipfile.ZipFile(tmp_path / "days.zip", "w") as archive:
        archive.writestr("day-0.parquet", memory.cat("/plant/day-0.parquet"))
    (source,) = parquet_sources(f"zip://*.parquet::file://{tmp_path}/days.zip", **how)
    np.testing.assert_allclose(source().observations[:, 0], [0.0, 0.5])

    read: list[int] = []

    def asked(number: int) -> TransitionTable:
        read.append(number)
        return sources[number]()

    for rank in range(2):
        write_shards(tmp_path / "shards", [partial(asked, number) for number in range(3)], ranks=Absent(rank, 2))
    assert read == [0, 2, 1]  # each by one process, in turns
    assert len(ShardedTable.open(tmp_path / "shards", lanes=1)) == 6


@pytest.mark.parametrize("scheme", ["", "file://"])
def test_files_may_be_called_anything(scheme: str, tmp_path: Path) -> None:
    polars, folder = pytest.importorskip("polars"), tmp_path / "a b é %20 #x"
    pytest.importorskip("fsspec")
    folder.mkdir()
    for name in ("f 1%20#", "?"):
        polars.DataFrame({"x": [0.0, 1.0], "u": [0.0] * 2, "c": [1.0] * 2}).write_parquet(folder / f"{name}.parquet")
    sources = parquet_sources(f"{scheme}{folder}/*.parquet", observations=["x"], actions=["u"], cost="c")
    assert [len(source()) for source in sources] == [1, 1]


@pytest.mark.parametrize(
    ("address", "error", "told"),
    [
        ("memory://nowhere/*.parquet", StorageError, "none"),
        ("nonsense://plant/*.parquet", InvalidArgumentError, "nonsense"),
    ],
)
def test_what_is_not_there_is_named(address: str, error: type[MPCOfflineError], told: str) -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(error, match=told):
        parquet_sources(address, observations=["x"], actions=["u"], cost="c")
    with pytest.raises(error):
        read_parquet(address, observations=["x"], actions=["u"], cost="c")


def test_past_inputs_come_from_the_rows_before(folder: Path, whole: TransitionTable) -> None:
    layout = Layout.of(2, 1, 3)
    truth = {row.tobytes() for row in with_memory(whole, layout).rows}
    shards = ShardedTable.open(folder, lanes=3).mapped(partial(remembering, layout=layout))
    assert (shards.ny, shards.nu) == (5, 1)
    pieces = [shards._rows(shards._piece(lane, i)) for lane in range(3) for i in range(shards._n_pieces(lane))]
    found = np.concatenate([piece.rows for piece in pieces if piece is not None])
    assert {row.tobytes() for row in found} <= truth
    assert len(found) >= len(truth) - 3 * len(pieces)  # the first rows of a block have no past there
