"""``tune`` of a plant whose sensors show something else than its states: from a CSV of outputs to a policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpcoffline import TransitionTable, load_plant
from mpcoffline.cli import app
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.learner.presets import PRESETS
from mpcoffline.tune import Calibration, LogCheck, Tuned, check_log

pytest.importorskip("polars")
pytestmark = pytest.mark.usefixtures("unpainted")

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


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """A preset that learns V in a third of its steps."""
    monkeypatch.setitem(PRESETS, "fast", PRESETS["fast"].replaced({"value_n_steps": 1_000, "polyak": 0.06}))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A rough plant file, and a log of the true plant, from its environment."""
    folder = tmp_path_factory.mktemp("hidden")
    truth, rough, log = folder / "truth.py", folder / "rough.py", folder / "log.csv"
    truth.write_text(PLANT.replace("GAIN", "0.07").replace("spread=0.5", "spread=0").replace("spread=0.1", "spread=0"))
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
    assert "model and states, in the outputs" in done.output
    assert {each.name for each in (out / "controller").iterdir()} >= {"mpc_observer.c", "mpc_controller.c"}
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
    before = tuned.table.n_episodes
    trial, truth = tmp_path / "trial.csv", plant.parent / "truth.py"
    command = ["serve", str(out / "policy.zip"), "--simulate", str(truth), "--log", str(trial), "--periods", "60"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert done.output.startswith("60 periods, 60 decided by the policy")
    done = CliRunner().invoke(app, ["retune", str(out), str(trial)])
    assert done.exit_code == 0, done.output
    assert "outputs of both logs" in done.output
    calibration = Calibration.from_json(Tuned.load(out).document["trials"][-1])
    assert calibration.known
    assert not calibration.far, str(calibration)
    after = Tuned.load(out)
    assert after.table.n_episodes == before + 1
    assert isinstance(after.output_policy, OutputFeedbackPolicy)
    assert "learned from already" in CliRunner().invoke(app, ["retune", str(out), str(trial)]).output


def test_what_needs_states_says_so(files: tuple[Path, Path]) -> None:
    plant, log = files
    done = CliRunner().invoke(app, ["learn", str(plant), str(log)])
    assert done.exit_code != 0
    assert "expected states that are measured, for learn" in done.output


def rows_of(log: Path) -> tuple[str, list[list[float]]]:
    head, *lines = log.read_text().splitlines()
    return head, [[float(cell) for cell in line.split(",")] for line in lines]


def written(path: Path, head: str, rows: list[list[float]]) -> Path:
    path.write_text("\n".join([head, *(",".join(map(repr, row)) for row in rows)]))
    return path


def about(found: LogCheck, kind: str, what: str) -> str:
    return " ".join(each.text for each in found.remarks if (each.kind, each.about) == (kind, what))


def test_a_sound_log_of_outputs_gives_no_alarm(files: tuple[Path, Path]) -> None:
    plant, log = files
    done = CliRunner().invoke(app, ["check", str(plant), str(log)])
    assert done.exit_code == 0, done.output
    assert done.output.startswith("Worth tuning. 15 steps ahead, the described model is")
    assert "the log determines all 2" in done.output
    assert "dead time: none" in done.output
    assert "Write delay" not in done.output
    assert "States that are estimated" in done.output


def test_what_is_wrong_with_a_log_of_outputs_is_named(files: tuple[Path, Path], tmp_path: Path) -> None:
    """A unit, an input that does nothing, an output that is stuck: without a model, where that would only mislead."""
    plant, (head, rows) = load_plant(files[0]), rows_of(files[1])
    unit = written(tmp_path / "unit.csv", head, [[t, 3.0 * y, u] for t, y, u in rows])
    assert "episodes begin with gauge at" in about(
        check_log(plant, plant.read(unit)), "problem", "description and data"
    )
    still = written(tmp_path / "still.csv", head, [[t, y, 3.0] for t, y, _ in rows])
    assert "pump is one number throughout" in about(check_log(plant, plant.read(still)), "problem", "inputs")
    c, ids = plant.read(files[1]).values(), plant.read(files[1]).episode_ids
    beyond = TransitionTable.from_arrays(
        c.observations, 10 * c.actions, c.costs, c.next_observations, c.terminations, ids
    )
    found = check_log(plant, beyond)
    assert [each.about for each in found.remarks if each.forbids] == ["identification"]
    assert found.outputs is None


def test_dead_time_is_found_in_outputs(files: tuple[Path, Path], tmp_path: Path) -> None:
    """The pump's inputs moved three rows back in each episode of 41: it acts three steps late."""
    plant, (head, rows) = load_plant(files[0]), rows_of(files[1])
    for first in range(0, len(rows), 41):
        applied = [row[2] for row in rows[first : first + 41]]
        for row, u in zip(rows[first : first + 41], [*applied[3:], *applied[-1:] * 3], strict=True):
            row[2] = u
    found = check_log(plant, plant.read(written(tmp_path / "late.csv", head, rows)))
    assert "pump acts 3 steps late. Write delay=3" in about(found, "advice", "dead time")
    assert found.outputs is not None
    assert found.outputs.mpc.layout.delay == (3,)


WITHOUT_EQUATIONS = """
from mpcoffline import BlackBoxPlant, Input, Output

plant = BlackBoxPlant(
    "hidden tanks",
    dt=5.0,
    outputs=[Output("gauge", unit="mbar", low=0.0, high=30.0)],
    inputs=[Input("pump", "V", 0, 6)],
    cost={"gauge": 4.0, "pump": 0.02},
    references={"gauge": 7.0},
    horizon=20,
    steps=40,
)
"""


def test_a_plant_without_equations_gets_a_model_of_its_log(files: tuple[Path, Path], tmp_path: Path) -> None:
    plant, out = tmp_path / "unknown.py", tmp_path / "tuned"
    plant.write_text(WITHOUT_EQUATIONS)
    done = CliRunner().invoke(app, ["tune", str(plant), str(files[1]), "--out", str(out), "--preset", "fast"])
    assert done.exit_code == 0, done.output
    assert "A linear model with 2 states" in (out / "report.html").read_text(encoding="utf-8")
    policy, env = Tuned.load(out).output_policy, load_plant(files[0].parent / "truth.py").env(spread=0.0, steps=80)
    lower = []
    for seed in range(3):
        (y, info), state = env.reset(seed=100 + seed), None
        for _ in range(80):
            u, state = policy.predict(y, state)
            y, *_, info = env.step(u)
        lower.append(info["state"][1])
    np.testing.assert_allclose(lower, 10.0, atol=1.0)  # 7 mbar
