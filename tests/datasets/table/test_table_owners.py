"""Tables of others: neither read nor written over silently; leftovers and the bound of the cache."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mpcoffline.core import places
from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets import TransitionTable, dataset_from_arrays
from mpcoffline.datasets.table import build as table_build
from mpcoffline.datasets.table.cache import TableFile, cached_table

OTHER = 12345


@pytest.fixture(autouse=True)
def every_table_is_cached(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every table is large enough for the cache."""
    monkeypatch.setattr(table_build, "CACHED_ROWS", 1)
    places.warn_once.cache_clear()


def stored(name: str = "mine/plant/log-v0", seed: int = 0) -> str:
    rng = np.random.default_rng(seed)
    episode = rng.normal(size=(21, 2)), rng.uniform(-1, 1, size=(20, 1)), rng.normal(size=20)
    dataset_from_arrays(name, [episode])
    return name


def tables(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.is_dir())


@pytest.mark.parametrize("mask", [0o000, 0o002, 0o022])
def test_a_table_is_this_users_alone_and_found_again(mask: int, machine: Path) -> None:
    name, before = stored(), os.umask(mask)
    try:
        rows = TransitionTable.from_minari(name).rows
    finally:
        os.umask(before)
    (table,) = tables(machine / "cache" / "tables")
    assert table.stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in table.iterdir()} == {0o600}
    built = (table / "rows.f32").stat().st_ino
    np.testing.assert_array_equal(TransitionTable.from_minari(name).rows, rows)
    assert (table / "rows.f32").stat().st_ino == built
    assert {path.name[0] for path in (machine / "cache" / "tables").iterdir()}.isdisjoint(".")


@pytest.mark.parametrize("file", ["rows.f32", "episodes.i64", "table.json"])
@pytest.mark.parametrize("how", ["theirs", "writable", "link"])
def test_a_table_that_another_could_have_written_is_built_again(file: str, how: str, machine: Path) -> None:
    name = stored()
    rows = np.array(TransitionTable.from_minari(name).rows)
    (table,) = tables(machine / "cache" / "tables")
    planted = table / file
    if how == "theirs":
        if os.geteuid() != 0:
            pytest.skip("only root can give files away")
        os.chown(planted, OTHER, OTHER)
    elif how == "writable":
        planted.chmod(0o666)
    else:
        planted.rename(machine / "elsewhere")
        planted.symlink_to(machine / "elsewhere")
    with pytest.raises(FileFormatError, match=r"belongs to user 12345|written by others|Too many levels"):
        TableFile(table)
    np.testing.assert_array_equal(TransitionTable.from_minari(name).rows, rows)
    assert TableFile(table).rows.shape == rows.shape


def test_a_chosen_folder_that_others_can_write_is_not_used(machine: Path, caplog: pytest.LogCaptureFixture) -> None:
    shared = machine / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    name = stored()
    for memory in (None, 1):
        assert len(TransitionTable.from_minari(name, memory=memory, cache=shared)) == 20
    assert not list(shared.iterdir())
    assert caplog.text.count("can be written by others") == 1


def test_tables_that_are_not_used_go(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = machine / "cache" / "tables"
    first = TransitionTable.from_minari(stored(), memory=1)
    rows = np.array(first.rows)
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", "1 kB")
    TransitionTable.from_minari(stored("mine/plant/two-v0", seed=1), memory=1)
    assert len(tables(folder)) == 1
    np.testing.assert_array_equal(first.rows, rows)  # mapped: its files have no name any more, but are there


def test_a_derived_table_is_built_where_the_first_was(machine: Path) -> None:
    """Also where that was in files without a name."""
    table = TransitionTable.from_minari(stored(), memory=1)
    np.testing.assert_array_equal(TransitionTable.concat([table.trim(0.5), table]).rows[-20:], table.rows)
    assert not list((machine / "cache" / "tables").glob(".building-*"))


def test_half_a_table_of_a_killed_process_goes_with_the_next(machine: Path) -> None:
    folder = places.cache_folder("tables")
    old = folder / ".building-old"
    old.mkdir()
    (old / ".lock").touch()
    rows = np.zeros((3, 2 * 2 + 1 + 2), np.float32)
    file = cached_table("a" * 40, 2, 1, [(rows, np.zeros(3, np.int64))], folder)
    np.testing.assert_array_equal(file.rows, rows)
    assert not old.exists()
