"""The plant files of the guide on limits: they load, count what they say, and their MPCs keep to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mpcoffline.mpc.penalties import limit_expressions
from mpcoffline.solvers import IpoptSolver
from mpcoffline.studies.plant_files import PlantFile

FOLDER = Path(__file__).parents[2] / "docs" / "guides" / "limited_plants"
PLANTS = ("tank_levels", "crane")


@pytest.mark.parametrize("name", PLANTS)
def test_mpcs_and_simulator_have_the_same_limits(name: str) -> None:
    """What a step violates by is what the MPC's h says of the state that it reached."""
    import casadi as ca

    plant = PlantFile.load(FOLDER / f"{name}.py").module
    mpc, simulator, rng = plant.truth(), plant.Plant(), np.random.default_rng(0)
    x, u, theta = (ca.SX.sym(n, size) for n, size in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    h = ca.Function("h", [x, u, theta], [ca.vertcat(*(h for *_, h in limit_expressions(mpc, x, u, theta)))])
    simulator.reset(rng)
    for _ in range(30):
        action = rng.uniform(mpc.action_low, mpc.action_high)
        _, cost, _ = simulator.step(action)
        assert np.isfinite(cost)
        state = simulator.h if name == "tank_levels" else simulator.x
        assert max(simulator.violations().values()) == pytest.approx(
            float(np.max(h(state, action, mpc.theta))), abs=1e-9
        )


@pytest.mark.parametrize("name", PLANTS)
def test_the_oracle_solves_mpc_1(name: str) -> None:
    plant = PlantFile.load(FOLDER / f"{name}.py").module
    start = [6.0, 8.0] if name == "tank_levels" else [0.0, 0.0, 0.0, 0.0, 1.5]
    assert IpoptSolver(plant.mpc(0), n_starts=1).solve(start).success
