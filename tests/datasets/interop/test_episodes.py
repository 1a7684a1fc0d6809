"""Trajectories as arrays, as simulations leave them."""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from foreign_data import Episode, assert_same, trajectories

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import TransitionTable, dataset_from_table, from_episodes


def test_every_transition_is_read() -> None:
    episodes = trajectories()
    ends = [e.terminated for e in episodes]
    table = from_episodes([e[:3] for e in episodes], terminated=ends, names=["x [m]", "v [m/s]", "force [N]"])
    assert_same(table, episodes)
    assert table.names == ("x [m]", "v [m/s]", "force [N]")
    assert_same(from_episodes([e[:3] for e in episodes]), [e._replace(terminated=False) for e in episodes])


def test_without_the_last_observation_the_last_action_leads_nowhere() -> None:
    episodes = trajectories()
    cut = [(e.s[:-1], e.a, e.cost) for e in episodes]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(from_episodes(cut), [e._replace(terminated=False) for e in episodes], without_last=True)
    with pytest.warns(UserWarning, match="2 episodes terminated, .* what an end costs is not learned"):
        table = from_episodes(cut, terminated=[e.terminated for e in episodes])
    assert_same(table, episodes, without_last=True)


def test_a_simulation_by_casadi_and_one_by_acados() -> None:
    """x+ = x + 0.1 u, kept as columns of CasADi and as rows of acados: L is computed from what was read."""
    x, u = ca.DM([1.0, 2.0]), ca.DM([0.5])
    states, inputs = [x], []
    for _ in range(5):
        states.append(states[-1] + 0.1 * u)
        inputs.append(u)

    def cost(s: Any, a: Any) -> Any:
        return s[:, 0] ** 2 + 0.1 * a[:, 0] ** 2

    columns = from_episodes([(np.array(states), np.array(inputs))], cost=cost)
    rows = from_episodes([(ca.horzcat(*states).full().T, ca.horzcat(*inputs).full().T)], cost=cost)
    for table in (columns, rows):
        assert len(table) == 5
        np.testing.assert_allclose(table.observations[:, 0], 1.0 + 0.05 * np.arange(5), rtol=1e-6)
        np.testing.assert_allclose(table.costs, (1.0 + 0.05 * np.arange(5)) ** 2 + 0.025, rtol=1e-6)
    turned = ca.horzcat(*states).full()
    with pytest.raises(InvalidDataError, match="transpose what is one column a step, as in CasADi"):
        from_episodes([(turned, ca.horzcat(*inputs).full().T)], cost=cost)
    with pytest.warns(UserWarning, match="at most 1 steps, 6 observations and 5 actions .* transpose them"):
        from_episodes([(turned, ca.horzcat(*inputs).full())], cost=cost)


@pytest.mark.parametrize("kind", [">f8", ">f4", "<f4", "torch", "list"])
def test_numbers_of_any_kind(kind: str) -> None:
    def of(values: Any) -> Any:
        if kind == "torch":
            return torch.from_numpy(values)
        return values.tolist() if kind == "list" else values.astype(kind)

    episodes = [e._replace(terminated=False) for e in trajectories()]
    table = from_episodes([tuple(of(each) for each in e[:3]) for e in episodes])
    assert_same(table, episodes)
    assert table.rows.dtype == np.dtype(np.float32)
    assert table.rows.dtype.isnative


S, A, L = trajectories((3,), (False,))[0][:3]


@pytest.mark.parametrize(
    ("episode", "message"),
    [
        ((S, A), "episode 0: expected observations, actions and costs, got 2 arrays. cost= computes costs"),
        ((S, A[:1], L), r"episode 0: observations: expected 2 rows, with 1 actions, got 4, of shape \(4, 2\)"),
        ((S, A, L[:2]), r"episode 0: costs: expected shape \(3,\), got \(2,\)"),
        ((np.zeros((4, 8, 8, 3), np.uint8), A, L), r"uint8 of shape \(4, 8, 8, 3\), images\?"),
        ((np.zeros((4, 84, 1), np.uint8), A, L), r"uint8 of shape \(4, 84, 1\), images\?"),
        ((np.where(np.equal(S, S[2, 1]), np.nan, S), A, L), "episode 0, step 1: next observation 1: .* got nan"),
        ((S, A, L + np.inf), "episode 0, step 0: cost"),
        ((S, A, L > 0.0), "costs: expected an array of numbers, got an array of bool"),
        ((S, np.array(["a", "b", "c"]), L), "actions: expected an array of numbers"),
    ],
)
def test_what_is_no_trajectory(episode: Any, message: str) -> None:
    with pytest.raises((InvalidArgumentError, InvalidDataError), match=message):
        from_episodes([episode])


def test_episodes_that_do_not_fit_together() -> None:
    with pytest.raises(InvalidDataError, match="episode 1: expected 2 observations and 1 actions, as before, got 3"):
        from_episodes([(S, A, L), (np.zeros((4, 3)), A, L)])
    with pytest.raises(InvalidArgumentError, match="terminated: expected 1 values, got 2"):
        from_episodes([(S, A, L)], terminated=[True, False])
    with pytest.raises(InvalidDataError, match="an episode of two observations or more, got none"):
        from_episodes([])
    with pytest.raises(InvalidArgumentError, match="names of columns: expected 3"):
        from_episodes([(S, A, L)], names=["x"])


def test_a_table_becomes_a_data_set_and_comes_back() -> None:
    """With a gap in an episode, which begins a new one there, ends of both kinds, and names."""
    episodes = trajectories()
    table = from_episodes(
        [e[:3] for e in episodes], terminated=[e.terminated for e in episodes], names=["x", "v", "u [N]"]
    )
    rows = np.delete(np.arange(len(table)), 7)
    dataset = dataset_from_table("test/table-v0", table.take(rows), action_low=-10.0, action_high=10.0)
    assert dataset.total_episodes == 4
    found = TransitionTable.from_minari(dataset)
    first, second, third = episodes
    pieces = [
        first,
        second,
        Episode(third.s[:3], third.a[:2], third.cost[:2], terminated=False),
        Episode(third.s[3:], third.a[3:], third.cost[3:], terminated=True),
    ]
    assert_same(found, pieces)
    assert found.names == ("x", "v", "u [N]")
