"""Files that are named without their ending."""

from __future__ import annotations

from pathlib import Path

from mpcoffline.core.archive import with_ending


def test_a_name_without_ending_finds_its_file_and_no_other(tmp_path: Path) -> None:
    longer, plain = tmp_path / "a.zip", tmp_path / "a"
    assert with_ending(plain) == plain, "neither is there: the name that was given is told"
    longer.write_bytes(b"")
    assert with_ending(str(plain)) == longer
    assert with_ending(tmp_path / "a.txt") == tmp_path / "a.txt"
    plain.write_bytes(b"")
    assert with_ending(plain) == plain
