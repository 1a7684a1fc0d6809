"""Results replace files as a whole, and nothing but files; what cannot be written is refused before the work."""

from __future__ import annotations

import fcntl
import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from task_ids import PENDULUM

from mpcoffline import MPCPolicy
from mpcoffline.control.export import export_c
from mpcoffline.core.archive import write_archive
from mpcoffline.core.errors import StorageError
from mpcoffline.core.outputs import check_output, check_output_folder, replaced, write_file
from mpcoffline.learner.loggers import CSVLogger
from mpcoffline.plants.nominal import nominal_mpc


def special_files(folder: Path) -> dict[str, Path]:
    """One of each kind that needs no rights."""
    made = {name: folder / name for name in ("FIFO", "folder", "socket")}
    os.mkfifo(made["FIFO"])
    made["folder"].mkdir()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(made["socket"]))
    return made | {"device": Path(os.devnull)}


WRITERS: dict[str, Callable[[Path], object]] = {
    "file": lambda path: write_file(path, b"new"),
    "archive": lambda path: write_archive(path, "thing", {}),
    "logger": CSVLogger,
    "policy": lambda path: MPCPolicy(nominal_mpc(PENDULUM)).save(path),
    "check": check_output,
}


@pytest.mark.parametrize("writer", WRITERS)
def test_what_is_no_file_is_never_replaced(writer: str, tmp_path: Path) -> None:
    for kind, path in special_files(tmp_path).items():
        before = os.stat(path)
        link = tmp_path / f"link to {kind}"
        link.symlink_to(path)
        for name in (path, link):
            with pytest.raises(StorageError, match=f"expected a file or nothing there, got a {kind}"):
                WRITERS[writer](name)
        after = os.stat(path)
        assert (stat.S_IFMT(after.st_mode), after.st_ino) == (stat.S_IFMT(before.st_mode), before.st_ino)
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for target in ("there/old", "there/new"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(target)
        write_file(tmp_path / "link", "text °")
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / target).read_text(encoding="utf-8") == "text °"


def test_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(StorageError):
        write_file(tmp_path / "a", b"")


def test_a_file_is_on_the_disk_before_it_takes_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: (calls.append("fsync"), sync(descriptor)))
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("replace"), replace(a, b)))
    write_archive(tmp_path / "x.zip", "thing", {}, {"a": np.zeros(3)})
    assert calls == ["fsync", "replace", "fsync"]


def test_an_interruption_leaves_the_old_file_alone(tmp_path: Path) -> None:
    write_file(tmp_path / "x", b"old")

    def interrupted() -> None:
        with replaced(tmp_path / "x") as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "x").read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["x"]


def test_folders_that_take_no_file_are_refused_and_none_is_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError):
        check_output_folder(tmp_path / "file")
    with pytest.raises(StorageError):
        check_output_folder(tmp_path / "file" / "below")
    with pytest.raises(StorageError, match="No such file"):
        check_output(tmp_path / "none" / "x")
    check_output(tmp_path / "none" / "x", make=True)
    check_output_folder(tmp_path / "none" / "deeper", ("a",))
    (tmp_path / "out" / "results.json").mkdir(parents=True)
    with pytest.raises(StorageError, match=r"results\.json"):
        check_output_folder(tmp_path / "out", ("results.json",))
    assert sorted(os.listdir(tmp_path)) == ["file", "out"]


def test_an_export_is_refused_before_it_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mpcoffline.control.export.DDPSolver", None)  # which is not asked
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError):
        export_c(MPCPolicy(nominal_mpc(PENDULUM)), tmp_path / "file")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_places_are_refused(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("kept")
    (tmp_path / "old").chmod(0o400)
    with pytest.raises(StorageError, match="read-only"):
        check_output(tmp_path / "old")
    tmp_path.chmod(0o500)
    with pytest.raises(StorageError):
        check_output(tmp_path / "new")


def test_what_killed_writers_left_goes_with_the_next_one(tmp_path: Path) -> None:
    target, others = tmp_path / "p.zip", [tmp_path / ".p.zip.notes", tmp_path / ".q.zip.0123456789ab"]
    killed = os.fork()
    if killed == 0:
        with replaced(target):
            os._exit(0)  # as a kill would: nothing is tidied up
    os.waitpid(killed, 0)
    (left,) = tmp_path.glob(".p.zip.*")
    for path in others:
        path.touch()
    with replaced(target) as file:
        assert not left.exists()
        (own,) = set(tmp_path.glob(".p.zip.*")) - {others[0]}
        write_file(target, b"first")
        assert own.exists()  # its writer lives
        file.write(b"second")
    assert target.read_bytes() == b"second"
    assert sorted(tmp_path.iterdir()) == sorted([target, *others])


def test_what_is_no_file_is_not_taken_for_what_a_writer_left(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / ".p.zip.0123456789ab")  # to open it would wait for ever
    (tmp_path / ".p.zip.0123456789ac").symlink_to(tmp_path / ".p.zip.0123456789ab")
    write_file(tmp_path / "p.zip", b"content")
    assert len(os.listdir(tmp_path)) == 3


def test_a_complete_file_is_not_taken_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def replace(temporary: Path, target: Path) -> None:
        monkeypatch.undo()
        write_file(target, b"another writer's")
        os.replace(temporary, target)

    monkeypatch.setattr(os, "replace", replace)
    write_file(tmp_path / "p.zip", b"content")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"content"]


@pytest.mark.parametrize("mode", [0o600, 0o755])
def test_permissions_stay(tmp_path: Path, mode: int) -> None:
    write_file(tmp_path / "p.zip", b"first")
    (tmp_path / "p.zip").chmod(mode)
    write_file(tmp_path / "p.zip", b"second")
    assert stat.S_IMODE((tmp_path / "p.zip").stat().st_mode) == mode


def test_a_file_that_is_taken_before_it_has_its_lock_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[Path] = []

    def flock(file: Any, operation: int) -> None:
        if not taken:
            taken.append(Path(file.name))
            taken[0].unlink()
        real(file, operation)

    real = fcntl.flock
    monkeypatch.setattr(fcntl, "flock", flock)
    write_file(tmp_path / "p.zip", b"content")
    assert taken
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"content"]
