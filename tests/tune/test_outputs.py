"""``tune`` of a plant whose sensors show something else than its states: from a CSV of outputs to a policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpcoffline import InvalidArgumentError, load_plant
from mpcoffline.cli import app
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.tune import Tuned, retune

pytest.importorskip("polars")

PLANT = """
import casadi as ca
from mpcoffline import Input, Output, Parameter, Plant, State


def root(h):
    return h / (h**2 + 0.01) ** 0.25


plant = Plant(
    "hidden tanks",
    dt=5.0,
    states=[State("upper", "cm", 0, 40, start=(2, 12)), State("lower", "cm", 0, 40, start=(2, 12))],
    inputs=[Input("pump", "V", 0, 6)],
    parameters={"k": Parameter(GAIN, spread=0.5), "c": Parameter(0.06, spread=0.1)},
    dynamics=lambda x, u, p: [p.k * u.pump - p.c * root(x.upper), p.c * (root(x.upper) - root(x.lower))],
    cost={"lower": 1.0, "pump": 0.02},
    references={"lower": 10.0},
    outputs=[Output("gauge", lambda x: 2.0 + 0.5 * x.lower, "mbar", low=0.0, high=30.0, noise=0.05)],
    horizon=20,
    steps=40,
)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A rough plant file, and a log of the true plant, from its environment."""
    folder = tmp_path_factory.mktemp("hidden")
    truth, rough, log = folder / "truth.py", folder / "rough.py", folder / "log.csv"
    truth.write_text(PLANT.replace("GAIN", "0.07"))
    rough.write_text(PLANT.replace("GAIN", "0.11"))
    env, rng, lines = load_plant(truth).env(spread=0.0), np.random.default_rng(0), ["time [s],gauge,pump [V]"]
    t = u = 0.0
    for episode in range(9):
        y, _ = env.reset(seed=episode)
        for k in range(41):
            u = rng.uniform(0.5, 5.5) if k % 5 == 0 else u
            lines.append(f"{t:.0f},{y[0]:.6f},{u:.6f}")
            y, t = env.step(np.array([u], np.float32))[0], t + 5.0
        t += 300.0
    log.write_text("\n".join(lines))
    return rough, log


def test_from_a_log_of_outputs_to_a_policy_on_outputs(files: tuple[Path, Path], tmp_path: Path) -> None:
    plant, log = files
    out = tmp_path / "tuned"
    done = CliRunner().invoke(app, ["tune", str(plant), str(log), "--out", str(out), "--preset", "fast"])
    assert done.exit_code == 0, done.output
    assert "Finding model and states in the outputs" in done.output
    assert "has no observer" in done.output
    tuned = Tuned.load(out)
    assert tuned.verdict in ("recommend", "try with care")
    assert tuned.learner.mpc.values["model.k"] == pytest.approx(0.07, rel=0.1)
    policy = tuned.output_policy
    assert isinstance(policy, OutputFeedbackPolicy)
    env = load_plant(plant.parent / "truth.py").env(spread=0.0, steps=80)
    lower = []
    for seed in range(3):
        (y, info), state = env.reset(seed=100 + seed), None
        for _ in range(80):
            u, state = policy.predict(y, state)
            y, *_, info = env.step(u)
        lower.append(info["state"][1])
    np.testing.assert_allclose(lower, 10.0, atol=1.0)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "States are estimated from 1 output" in page
    again = CliRunner().invoke(app, ["tune", str(plant), str(log), "--out", str(out), "--preset", "fast"])
    assert "there already" in again.output
    with pytest.raises(InvalidArgumentError, match="Tune anew with all logs"):
        retune(out, log)


def test_what_needs_states_says_so(files: tuple[Path, Path]) -> None:
    plant, log = files
    for command in ("check", "learn"):
        done = CliRunner().invoke(app, [command, str(plant), str(log)])
        assert done.exit_code != 0
        assert f"expected states that are measured, for {command}" in done.output
