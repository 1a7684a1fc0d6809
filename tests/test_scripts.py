"""The entry points refuse a machine that lacks something, in words, before they change anything."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = ("bash", "env", "dirname", "basename", "cat", "cksum", "grep", "rm", "mktemp", "sed")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The files that the scripts look at, and a PATH with hardly anything."""
    folder = tmp_path / "checkout"
    shutil.copytree(ROOT / "scripts", folder / "scripts", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, folder / name)
    (tmp_path / "bin").mkdir()
    for tool in TOOLS:
        (tmp_path / "bin" / tool).symlink_to(str(shutil.which(tool)))
    return folder


def command(checkout: Path, name: str, text: str) -> None:
    """Puts a made-up program on the PATH."""
    program = checkout.parent / "bin" / name
    program.write_text(f"#!{shutil.which('bash')}\n{text}\n")
    program.chmod(0o755)


def call(checkout: Path, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": str(checkout.parent / "bin")}
    return subprocess.run(
        [checkout / "scripts" / script, *arguments], env=environment, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("script", ["quickstart", "test", "test_oldest", "docs"])
def test_what_is_missing_is_named_and_nothing_is_made(checkout: Path, script: str) -> None:
    done = call(checkout, script)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"{script}: expected a C compiler")
    command(checkout, "cc", "")
    done = call(checkout, script)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"{script}: expected Python 3.11 or later, found none.")
    command(checkout, "python3", '[ "$1" = --version ] && echo Python 3.10.2 || exit 1')
    done = call(checkout, script)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"{script}: expected Python 3.11 or later, found Python 3.10.2.")
    assert not (checkout / ".venv").exists()


@pytest.mark.parametrize("script", ["quickstart", "test", "test_oldest", "docs"])
def test_help_says_what_the_script_does(checkout: Path, script: str) -> None:
    done = call(checkout, script, "--help")
    assert done.returncode == 0
    assert f"Usage: scripts/{script}" in done.stdout
    assert "Python >= 3.11" in done.stdout


def test_torch_is_pinned_and_pins_are_complete() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    assert pins["torch"] == "2.13.0"
    names = {name.lower().replace("_", "-") for name in pins}
    needed = {
        "gymnasium",
        "stable-baselines3",
        "casadi",
        "h5py",
        "minari",
        "numpy",
        "scipy",
        "matplotlib",
        "typer",
        "rich",
    }
    assert needed <= names
    assert {"pytest", "mypy", "ruff", "hypothesis", "scipy-stubs", "import-linter", "build", "pytest-xdist"} <= names
