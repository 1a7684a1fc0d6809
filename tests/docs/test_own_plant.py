"""What readers of the guide to a plant of their own see of its code runs as one program, in an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "own_plant.md").read_text(encoding="utf-8")
HIDDEN = ":tags: [remove-cell]"


def test_no_code_stands_there_that_is_not_run() -> None:
    assert "```python" not in PAGE
    assert PAGE.count(HIDDEN) == 1  # what readers do not see sets up notebooks alone
    for word in ("set-point", "NaN", "time stamp", "(from_csv.md)", "(plant_files.md)", "(time_and_signals.md"):
        assert word in PAGE


@pytest.mark.slow
def test_its_code_runs(tmp_path: Path) -> None:
    cells = re.findall(r"^```\{code-cell\}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    shown = [re.sub(r"^:tags: .*\n", "", cell) for cell in cells if HIDDEN not in cell]
    (tmp_path / "page.py").write_text("\n".join(shown), encoding="utf-8")
    store = tmp_path / "minari"
    store.mkdir()
    environment = os.environ | {"MINARI_DATASETS_PATH": str(store), "MPLBACKEND": "agg"}
    root = str(Path(__file__).parents[2])
    environment["PYTHONPATH"] = os.pathsep.join([root, environment.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "40 episodes, 4000 steps, 5.6 hours" in done.stdout
    assert "n=4000; h1 [cm], h2 [cm], pump [V])" in done.stdout
    assert "passed" in done.stdout
    table = [line for line in done.stdout.splitlines() if line.startswith(("MPC_1 ", "learned "))]
    assert len(table) == 2
