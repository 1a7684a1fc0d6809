"""The diagrams of the documentation show the package as it is: its imports decide what is drawn."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_diagrams_are_up_to_date() -> None:
    script = ROOT / "docs" / "figures" / "make_diagrams.py"
    result = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stderr
