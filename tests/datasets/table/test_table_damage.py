"""A mapped table is checked where it is used: one changed byte anywhere is an error, never another number."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pendulum_data import recorded, stored

from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.table.cache import TableFile

USES: dict[str, Callable[[TransitionTable], Any]] = {
    "rows": lambda table: table.rows,
    "costs": lambda table: table.costs,
    "statistics": lambda table: table.statistics(),
    "trim": lambda table: table.trim(0.5),
    "split": lambda table: table.split(0.5, 0),
    "concat": lambda table: TransitionTable.concat([table, table]),
    "batches": lambda table: list(table.batches(4, 0, epochs=1)),
}


def _mapped(cache: Path) -> TransitionTable:
    return TransitionTable.from_minari("test/set-v0", memory=100, cache=cache)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a cached table of 30 rows."""
    stored(episodes=recorded(episodes=6))
    table = _mapped(tmp_path / "tables")
    assert table.is_mapped
    return next(path for path in (tmp_path / "tables").iterdir() if path.is_dir())


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize("use", USES)
def test_changed_rows_are_seen_by_each_use(folder: Path, use: str) -> None:
    _flip(folder / "rows.f32")
    table = _mapped(folder.parent)
    assert len(table) == 30  # nothing is read yet
    with pytest.raises(FileFormatError, match=r"block 0 with another CRC-32.*Remove that folder"):
        USES[use](table)


@pytest.mark.parametrize("use", ["episode_ids", "n_episodes"])
def test_changed_episodes_are_seen(folder: Path, use: str) -> None:
    _flip(folder / "episodes.i64")
    with pytest.raises(FileFormatError, match="episode ids with another CRC-32"):
        getattr(_mapped(folder.parent), use)


def test_rows_are_checked_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, reads = _mapped(folder.parent), []
    plain = TableFile.read_block
    monkeypatch.setattr(
        TableFile, "read_block", lambda self, block, out: reads.append(block) or plain(self, block, out)
    )
    for use in ("rows", "statistics", "trim", "costs"):
        USES[use](table)
    assert reads == [0]


@pytest.mark.parametrize("name", ["table.json", "rows.f32", "episodes.i64"])
def test_special_files_in_the_cache_are_replaced(folder: Path, name: str) -> None:
    (folder / name).unlink()
    os.mkfifo(folder / name)
    assert np.asarray(_mapped(folder.parent).rows).shape == (30, 9)
    assert (folder / name).is_file()


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": 10**15},
        {"ny": -5},
        {"block_rows": 0},
        {"block_rows": 10**30},
        {"rows": float("inf")},
        {"crcs": []},
        {"version": []},
        {"centring": {"centre": [7.0] * 9, "increments": [0] * 3}},
    ],
)
def test_a_changed_description_is_built_again(folder: Path, changes: dict[str, Any]) -> None:
    meta = json.loads((folder / "table.json").read_text())
    (folder / "table.json").write_text(json.dumps(meta | changes))
    assert np.asarray(_mapped(folder.parent).rows).shape == (30, 9)
    assert json.loads((folder / "table.json").read_text()) == meta
