"""What docs/using_with_sb3.md says is so: its code runs, but for blocks whose optional packages are missing."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from mpcoffline.learner.presets import PRESETS
from mpcoffline.learning import Paper, ParameterConfig, ValueConfig

TEXT = (Path(__file__).parents[1] / "docs" / "using_with_sb3.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)
# What a block names, and the package it then needs.
OPTIONAL = {"VecVideoRecorder": "moviepy", "minari.DataCollector": "jax"}


@pytest.mark.slow
def test_the_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    # Whether learning succeeds is tested elsewhere; here it is brief.
    brief = Paper(horizon=15, value=ValueConfig(n_steps=20), fit=ParameterConfig(n_steps=2, refit_rows=2000))
    monkeypatch.setitem(PRESETS, "paper", brief)
    names: dict[str, object] = {"__name__": "__main__"}
    for block in BLOCKS:
        missing = [package for name, package in OPTIONAL.items() if name in block and find_spec(package) is None]
        if "rl_zoo3" in block or missing:  # the zoo's program reads the command line: tests/sb3/test_sb3.py
            continue
        shorter = block.replace("1000", "3").replace("n_eval_episodes=10", "n_eval_episodes=2")
        exec(compile(shorter, "using_with_sb3.md", "exec"), names)
    assert {path.name for path in tmp_path.iterdir()} >= {"pendulum.zip", "best"}
    _, metrics = names["history"][-1]  # type: ignore[index]
    assert metrics["return"] < 0.0
    assert names["returns"].shape == (2,)  # type: ignore[attr-defined]
    assert names["dataset"].total_episodes == 5  # type: ignore[attr-defined]
