"""Dependencies point one way; the contracts stand in pyproject.toml."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_import_contracts() -> None:
    code = (
        "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command(['--no-cache']))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_modules_stay_readable() -> None:
    """No module above 400 lines."""
    modules = [*(ROOT / "mpcoffline").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]
    assert modules
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in modules}
    assert {name: n for name, n in lengths.items() if n > 400} == {}


def test_all_packages_are_installed() -> None:
    """Each folder with modules is in pyproject.toml's list, which the wheel is made from."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "mpcoffline").rglob("__init__.py")}
    linked = {"mpcoffline.envs", "mpcoffline.datasets.catalog"}
    assert {".".join(folder.parts) for folder in folders} | linked == set(listed)
