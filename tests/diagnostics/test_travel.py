"""How far inputs travel, against sums by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import lq_plant
import numpy as np
import pytest

from mpcoffline import MPC, QuadraticCost, TransitionTable
from mpcoffline.diagnostics.travel import travels
from mpcoffline.simulation.episodes import Episodes

MPC_1 = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
SPAN = float(np.asarray(MPC_1.action_high)[0] - np.asarray(MPC_1.action_low)[0])


def log(inputs: list[list[float]]) -> TransitionTable:
    """Episodes of the plant under these inputs."""
    columns: dict[str, list[Any]] = {name: [] for name in ("s", "a", "s+", "end", "id")}
    for k, episode in enumerate(inputs):
        s = np.array([1.0, -1.0])
        for i, u in enumerate(episode):
            reached = lq_plant.A @ s + lq_plant.B @ np.array([u])
            row = s, [u], reached, i == len(episode) - 1, k
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value)
            s = reached
    return TransitionTable.from_arrays(
        observations=np.array(columns["s"]),
        actions=np.array(columns["a"]),
        costs=np.ones(len(columns["a"])),
        next_observations=np.array(columns["s+"]),
        terminations=np.zeros(len(columns["a"])),
        episode_ids=np.array(columns["id"]),
    )


def acting(*inputs: list[float]) -> Episodes:
    return cast("Episodes", SimpleNamespace(actions=np.array(inputs)[:, :, None]))


def test_means_of_changes_within_episodes() -> None:
    table = log([[0.0, 0.1, -0.1], [0.5, 0.5]])  # |changes| .1, .2, 0; not the .6 between episodes
    (found,) = travels(MPC_1, table, acting([0.0, 0.2], [0.2, 0.2]), acting([0.3, -0.3], [0.0, 0.0]))
    assert found.shares == pytest.approx(tuple(each / SPAN for each in (0.1, 0.1, 0.3)))
    assert not found.held


def test_a_price_on_changes_holds() -> None:
    priced: MPC = MPC_1.replace(stage_cost=QuadraticCost(lq_plant.W, lq_plant.R, D=[[0.1]]))
    (found,) = travels(priced, log([[0.0, 0.1]]), acting([0.0, 1.0]), acting([0.0, 1.0]))
    assert found.held
    assert not found.much


def test_episodes_of_one_step_tell_nothing() -> None:
    (found,) = travels(MPC_1, log([[0.0], [0.1]]), acting([0.0, 1.0]), acting([0.0, 1.0]))
    assert np.isnan(found.shares[0])
    assert not found.much
