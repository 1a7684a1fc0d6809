"""How much the caches hold, and what goes first."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from mpcoffline.core import caches, places


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    places.warn_once.cache_clear()
    for kind in caches.KINDS:
        places.cache_folder(kind)
    return tmp_path / "cache"


def entry(root: Path, number: int, *, used: float) -> Path:
    """100 kB, last used at that time: a library or a table."""
    if number % 2:
        path = root / "solvers" / f"ddp-{number:024x}.so"
        path.write_bytes(bytes(100_000))
    else:
        path = root / "tables" / f"{number:040x}"
        path.mkdir()
        (path / "rows.f32").write_bytes(bytes(100_000))
    os.utime(path, (used, used))
    return path


@pytest.mark.parametrize(
    ("text", "size"),
    [("", 20 * 10**9), ("5 GB", 5 * 10**9), ("1.5g", 1.5e9), ("300 MB", 3e8), ("700000", 7e5), ("0", 0), ("2TB", 2e12)],
)
def test_the_bound_is_a_setting(text: str, size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", text)
    assert caches.size_limit() == size


def test_a_bound_that_is_none_is_said_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", "much")
    assert [caches.size_limit(), caches.size_limit()] == [caches.DEFAULT_SIZE] * 2
    assert caplog.text.count("'much'") == 1


def test_what_was_not_used_for_longest_goes_first(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [entry(root, k, used=1000.0 + k) for k in range(1, 7)]
    caches.mark_used(paths[0])  # now
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", "350 kB")
    caches.trim(keep=paths[1])  # what was just made stays, whatever its age
    assert [path.exists() for path in paths] == [True, True, False, False, False, True]
    assert sum(each.size for each in caches.entries(root)) <= 350_000


def test_using_keeps_the_time_of_modification(root: Path) -> None:
    path = entry(root, 1, used=1000.0)
    caches.mark_used(path)
    assert path.stat().st_mtime == 1000.0
    assert path.stat().st_atime > 1e9


def test_nothing_else_in_the_folder_is_counted_or_removed(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MPCOFFLINE_CACHE may name a folder that has other things in it, under the same names."""
    own = entry(root, 2, used=1000.0)
    others = [
        root / "thesis.tex",
        root / "tables" / "results",
        root / "solvers" / "core.c",
        root / "music" / ("a" * 40),
    ]
    for path in others:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(50_000))
    building = root / "tables" / ".building-x"
    building.mkdir()
    target = root.parent / "target"
    target.mkdir()
    link = root / "tables" / ("b" * 40)
    link.symlink_to(target)
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", "0")
    assert [each.path for each in caches.entries(root)] == [own]
    caches.trim(keep=root)
    assert not own.exists()
    assert all(path.exists() for path in (*others, building, link, target))


def test_sizes_are_those_on_the_disk(root: Path) -> None:
    path = entry(root, 2, used=0.0)
    assert 100_000 <= caches.disk_size(path) < 120_000
    assert caches.disk_size(path / "rows.f32") < caches.disk_size(path) + 1
    assert caches.disk_size(root / "none") == 0
