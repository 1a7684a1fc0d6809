"""The study of units: its conversions, and that it goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mpcoffline.plants import nominal_mpc
from mpcoffline.studies import units
from mpcoffline.studies.units import CHANGES, PLANTS, SEEDS, Trial, Units, cases, page, run


@pytest.mark.parametrize("plant", ["pendulum", "quadrotor"])
def test_an_mpc_in_other_units_moves_and_costs_the_same(plant: str) -> None:
    env_id, options = PLANTS[plant]
    mpc = nominal_mpc(env_id, **options)
    other = Units(states=1e3, inputs=1e-2, cost=1e6, time=60.0)
    scaled, rng = other.mpc(mpc), np.random.default_rng(0)
    x, u = 0.3 * rng.normal(size=mpc.nx), 0.3 * rng.normal(size=mpc.nu)
    np.testing.assert_allclose(scaled.model(1e3 * x, 1e-2 * u), 1e3 * mpc.model(x, u), rtol=1e-6, atol=1e-6)
    costs = [float(p.stage_function(*z, p.theta)) for p, z in ((mpc, (x, u)), (scaled, (1e3 * x, 1e-2 * u)))]
    assert costs[1] == pytest.approx(1e6 * costs[0], rel=1e-9)
    ends = [float(p.terminal_function(z, p.theta)) for p, z in ((mpc, x), (scaled, 1e3 * x))]
    assert ends[1] == pytest.approx(1e6 * ends[0], rel=1e-9)
    assert scaled.model.dt == 60.0 * mpc.model.dt


def test_trials_go_on_where_they_were_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def tried(plant: str, change: str) -> Trial:
        if len(made) == 7:
            raise KeyboardInterrupt
        made.append(change)
        return Trial(plant, change, {"cost x 1e6": 10.5, "states x 1e-6": 10.006}.get(change, 10.0))

    monkeypatch.setattr(units, "tried", tried)
    path = tmp_path / "units.csv"
    with pytest.raises(KeyboardInterrupt):
        run(path, ["linear"], lambda _: None)
    made.append("after the break")
    trials = run(path, ["linear"], lambda _: None)
    assert [trial.change for trial in trials] == [change for _, change in cases(["linear"])]
    assert len(made) == 1 + SEEDS + len(CHANGES)
    text = page(trials)
    assert "| cost x 1e6 | +5.00% ! |" in text
    assert "| states x 1e-6 | +0.06% |" in text
