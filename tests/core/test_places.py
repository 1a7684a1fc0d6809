"""Where caches are, and whom they trust there: other users, other environments, no home, no room."""

from __future__ import annotations

import os
import pwd
import stat
import tempfile
from pathlib import Path

import pytest

from mpcoffline.core import places

OTHER = 12345
root_only = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")


@pytest.fixture(autouse=True)
def surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Temporary files, a home and a working folder of the test's own, and no setting."""
    for name in ("temporary", "home", "work"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.delenv("MPCOFFLINE_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    places.warn_once.cache_clear()
    places._folder_of_this_process.cache_clear()
    return tmp_path


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("xdg", [None, "", " ", "relative", "./here", "~/there"])
def test_an_empty_or_relative_xdg_folder_counts_as_unset(
    xdg: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if xdg is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", xdg)
    assert places.cache_folder("tables") == tmp_path / "home" / ".cache" / "mpcoffline" / "tables"
    assert not list((tmp_path / "work").iterdir())


def test_an_absolute_xdg_folder_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert places.cache_folder("tables") == tmp_path / "xdg" / "mpcoffline" / "tables"


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (".", "work"),
        ("some/where", "work/some/where"),
        ("~/mine", "home/mine"),
        ("~", "home"),
        ("", "home/.cache/mpcoffline"),
    ],
)
def test_one_setting_for_all_caches_is_made_absolute(
    setting: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPCOFFLINE_CACHE", setting)
    for kind in ("solvers", "tables"):
        folder = places.cache_folder(kind)
        assert folder == tmp_path / expected / kind
        assert mode(folder) == 0o700


def test_folders_are_private_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        folder = places.cache_folder("tables")
    finally:
        os.umask(before)
    assert (mode(folder), mode(folder.parent)) == (0o700, 0o700)


@pytest.mark.parametrize("which", ["root", "kind"])
@pytest.mark.parametrize("permissions", [0o777, 0o775, 0o757, 0o1777])
def test_a_folder_that_others_can_write_is_not_used(
    which: str, permissions: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    root = tmp_path / "shared"
    (root / "tables").mkdir(parents=True, mode=0o700)
    (root if which == "root" else root / "tables").chmod(permissions)
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(root))
    folder = places.cache_folder("tables")
    assert folder == tmp_path / "temporary" / f"mpcoffline-{os.geteuid()}" / "tables"
    assert mode(folder) == mode(folder.parent) == 0o700
    assert places.cache_folder("tables") == folder
    assert caplog.text.count("can be written by others") == 1
    assert places.private_folder(root if which == "root" else root / "tables", "tables") == folder


@root_only
@pytest.mark.parametrize("way", ["owned", "link of another's"])
def test_a_folder_of_another_user_is_not_used(way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "theirs"
    if way == "owned":
        root.mkdir(mode=0o700)
    else:
        (tmp_path / "mine").mkdir()
        root.symlink_to(tmp_path / "mine")
    os.lchown(root, OTHER, OTHER)
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(root))
    assert places.cache_folder("solvers").is_relative_to(tmp_path / "temporary")
    assert not list(root.iterdir())


@root_only
def test_a_temporary_folder_that_another_user_made_first_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = tmp_path / "temporary" / "mpcoffline-0"
    planted.mkdir()
    os.chown(planted, OTHER, OTHER)
    monkeypatch.setenv("MPCOFFLINE_CACHE", "/dev/null/no")
    folder = places.cache_folder("solvers")
    assert folder.is_relative_to(tmp_path / "temporary")
    assert not folder.is_relative_to(planted)
    assert mode(folder.parent) == 0o700


@pytest.mark.parametrize("setting", ["", "~/cache", "~"])
@pytest.mark.parametrize("xdg", [None, "", "relative"])
def test_no_home_is_no_error(
    setting: str, xdg: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As for a uid without an entry in the list of users: a folder among the temporary files, the same each time."""

    def unknown(uid: int) -> None:
        raise KeyError(uid)

    monkeypatch.delenv("HOME")
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.setenv("MPCOFFLINE_CACHE", setting)
    if xdg is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", xdg)
    assert places.cache_root() is None
    expected = tmp_path / "temporary" / f"mpcoffline-{os.geteuid()}" / "solvers"
    assert [places.cache_folder("solvers"), places.cache_folder("solvers")] == [expected, expected]
    assert caplog.text.count("no home directory") == 1
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    if not setting:
        assert places.cache_root() == tmp_path / "xdg" / "mpcoffline"


def test_a_folder_that_cannot_be_written_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    known = places.cache_folder("tables")
    monkeypatch.setattr(os, "access", lambda path, mode: path != known)
    assert places.cache_folder("tables").is_relative_to(tmp_path / "temporary")


def test_own_files_are_opened(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"mine")
    file.chmod(0o644)
    with os.fdopen(places.open_own(file), "rb") as opened:
        assert opened.read() == b"mine"
    with pytest.raises(FileNotFoundError):
        places.open_own(tmp_path / "none")


@pytest.mark.parametrize("what", ["group", "world", "link", "folder", "fifo", "owner"])
def test_what_others_could_have_written_is_not_opened(what: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"mine")
    file.chmod({"group": 0o664, "world": 0o646}.get(what, 0o600))
    if what == "link":
        file = tmp_path / "link"
        file.symlink_to(tmp_path / "file")
    elif what == "folder":
        file = tmp_path
    elif what == "fifo":  # opening one would wait for a writer
        file = tmp_path / "fifo"
        os.mkfifo(file)
    elif what == "owner":
        if os.geteuid() != 0:
            pytest.skip("only root can give files away")
        os.chown(file, OTHER, OTHER)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match=r"written by others|Too many|is no regular file|belongs to user 12345"):
        places.open_own(file)
    assert len(os.listdir("/proc/self/fd")) == before
