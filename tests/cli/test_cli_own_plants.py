"""``learn``, ``evaluate`` and ``plot`` take a plant file, as ``tune`` does."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import mpcoffline
from mpcoffline import MPCPolicy, OfflineMPCLearner
from mpcoffline.cli.main import app
from mpcoffline.learner.presets import PRESETS
from mpcoffline.learning import Bellman
from mpcoffline.plants import load_plant

PLANT = """
from mpcoffline import Input, Limit, Plant, Signal, State

plant = Plant(
    "a heated room",
    dt=60.0,
    states=[State("room", "degC", 10, 35)],
    inputs=[Input("heating", "kW", 0, 5)],
    signals=[Signal("set_point", "degC", low=19, high=23), Signal("outside", "degC", low=-5, high=10)],
    parameters={"loss": 2e-4, "gain": 8e-4},
    dynamics=lambda x, u, d, p: [p.loss * (d.outside - x.room) + p.gain * u.heating],
    cost={"room": 1.0, "heating": 0.01},
    references={"room": "set_point"},
    limits=[Limit("too warm", "room", high=26.0, soft=10.0)],
    horizon=8,
    steps=30,
)
"""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    Path("room.py").write_text(PLANT)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether learning succeeds is tested elsewhere."""
    short = {"value_n_steps": 20, "value_batch_size": 16, "hidden": (8,), "fit_n_steps": 2, "refit_rows": 300}
    monkeypatch.setitem(PRESETS, "default", Bellman().replaced(short))


def call(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def logged() -> Path:
    """A log of the room under a controller that is not the MPC."""
    env, rng = load_plant("room.py").env(steps=400), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    with Path("log.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time [s]", "TI-1 [degC]", "heating [kW]", "set_point [degC]", "outside [degC]"])
        for k in range(400):
            heating = np.clip(2.0 + observation[1] - observation[0] + rng.normal(), 0.0, 5.0)
            rows.writerow([60.0 * k, observation[0], heating, *observation[1:]])
            observation, *_ = env.step(np.array([heating], dtype=np.float32))
    return Path("log.csv")


@pytest.mark.slow
@pytest.mark.usefixtures("brief")
def test_a_plant_file_and_its_log_are_learned_evaluated_and_drawn() -> None:
    options = ("--column", "room=TI-1", "--candidate", "full", "--out", "new/room.zip", "--json")
    result = call("learn", "room.py", str(logged()), *options)
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    learner, plant = OfflineMPCLearner.load("new/room.zip"), load_plant("room.py")
    assert learner.nominal_mpc.to_json() == plant.mpc().to_json()
    assert document["learned"]["model.gain"] == learner.mpc.values["model.gain"]

    result = call("evaluate", "new/room_policy.zip", "--env", "room.py", "--episodes", "2", "--seed", "4", "--json")
    assert result.exit_code == 0, result.output
    expected = mpcoffline.evaluate(
        MPCPolicy.load("new/room_policy.zip"), plant.env(), 2, 4, discount=learner.mpc.discount
    )
    np.testing.assert_allclose(json.loads(result.stdout)["costs"], expected.cost)
    assert json.loads(result.stdout)["success"] is None, "a described plant does not say what success is"

    result = call("plot", "new/room.zip", "--env", "room.py", "--out", "figures", "--json")
    assert result.exit_code == 0, result.output
    names = {Path(name).name for name in json.loads(result.stdout)["files"]}
    assert names == {f"{stem}.{end}" for stem in ("training", "cost", "closed_loop") for end in ("pdf", "png")}


def test_what_is_not_of_the_plant_is_refused() -> None:
    MPCPolicy(load_plant("room.py").mpc()).save("room.zip")
    other = call("evaluate", "room.zip", "--env", "mpcoffline/PendulumSwingUp-v0")
    assert other.exit_code == 1
    assert "action_space: expected the policy's" in other.stderr
    assert call("evaluate", "room.zip", "--env", "room.py", "--alpha", "1").exit_code == 2
    missing = call("evaluate", "room.zip", "--env", "rom.py")
    assert missing.exit_code == 1
    assert "rom.py" in missing.stderr
    without = call("learn", "room.py")
    assert without.exit_code == 2
    assert "logs" in without.stderr
    Path("log.csv").write_text("")
    assert call("learn", "pendulum", "log.csv").exit_code == 2


def test_the_learner_beside_a_policy_is_named() -> None:
    MPCPolicy(load_plant("room.py").mpc()).save("MPC_3.zip")
    Path("MPC_3_learner.zip").write_bytes(b"")
    result = call("plot", "MPC_3.zip", "--env", "room.py")
    assert result.exit_code == 1
    assert "MPC_3_learner.zip" in result.stderr
