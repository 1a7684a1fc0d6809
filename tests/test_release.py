"""What a release says of itself: version, lower bounds, citation."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import mpcoffline

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def pins(name: str) -> dict[str, Version]:
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(package): Version(number) for package, number in pairs}


def test_there_is_one_version_and_it_is_semantic() -> None:
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "mpcoffline.__version__"}
    assert version("mpcoffline") == mpcoffline.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+(-[\w.]+)?", mpcoffline.__version__)


def test_the_oldest_versions_are_the_lower_bounds() -> None:
    oldest, newest = pins("constraints-oldest.txt"), pins("constraints.txt")
    for text in PROJECT["project"]["dependencies"]:
        requirement = Requirement(text)
        name = canonicalize_name(requirement.name)
        assert requirement.specifier.contains(newest[name]), text
        if name == "torch":  # the old ones are large; constraints-oldest.txt says how the bound was tried
            assert oldest[name] == newest[name]
            continue
        [low] = [Version(part.version) for part in requirement.specifier if part.operator == ">="]
        assert oldest[name] in (low, Version(f"{low}.0")), text


def test_the_citation_is_the_papers() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["cff-version"], citation["title"], citation["license"]) == ("1.2.0", "mpcoffline", "MIT")
    paper = citation["preferred-citation"]
    assert paper["doi"] == "10.48550/arXiv.2301.01667"
    names = " and ".join(f"{person['given-names']} {person['family-names']}" for person in paper["authors"])
    assert f"{{{names}}}" in (ROOT / "README.md").read_text(encoding="utf-8")
