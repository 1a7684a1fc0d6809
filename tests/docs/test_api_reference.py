"""The API reference names every public name once, and nothing that is not there."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from functools import reduce
from pathlib import Path

import pytest

PAGES = Path(__file__).parents[2] / "docs" / "api"
PACKAGES = (
    "mpcoffline",
    *(f"mpcoffline.{name}" for name in ("datasets", "diagnostics", "envs", "learning", "mpc", "plotting", "solvers")),
    "mpcoffline.studies",
)
ENTRY = re.compile(r"^\.\. (?:auto(?:class|function|exception)|py:data):: (mpcoffline[\w.]*)", re.MULTILINE)


def entries() -> list[str]:
    return [name for page in sorted(PAGES.glob("*.md")) for name in ENTRY.findall(page.read_text(encoding="utf-8"))]


def public_names() -> Iterator[str]:
    """Each public name once, by the shortest path: ``mpcoffline.MPC``, not ``mpcoffline.mpc.MPC``."""
    top = importlib.import_module("mpcoffline").__all__
    for package in PACKAGES:
        for name in importlib.import_module(package).__all__:
            if package == "mpcoffline" or name not in top:
                yield f"{package}.{name}"


def resolved(name: str) -> object:
    """The object of a dotted name whose first parts are modules."""
    parts = name.split(".")
    for end in range(len(parts) - 1, 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        return reduce(getattr, parts[end:], module)
    raise AssertionError(name)


def test_every_public_name_has_one_entry() -> None:
    listed = entries()
    assert sorted(listed) == sorted(set(listed))
    assert set(public_names()) - set(listed) == set()


@pytest.mark.parametrize("name", entries())
def test_every_entry_is_there_and_documented(name: str) -> None:
    found = resolved(name)
    assert found is not None
    if callable(found):
        assert found.__doc__


def test_every_page_is_in_the_table_of_contents() -> None:
    contents = (PAGES / "index.md").read_text(encoding="utf-8").rsplit("```{toctree}", 1)[1]
    assert {page.stem for page in PAGES.glob("*.md")} - {"index"} == set(re.findall(r"^\w+$", contents, re.MULTILINE))
