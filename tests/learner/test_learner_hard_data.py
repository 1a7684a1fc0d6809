"""The default preset on data that are hard: a sensible fit or a clear error, never NaN, never silence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from mpcoffline.datasets import TransitionTable
from mpcoffline.envs import PendulumSwingUpEnv
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def pendulum_log(n_episodes: int = 50, length: int = 10, seed: int = 0) -> TransitionTable:
    """Random torques from random states; consecutive rows are consecutive steps.

    Episodes are short, as the choice among candidates simulates as many steps.
    """
    env, rng = PendulumSwingUpEnv(), np.random.default_rng(seed)
    s = np.stack([rng.uniform(-np.pi, np.pi, n_episodes), rng.uniform(-2, 2, n_episodes)], axis=1)
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for _ in range(length):
        u = rng.uniform(-2.0, 2.0, size=(n_episodes, 1)).astype(np.float32).astype(np.float64)
        reached = env.next_state(s, u)
        for column, values in zip(columns, (observed(s), u, env.cost(s, u), observed(reached)), strict=True):
            column.append(values)
        s = reached
    arrays = [np.stack(column, axis=1).reshape(n_episodes * length, *column[0].shape[1:]) for column in columns]
    episodes = np.repeat(np.arange(n_episodes), length)
    return TransitionTable.from_arrays(*arrays, np.zeros(len(episodes)), episodes)


def observed(s: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(s[:, 0]), np.sin(s[:, 0]), s[:, 1]], axis=1)


def changed(table: TransitionTable, change: Callable[[np.ndarray], None]) -> TransitionTable:
    """The table with its packed rows changed in place."""
    rows = table.rows.copy()
    change(rows)
    return TransitionTable(rows, table.ny, table.nu, table.episode_ids, table.name)


def terminate(rows: np.ndarray) -> None:
    rows[:, -1] = 1.0


def scale_costs(rows: np.ndarray) -> None:
    rows[:, 4] = 1e6 * (1.0 + rows[:, 4])


HARD = {
    "one hundred transitions": lambda: pendulum_log(10),
    "one trajectory": lambda: pendulum_log(1, 100),
    "everything terminates": lambda: changed(pendulum_log(), terminate),
    "costs of a million, with an offset": lambda: changed(pendulum_log(), scale_costs),
    "duplicated rows": lambda: TransitionTable.concat([pendulum_log(10)] * 5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD)
def test_the_default_fit_is_finite_and_steers(name: str) -> None:
    torch.set_num_threads(1)
    nominal = nominal_mpc(PENDULUM, alpha=0.5, seed=0)
    learner = OfflineMPCLearner(nominal, value_n_steps=300)
    learner.fit(HARD[name](), show_progress=False)
    assert np.isfinite(learner.theta).all()
    assert learner.result is not None
    assert learner.result.loss_after < learner.result.loss_before
    # The model is identified from all of these.
    assert learner.mpc.values["model.l"] == pytest.approx(1.0, rel=0.02)
    actions, _ = learner.policy.predict(observed(np.array([[0.1, 0.0], [-0.1, 0.0], [3.0, 1.0]])))
    assert (np.abs(actions) <= 2.0).all()
    assert actions[0, 0] < 0.0 < actions[1, 0] or name == "everything terminates"


@pytest.mark.slow
def test_mixed_units_constant_columns_and_a_parameter_that_does_not_matter() -> None:
    """A double integrator in um and 1e5 m/s units, with a coordinate that never moves."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    scale = np.array([1e-3, 1e5, 1.0])
    step = np.diag([1.0, 0.95, 1.0]) + 0.1 * np.diag([1.0, 0.0], 1)
    gain = np.array([[0.0], [0.1], [0.0]])
    z = np.column_stack([rng.uniform(-1, 1, (600, 2)), np.full(600, 0.25)])
    u = rng.uniform(-1, 1, (600, 1)).astype(np.float32).astype(np.float64)
    costs = z[:, 0] ** 2 + 0.1 * z[:, 1] ** 2 + 0.1 * u[:, 0] ** 2
    table = TransitionTable.from_arrays(scale * z, u, costs, scale * (z @ step.T + u @ gain.T), np.zeros(600))
    model = Model(
        lambda x, u, p: np.diag(scale) @ (step @ (x / scale) + p["k"] * gain @ u),
        3,
        1,
        0.1,
        {"k": 0.5, "unused": 2.0},
        discrete=True,
    )
    weights = np.diag([1.0, 0.1, 1e-3]) / np.outer(scale, scale)
    mpc = MPC(model, QuadraticCost(weights, [[0.1]]), QuadraticCost(weights), 20, 0.95, [-1.0], [1.0])
    learner = OfflineMPCLearner(mpc, value_n_steps=500)
    learner.fit(table, show_progress=False)
    values = learner.mpc.values
    assert np.isfinite(learner.theta).all()
    assert values["model.k"] == pytest.approx(1.0, rel=1e-3)
    assert values["model.unused"] == pytest.approx(2.0, rel=0.1)
    actions, _ = learner.policy.predict(scale * np.array([[0.5, 0.0, 0.25], [-0.5, 0.0, 0.25]]))
    assert actions[0, 0] < 0.0 < actions[1, 0]
