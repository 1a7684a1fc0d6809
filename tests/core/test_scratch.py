"""Folders to build in: gone at the end, kept while their process lives, found when it was killed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from mpcoffline.core.scratch import PREFIX, abandoned, remove_abandoned, scratch_folder

BUILDER = """
import os, sys
from pathlib import Path
from mpcoffline.core.scratch import scratch_folder
with scratch_folder(Path(sys.argv[1])) as folder:
    (folder / "half").write_text("built")
    print("building", flush=True)
    sys.stdin.read()
"""


def builder(folder: Path) -> subprocess.Popen[str]:
    """A process that builds until its input ends, or it is killed."""
    command = [sys.executable, "-c", BUILDER, str(folder)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "building\n"
    return process


def test_it_is_empty_private_and_gone_at_the_end(tmp_path: Path) -> None:
    with scratch_folder(tmp_path) as folder:
        assert not list(folder.iterdir())
        assert folder.stat().st_mode & 0o777 == 0o700
        (folder / "file").write_text("x")
        folder.rename(tmp_path / "finished")
    assert [path.name for path in tmp_path.iterdir()] == ["finished"]
    with pytest.raises(KeyError), scratch_folder(tmp_path):
        raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["finished"]


def test_what_a_killed_process_left_goes_and_what_a_living_one_builds_stays(tmp_path: Path) -> None:
    killed, living = builder(tmp_path), builder(tmp_path)
    assert len(list(tmp_path.glob(PREFIX + "*"))) == 2
    assert not abandoned(tmp_path)
    killed.kill()
    killed.communicate()
    (left,) = abandoned(tmp_path)
    assert (left / "content" / "half").read_text() == "built"
    with scratch_folder(tmp_path):
        assert not left.exists()
        assert len(list(tmp_path.glob(PREFIX + "*"))) == 2
    living.communicate("")
    assert living.returncode == 0
    assert not list(tmp_path.iterdir())


def test_a_folder_without_a_lock_is_left_alone_for_an_hour(tmp_path: Path) -> None:
    """It may be that its process made it just now; so may links and files of that name be somebody's."""
    young = tmp_path / f"{PREFIX}young"
    young.mkdir()
    (young / "somebody's").touch()
    (tmp_path / f"{PREFIX}file").write_text("")
    (tmp_path / f"{PREFIX}link").symlink_to(young)
    assert not abandoned(tmp_path)
    os.utime(young, (0, 0))
    assert abandoned(tmp_path) == [young]


def test_a_folder_that_cannot_be_had_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="none"), scratch_folder(tmp_path / "none"):
        pass


def test_an_empty_folder_of_a_process_that_was_killed_at_once_goes(tmp_path: Path) -> None:
    left = tmp_path / f"{PREFIX}first"
    left.mkdir()
    assert abandoned(tmp_path) == [left]
    with scratch_folder(tmp_path):
        assert not left.exists()


def test_a_lock_that_comes_late_keeps_its_folder(tmp_path: Path) -> None:
    late = tmp_path / f"{PREFIX}late"
    late.mkdir()
    (found,) = abandoned(tmp_path)
    with FileLock(late / ".lock"):
        remove_abandoned(found)
        assert (late / ".lock").exists()


def test_a_removal_that_is_killed_leaves_what_the_next_one_removes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed = builder(tmp_path)
    killed.kill()
    killed.communicate()
    (left,) = abandoned(tmp_path)
    calls: list[str] = []
    rmtree = shutil.rmtree

    def once(path: Path, **options: bool) -> None:
        if calls:
            raise KeyboardInterrupt
        calls.append(path.name)
        rmtree(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", once)
        with pytest.raises(KeyboardInterrupt):
            remove_abandoned(left)
    assert calls == ["content"]
    assert abandoned(tmp_path) == [left]
