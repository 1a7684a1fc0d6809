"""The page on the architecture names files and things that are there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = re.sub(r"\{py:\w+\}`[^`]*`", "", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))
NAMES = sorted(set(re.findall(r"`([^`\n]+)`", TEXT)))
SOURCES = "\n".join(
    path.read_text(encoding="utf-8") for folder in ("mpcoffline", "envs") for path in (ROOT / folder).rglob("*.py")
)


FILE = re.compile(r"[\w./]*\.(py|c|toml)|[\w.]*/[\w./]*")


def test_files_and_folders_are_there() -> None:
    paths = [name for name in NAMES if FILE.fullmatch(name) and "NAME" not in name]
    rooms = [ROOT, ROOT / "mpcoffline", *(room for room in (ROOT / "mpcoffline").iterdir() if room.is_dir())]
    assert len(paths) > 40
    inner = {path.name for path in (ROOT / "mpcoffline").rglob("*.*")}
    assert [p for p in paths if p not in inner and not any((room / p).exists() for room in rooms)] == []


def test_classes_functions_and_attributes_are_there() -> None:
    """Their last part is defined, or imported, somewhere in the package."""
    names = [name for name in NAMES if re.fullmatch(r"[A-Za-z_]+(\.[a-z_]+)*", name) and not FILE.fullmatch(name)]
    assert len(names) > 30
    ends = {name: name.split(".")[-1] for name in names}
    defined = r"(def|class) {0}\b|\b{0}\b *[:=]|\"{0}\"|import [^\n]*\b{0}\b"
    missing = {name for name, end in ends.items() if not re.search(defined.format(end), SOURCES)}
    assert missing <= {"print", "assert", "mpcoffline.commands"}  # what is refused, and a group of entry points
