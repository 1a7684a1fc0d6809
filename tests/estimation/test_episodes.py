"""Parameters that are others in every episode, against plants whose loads are known."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

import mpcoffline
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.estimation import identify
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost

Array = NDArray[np.float64]
DT, FRICTION = 0.1, 0.4


def cart(varies: Any = "episode", mass: float = 3.0) -> MPC:
    """A cart of unknown load: dv/dt = (u - c v) / m, exact over a step."""
    parameters = {
        "m": Parameter(mass, low=0.1, high=50.0, unit="kg", varies=varies),
        "c": Parameter(1.0, low=0.01, high=10.0),
    }
    model = Model(lambda x, u, p: (u - p["c"] * x) / p["m"], 1, 1, DT, parameters)
    return MPC(model, QuadraticCost([[1.0]], [[0.1]]), NormCost([0.0]), 5, 0.9, [-5.0], [5.0])


def log(masses: Array, steps: int, noise: float = 0.0, seed: int = 0) -> TransitionTable:
    """Episodes of the cart by its closed-form solution, one a mass."""
    rng = np.random.default_rng(seed)
    x: list[Any] = []
    u: list[Any] = []
    reached: list[Any] = []
    episodes: list[Any] = []
    for k, m in enumerate(masses):
        v = rng.normal()
        for _ in range(steps):
            force = rng.uniform(-3.0, 3.0)
            decay = np.exp(-FRICTION * DT / m)
            after = decay * v + (1.0 - decay) * force / FRICTION
            after += noise * rng.normal()
            for column, value in ((x, [v]), (u, [force]), (reached, [after]), (episodes, k)):
                column.append(value)
            v = after
    n = len(x)
    return TransitionTable.from_arrays(
        np.array(x), np.array(u), np.zeros(n), np.array(reached), np.zeros(n), episode_ids=np.array(episodes)
    )


def test_each_episodes_load_is_found_and_the_mpc_takes_the_mean() -> None:
    masses = np.random.default_rng(0).uniform(1.0, 4.0, size=12)
    found = identify(cart(), log(masses, 80))
    spread = found.episode_spread
    assert spread is not None
    assert spread.names == ("model.m",)
    np.testing.assert_allclose(spread.values[:, 0], masses, rtol=1e-3)
    np.testing.assert_allclose(spread.mean, masses.mean(), rtol=1e-3)
    np.testing.assert_allclose(spread.covariance, np.cov(masses[None]), rtol=5e-3)
    np.testing.assert_allclose(found.theta[spread.index], spread.mean, rtol=1e-6)
    np.testing.assert_allclose(found.model.values["c"], FRICTION, rtol=5e-3)
    # The mean of twelve draws is known as well as that.
    np.testing.assert_allclose(found.deviation[spread.index], masses.std(ddof=1) / np.sqrt(12), rtol=0.35)


def test_deviations_cover_the_truth_under_noise() -> None:
    masses = np.random.default_rng(2).uniform(1.0, 4.0, size=40)
    spread = identify(cart(), log(masses, 60, noise=0.02)).episode_spread
    assert spread is not None
    off = (spread.values[:, 0] - masses) / spread.deviations[:, 0]
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.4
    np.testing.assert_allclose(spread.spread, masses.std(ddof=1), rtol=0.15)


def test_an_episode_that_says_little_is_near_the_mean_of_all() -> None:
    masses = np.r_[np.random.default_rng(3).uniform(1.0, 4.0, size=20), 4.0]
    table = log(masses, 60, noise=0.05)
    rows = np.flatnonzero((table.episode_ids < 20) | (np.arange(len(table)) == len(table) - 1))  # one row of the last
    spread = identify(cart(), table.take(rows)).episode_spread
    assert spread is not None
    assert abs(spread.values[-1, 0] - spread.values[:-1, 0].mean()) < spread.spread[0]
    assert spread.deviations[-1, 0] > 3.0 * np.median(spread.deviations[:-1, 0])


def test_a_load_that_does_not_vary_has_next_to_no_spread() -> None:
    spread = identify(cart(), log(np.full(15, 2.0), 60, noise=0.02)).episode_spread
    assert spread is not None
    np.testing.assert_allclose(spread.mean, 2.0, rtol=0.02)
    assert spread.spread[0] < 0.1


def test_one_parameter_in_other_units_changes_nothing_else() -> None:
    table = log(np.array([1.0, 2.0, 3.0, 2.5]), 50, noise=0.01)
    plain = identify(cart(), table).episode_spread
    tons = Parameter(3e-3, low=1e-4, high=5e-2, varies="episode")
    c = Parameter(1.0, low=0.01, high=10.0)
    model = Model(lambda x, u, p: (u - p["c"] * x) / (1e3 * p["m"]), 1, 1, DT, {"m": tons, "c": c})
    scaled = identify(cart().replace(model=model), table).episode_spread
    assert plain is not None
    assert scaled is not None
    np.testing.assert_allclose(1e3 * scaled.values, plain.values, rtol=1e-6)
    np.testing.assert_allclose(1e6 * scaled.covariance, plain.covariance, rtol=1e-5)


def test_it_is_a_models_parameter_that_varies_with_the_episode_and_files_keep_it() -> None:
    mpc = cart()
    assert mpc.space.varying.tolist() == [True, *([False] * (len(mpc.theta) - 1))]
    assert MPC.from_json(mpc.to_json()).space.varying.tolist() == mpc.space.varying.tolist()
    with pytest.raises(InvalidArgumentError, match="episode"):
        Parameter(1.0, varies="day")  # type: ignore[arg-type]
    with pytest.raises(InvalidArgumentError, match="of the model"):
        mpcoffline.mpc.Block.free("w", Parameter(1.0, varies="episode"), "cost")


def test_a_fixed_parameter_that_varies_is_no_matter() -> None:
    fixed = Parameter(2.0, low=2.0, high=2.0, varies="episode")
    model = Model(lambda x, u, p: ca.vertcat((u - p["c"] * x) / p["m"]), 1, 1, DT, {"m": fixed, "c": Parameter(1.0)})
    assert identify(cart().replace(model=model), log(np.full(3, 2.0), 40)).episode_spread is None
