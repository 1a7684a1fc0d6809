"""``retune``: a trial is inside its band where the plant is as it was, far outside where it is not, and counts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from planted_logs import heater, short_episodes
from typer.testing import CliRunner

from mpcoffline import MPC, FileFormatError, Model, MPCPolicy, Parameter, TransitionTable
from mpcoffline.cli import app
from mpcoffline.datasets.logs.wanted import Wanted
from mpcoffline.diagnostics import diagnose
from mpcoffline.diagnostics.trial import TODAY, TRIED, _others, stretched, widening
from mpcoffline.mpc import Block, ParameterSpace
from mpcoffline.mpc.component import Component
from mpcoffline.tune import Calibration, Tuned, retune

pytest.importorskip("polars")
pytestmark = pytest.mark.usefixtures("unpainted")

LOG = short_episodes(21)


@pytest.fixture
def tuned(once: Tuned) -> Tuned:
    return once


@pytest.fixture
def copied(tuned: Tuned, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tuned.folder, tmp_path / "tuned"))


def trial_of(policy: MPCPolicy, gain: float, n: int = 160) -> dict[str, Any]:
    """What the plant of the log does under a policy, its gain times a factor."""
    env = heater().env(steps=n + 1)
    _, info = env.reset(seed=21)
    parameters = info["parameters"]
    y, _ = env.reset(seed=5, options={"parameters": parameters | {"K": gain * parameters["K"]}})
    state, rows = None, []
    for k in range(n):
        u, state = policy.predict(y, state)
        rows.append((5.0 * k, *y, *u))
        y, *_ = env.step(u)
    return dict(zip(("time", "T", "ambient", "power"), np.array(rows).T, strict=True))


def test_a_trial_of_the_same_plant_costs_what_was_predicted_and_is_learned_from(tuned: Tuned, copied: Path) -> None:
    trial = trial_of(tuned.policy, 1.0)
    after = retune(copied, trial, show_progress=False)
    found = after.calibration
    assert found is not None
    assert found.inside, found
    # By hand: the cost of the stretches that it says, of 39 steps as the log's episodes.
    x, u = trial["T"], trial["power"]
    costs = (x - 55.0) ** 2 + 0.002 * u**2
    assert (found.steps, found.stretches) == (39, 4)
    assert found.seen == pytest.approx(np.mean([costs[39 * i : 39 * (i + 1)].sum() for i in range(4)]), rel=1e-5)
    assert found.others == 0.0
    assert found.predicted[TODAY][0] > found.seen
    # Both logs are in the folder now, and what was there is kept.
    assert len(after.tuned.table) == len(tuned.table) + 159
    former = Tuned.load(copied / "1")
    assert former.document["identity"] == tuned.document["identity"]
    assert after.tuned.document["today"] == tuned.table.n_episodes == 5
    candidates = after.tuned.learner.candidates
    assert candidates is not None
    assert np.array_equal(candidates["running"].theta, tuned.policy.mpc.theta)
    page = (copied / "report.html").read_text(encoding="utf-8")
    assert page.index("The trial: predicted and seen") < page.index("What would change")
    # Once more, it is known.
    again = retune(copied, trial)
    assert again.tuned.again
    assert again.calibration is None
    assert str(again).startswith("  - The trial cost ")
    assert {each.name for each in copied.iterdir() if each.is_dir()} == {"1", "controller"}


def test_a_trial_of_a_changed_plant_is_far_outside_and_nothing_is_recommended(tuned: Tuned, copied: Path) -> None:
    after = retune(copied, trial_of(tuned.policy, 0.5), show_progress=False)
    found = after.calibration
    assert found is not None
    assert found.far
    assert found.seen > 2.0 * found.band[2]
    assert "FAR OUTSIDE" in found.sentences[0]
    assert "go back to what ran before" in found.sentences[1]
    assert after.tuned.verdict != "recommend"
    # The next bands are as wide as this one would have had to be.
    assert abs(found.off) > 2.0
    assert f"{abs(found.off):.2g} times as wide" in " ".join(after.tuned.document["reasons"])
    assert f"{abs(found.off):.2g} times as wide" in (copied / "report.html").read_text(encoding="utf-8")
    command = CliRunner().invoke(app, ["retune", str(tuned.folder / "controller"), str(Path(__file__))])
    assert command.exit_code == 1
    assert "a folder that tune has made" in command.stderr


@pytest.mark.parametrize(
    "changes", [{"costs": 5}, {"episode_steps": "x"}, {"trials": [{}]}, {"version": 9}, {"options": 1}]
)
def test_a_damaged_folder_is_refused_and_stays(copied: Path, changes: dict[str, Any]) -> None:
    file = copied / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(FileFormatError, match=r"run\.json"):
        retune(copied, LOG)
    assert not (copied / "1").exists()


def calibration(seen: float, low: float, middle: float, high: float) -> Calibration:
    return Calibration(10, 3, seen, {TRIED: (low, middle, high)}, None, 5)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, -50.0), (1e4, 1e6)])
def test_inside_outside_and_far_know_no_unit_and_no_zero(scale: float, offset: float) -> None:
    for seen, inside, far in ((11.0, True, False), (14.5, False, False), (17.0, False, True), (8.0, False, False)):
        found = calibration(*(scale * v + offset for v in (seen, 9.0, 11.0, 13.0)))
        assert (found.inside, found.far) == (inside, far)
        assert found.off == pytest.approx((seen - 11.0) / 2.0)
        assert Calibration.from_json(json.loads(json.dumps(found.to_json()))) == found
    unknown = calibration(1.0, np.nan, np.nan, np.nan)
    assert not unknown.inside
    assert not unknown.far
    assert unknown.sentences[0].startswith("Nothing was predicted")


def test_bands_become_as_wide_as_trials_were_off() -> None:
    """By hand: off by 3 half widths of a band, and by 1 of one twice as wide: sqrt((9 + 4) / 2)."""
    assert widening([]) == widening([(None, 1.0), (np.inf, 1.0)]) == widening([(0.4, 1.0), (-0.9, 1.0)]) == 1.0
    assert widening([(-3.0, 1.0), (1.0, 2.0), (None, 5.0)]) == pytest.approx(np.sqrt(6.5))
    assert stretched((9.0, 10.0, 14.0), 2.0) == (8.0, 10.0, 18.0)
    assert stretched((9.0, 10.0, 14.0), 2.0, floor=8.5) == (8.5, 10.0, 18.0)
    assert np.isnan(stretched((np.nan, np.nan, np.nan), 2.0, floor=8.5)).all()
    found = replace(calibration(11.0, 9.0, 11.0, 13.0), widened=2.5)
    assert Calibration.from_json(json.loads(json.dumps(found.to_json()))) == found


def test_the_cost_of_todays_controller_is_that_of_its_own_episodes(tuned: Tuned) -> None:
    table = tuned.table
    report = diagnose(tuned.learner, table, n_starts=8, today=2)
    ids, costs = np.asarray(table.episode_ids), table.costs.astype(np.float64)
    by_hand = np.mean([costs[ids == i].sum() for i in (0, 1)])
    assert report.judgement.today.logged == pytest.approx(by_hand, rel=1e-5)


def test_what_reads_logs_comes_from_a_file_without_code(tuned: Tuned) -> None:
    data = json.loads((tuned.folder / "plant.json").read_text())
    reader, plant = Wanted.from_json(data), heater()
    x, u, d = np.array([[60.0], [50.0]]), np.array([[10.0], [30.0]]), np.array([[20.0], [20.0]])
    assert reader.cost(x, u, d, u) == pytest.approx(plant.costs(x, u, d, u))
    assert reader.logged == plant.wanted.logged
    for broken in ({"previews": []}, {"dt": -1.0}, {"cost": {"inputs": [1], "output": 1, "instructions": []}}):
        with pytest.raises((FileFormatError, ValueError)):
            Wanted.from_json(data | broken)


class TwoValleys(Component):
    """A cost with two goals, one as good as the other."""

    def __init__(self) -> None:
        self.space = ParameterSpace([Block.free("depth", np.array(1.0), "cost")])

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        return p["depth"] * (x[0] ** 2 - 1.0) ** 2 + 0.1 * u[0] ** 2

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        return p["depth"] * (x[0] ** 2 - 1.0) ** 2


def test_a_controller_that_keeps_to_one_of_two_good_plans_is_no_other_one() -> None:
    """Between two goals a plan from nowhere goes to the nearer one, that of a controller to where it went before."""
    model = Model(
        lambda x, u, p: x + p["gain"] * u, 1, 1, 1.0, {"gain": Parameter(0.2, low=0.1, high=1.0)}, discrete=True
    )
    mpc = MPC(model, TwoValleys(), TwoValleys(), 15, 1.0, [-1.0], [1.0])
    policy, rng, rows = MPCPolicy(mpc), np.random.default_rng(0), []
    for episode in range(4):
        state, x = None, np.array([-0.2 if episode % 2 else 0.2])
        for _ in range(40):
            u, state = policy.predict(x, state)
            after = 0.05 * rng.normal(size=1)  # as if something held it there
            rows.append((x, u, after, episode))
            x = after
    x, u, after, ids = (np.array(part) for part in zip(*rows, strict=True))

    def of(inputs: Any) -> TransitionTable:
        return TransitionTable.from_arrays(x, inputs, np.zeros(160), after, np.zeros(160), ids)

    cold = policy.solver.solve(x).u0
    assert np.mean(np.abs(cold - u) > 0.5) > 0.3
    assert _others(mpc, of(u)) < 0.05
    assert _others(mpc, of(0.5 * np.abs(rng.normal(size=u.shape)))) > 0.8
