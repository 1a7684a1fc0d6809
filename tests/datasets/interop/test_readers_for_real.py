"""Readers of other tools' data on what the tools wrote: in an environment of its own, scripts/test_interop."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from foreign_data import Episode, assert_same, trajectories
from gymnasium import spaces

from mpcoffline.datasets import from_d3rlpy, from_do_mpc, from_episodes, from_torchrl, to_d3rlpy

A, B = np.array([[0.9, 0.35], [0.0, 1.1]]), np.array([[0.0813], [0.2]])


@pytest.mark.interop
def test_d3rlpy_fills_a_buffer_and_dumps_it(tmp_path: Path) -> None:
    d3rlpy = pytest.importorskip("d3rlpy")
    episodes = trajectories((4, 3, 6))  # d3rlpy's buffers do not take episodes of one step
    box = spaces.Box(-99.0, 99.0, (2,)), spaces.Box(-99.0, 99.0, (1,))
    buffer = d3rlpy.dataset.create_fifo_replay_buffer(limit=100, env=Spaces(*box))
    for episode in episodes:
        for s, a, cost in zip(episode.s[:-1].astype("f4"), episode.a.astype("f4"), episode.cost, strict=True):
            buffer.append(s, a, np.float32(-cost))
        buffer.clip_episode(episode.terminated)
    with (tmp_path / "dumped.h5").open("w+b") as file:
        buffer.dump(file)
    for given in (buffer, tmp_path / "dumped.h5"):
        with pytest.warns(UserWarning, match="2 episodes terminated"):
            assert_same(from_d3rlpy(given), episodes, without_last=True)


class Spaces(gym.Env[Any, Any]):
    """All that d3rlpy asks of an environment that it does not step."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.observation_space, self.action_space = observation_space, action_space


@pytest.mark.interop
def test_to_d3rlpy_and_back_nothing_is_lost() -> None:
    pytest.importorskip("d3rlpy")
    episodes = trajectories()
    table = from_episodes([e[:3] for e in episodes], terminated=[e.terminated for e in episodes])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(from_d3rlpy(to_d3rlpy(table)), episodes)


@pytest.mark.interop
def test_do_mpc_simulates_a_linear_plant(tmp_path: Path) -> None:
    """x+ = A x + B u and L = x'x + u^2 by hand, under inputs that are known; saved and loaded by do-mpc."""
    do_mpc = pytest.importorskip("do_mpc")
    model = do_mpc.model.Model("discrete")
    x, u = model.set_variable("_x", "x", (2, 1)), model.set_variable("_u", "u", (1, 1))
    model.set_rhs("x", A @ x + B @ u)
    model.set_meas("y", 2.0 * x, meas_noise=False)
    model.set_expression("L", x.T @ x + u**2)
    model.setup()
    simulator = do_mpc.simulator.Simulator(model)
    simulator.set_param(t_step=0.1)
    simulator.setup()
    rng = np.random.default_rng(0)
    states, inputs, costs = [], [], []
    for _ in range(2):
        state = rng.normal(size=(2, 1))
        simulator.x0, simulator.t0 = state, 0.0
        states.append([state[:, 0]])
        inputs.append(rng.uniform(-1.0, 1.0, (5, 1)))
        for action in inputs[-1]:
            simulator.make_step(action[:, None])
            states[-1].append(A @ states[-1][-1] + B @ action)
        costs.append([s @ s + a @ a for s, a in zip(states[-1][:-1], inputs[-1], strict=True)])
    do_mpc.data.save_results([simulator], "run", str(tmp_path) + "/")
    loaded = do_mpc.data.load_results(str(next(tmp_path.glob("*.pkl"))))["simulator"]
    for data in (simulator.data, loaded):
        table, seen = from_do_mpc(data, cost="L"), from_do_mpc(data, cost="L", observations=["_y"])
        assert (len(table), len(seen)) == (2 * 4, 2 * 4)
        for i in range(2):
            rows, path = slice(4 * i, 4 * i + 4), np.array(states[i])
            np.testing.assert_allclose(table.observations[rows], path[:4], rtol=1e-6)
            np.testing.assert_allclose(table.actions[rows], inputs[i][:4], rtol=1e-6)
            np.testing.assert_allclose(table.costs[rows], costs[i][:4], rtol=1e-6)
            np.testing.assert_allclose(table.next_observations[rows], path[1:5], rtol=1e-6)
            np.testing.assert_allclose(seen.observations[rows], 2.0 * path[1:5], rtol=1e-6)
            np.testing.assert_allclose(seen.actions[rows], inputs[i][1:], rtol=1e-6)
            np.testing.assert_allclose(seen.costs[rows], costs[i][1:], rtol=1e-6)
            np.testing.assert_allclose(seen.next_observations[rows], 2.0 * path[2:], rtol=1e-6)


@pytest.mark.interop
def test_mpcrl_monitors_episodes() -> None:
    """Its states are columns, and what it calls rewards are costs."""
    wrappers = pytest.importorskip("mpcrl.wrappers.envs")
    env = wrappers.MonitorEpisodes(gym.wrappers.TimeLimit(Linear(), max_episode_steps=4))
    rng = np.random.default_rng(0)
    expected = []
    for _ in range(2):
        observation, _ = env.reset()
        s, a = [observation[:, 0]], rng.uniform(-1.0, 1.0, (4, 1))
        for action in a:
            env.step(action)
            s.append(A @ s[-1] + B @ action)
        path = np.array(s)
        costs = (path[:-1] ** 2).sum(axis=1) + a[:, 0] ** 2
        expected.append(Episode(path, a, costs, terminated=False))
    table = from_episodes(zip(env.observations, env.actions, env.rewards, strict=True))
    rounded = [Episode(*(each.astype("f4").astype("f8") for each in e[:3]), terminated=False) for e in expected]
    assert_same(table, rounded)


class Linear(gym.Env[Any, Any]):
    """As mpcrl's examples write plants: columns, and the stage cost in place of a reward."""

    observation_space, action_space = spaces.Box(-9.0, 9.0, (2, 1)), spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = np.array([[0.0], [0.15]])
        return self.x, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        cost = float((self.x**2).sum() + np.asarray(action).item() ** 2)
        self.x = A @ self.x + B * np.asarray(action).item()
        return self.x, cost, False, False, {}


@pytest.mark.interop
def test_torchrl_rolls_out_an_environment() -> None:
    """The same inputs, step by step, in the same environment without TorchRL."""
    envs = pytest.importorskip("torchrl.envs")
    name = "mpcoffline/LinearTracking-v0"
    rollout = envs.GymWrapper(gym.make("mpcoffline:" + name)).rollout(6)
    table = from_torchrl(rollout)
    assert len(table) == 6
    env = gym.make(name)
    for k in range(6):
        env.reset(options={"state": rollout["observation"][k].numpy().astype("f8")})
        following, reward, *_ = env.step(rollout["action"][k].numpy())
        np.testing.assert_allclose(table.next_observations[k], following, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(table.costs[k], -float(reward), rtol=1e-5)
    assert not table.terminations.any()
    assert table.n_episodes == 1
