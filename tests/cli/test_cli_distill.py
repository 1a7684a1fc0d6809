"""``mpcoffline distill``, and what takes its file: ``evaluate`` and ``export``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from task_ids import LINEAR
from typer.testing import CliRunner

from mpcoffline import MPCPolicy, nominal_mpc
from mpcoffline.cli.main import app
from mpcoffline.control import DistilledPolicy
from mpcoffline.control.explicit import distilling


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    for name in ("_STEPS", "_LATER_STEPS", "_REFINED", "_LAST_REFINED"):
        monkeypatch.setattr(distilling, name, 20)
    MPCPolicy(nominal_mpc(LINEAR).replace(horizon=20)).save("policy.zip")


def said(*arguments: str, exit_code: int = 0) -> str:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == exit_code, result.output
    return result.stdout if exit_code == 0 else result.stderr


def test_from_the_policy_to_its_network_and_out() -> None:
    few = ("--multiply-adds", "150", "--labels", "800", "--out", "small.zip", "--json")
    found = json.loads(said("distill", "policy.zip", "--data", "mpcoffline/linear/ddpg-v0", "--env", LINEAR, *few))
    assert found["multiply_adds"] <= 150
    small = DistilledPolicy.load("small.zip")
    assert small.report.env is not None
    assert found["env"]["cost"] == pytest.approx(small.report.env.cost)
    seen = json.loads(said("evaluate", "small.zip", "--env", LINEAR, "--episodes", "3", "--json"))
    assert len(seen["costs"]) == 3
    assert seen["discount"] == pytest.approx(0.9)
    assert "n_solves" not in seen
    assert "cost J" in said("evaluate", "small.zip", "--env", LINEAR, "--episodes", "3")
    assert "explicit_policy.c" in said("export", "small.zip", "--out", "c")
    assert "explicit policy" in said("export", "small.zip", "--to", "casadi", exit_code=1)


def test_what_is_written_for_other_programs() -> None:
    assert "nlp.casadi" in said("export", "policy.zip", "--to", "casadi", "--out", "there")
    assert "acados_controller.py" in said("export", "policy.zip", "--to", "acados", "--out", "there")
    assert "no network" in said("export", "policy.zip", "--to", "onnx", exit_code=1)
    assert "--data" in said("distill", "policy.zip", exit_code=2)
