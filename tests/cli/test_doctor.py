"""The doctor: what it finds here, and what it says when something is broken."""

from __future__ import annotations

import json
import platform
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from typer.testing import CliRunner

from mpcoffline.cli import doctor
from mpcoffline.cli.main import app
from mpcoffline.datasets.store.local import shipped_datasets


@pytest.fixture(autouse=True)
def own_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def by_name(found: dict[str, Any]) -> dict[str, dict[str, str]]:
    return {check["name"]: check for check in found["checks"]}


def test_here_everything_needed_works() -> None:
    result = CliRunner().invoke(app, ["doctor", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    checks = by_name(found)
    assert found["ok"] is True
    assert checks["Python"]["found"].startswith(platform.python_version())
    assert {checks[name]["status"] for name in ("torch", "casadi", "solver lqr", "solver ipopt", "data sets")} == {"ok"}
    assert checks["data sets"]["found"] == f"{len(shipped_datasets())} shipped, 0 local"
    assert all(check["advice"] for check in checks.values() if check["status"] != "ok")


def only(monkeypatch: pytest.MonkeyPatch, *examinations: str) -> None:
    monkeypatch.setattr(doctor, "_EXAMINATIONS", tuple(getattr(doctor, name) for name in examinations))


def test_without_a_compiler_it_warns_and_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch, "_compiler", "_solvers")
    monkeypatch.setenv("CC", "/nowhere/cc")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0].startswith("warn  C compiler: none -> Install gcc or clang")
    assert any(line.startswith("warn  solver ddp:") for line in lines)
    assert any(line.startswith("ok    solver ipopt:") for line in lines)


def test_a_compiler_that_fails_is_found_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch, "_compiler")
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho no licence >&2\nexit 3\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    first, second = doctor.checkup()["checks"]
    assert first["status"] == "warn"
    assert "no licence" in first["found"]
    assert (second["name"], second["status"]) == ("C compiler", "ok")  # which takes its place


@pytest.mark.parametrize("kind", ["absent", "there", "shared", "file"])
def test_the_cache_with_its_size_and_whether_it_is_usable(
    kind: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    only(monkeypatch, "_cache")
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", "3 GB")
    if kind == "file":
        (tmp_path / "cache").write_text("in the way")
    elif kind != "absent":
        (tmp_path / "cache" / "tables").mkdir(parents=True)
        (tmp_path / "cache").chmod(0o777 if kind == "shared" else 0o700)
        (tmp_path / "cache" / "tables" / "rows").write_bytes(bytes(5_000_000))
    (check,) = doctor.checkup()["checks"]
    size = 5 if kind in ("there", "shared") else 0
    assert check["found"].startswith(f"{tmp_path}/cache, {size} MB of at most 3000")
    assert check["status"] == ("ok" if kind in ("absent", "there") else "warn")
    expected = {"shared": "it can be written by others", "file": "it is no folder"}
    assert check["found"].endswith(expected.get(kind, "of at most 3000"))


def test_a_missing_needed_package_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "_versions")
    needed = [Requirement("numpy"), Requirement("a-package-that-nobody-has")]
    monkeypatch.setattr(doctor, "_needed", lambda: needed)
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert "fail  a-package-that-nobody-has: not installed -> Run: pip install" in result.stdout


def test_what_is_needed_is_what_the_metadata_say() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"]
    assert [each.name for each in doctor._needed()] == [Requirement(text).name for text in project["dependencies"]]


def test_a_needed_package_that_is_too_old_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "_versions")
    monkeypatch.setattr(doctor, "_needed", lambda: [Requirement("numpy>=999")])
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert ", where >=999 is needed -> Run: pip install" in result.stdout


def test_missing_optional_packages_name_their_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "_optional_packages")
    monkeypatch.setattr(doctor, "_version", lambda _: None)
    found = doctor.checkup()
    assert found["ok"] is True
    assert 'pip install "mpcoffline[render]"' in by_name(found)["pygame"]["advice"]


def test_a_store_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert doctor._writable(tmp_path / "new" / "folder")
    assert not doctor._writable(tmp_path / "file" / "folder")


def test_what_breaks_unforeseen_is_a_failed_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def _hardware() -> Any:
        raise RuntimeError("driver lost")

    monkeypatch.setattr(doctor, "_EXAMINATIONS", (_hardware,))
    found = doctor.checkup()
    assert found["ok"] is False
    assert by_name(found)["hardware"]["found"] == "RuntimeError: driver lost"
