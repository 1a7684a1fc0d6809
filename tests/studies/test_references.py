"""Best known costs: upper bounds of the optimum, close to what dynamic programming finds."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from grid_dp import GridOptimum, simulate

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.envs.episode import EPISODE_STEPS
from mpcoffline.gallery.collection import starting_states
from mpcoffline.studies.references import best_known_costs, replay

PENDULUM, CARTPOLE = "mpcoffline/PendulumSwingUp-v0", "mpcoffline/CartPoleSwingUp-v0"


def test_a_replay_is_the_environment() -> None:
    env = gym.make(CARTPOLE)
    states = starting_states(env, ["broad", "hanging"], seed=3)
    actions = np.random.default_rng(0).uniform(-2, 2, size=(2, EPISODE_STEPS, 1))
    found = replay(CARTPOLE, states, actions, discount=0.9)
    for i, start in enumerate(("broad", "hanging")):
        _, info = env.reset(seed=3 + i, options={"start": start})
        np.testing.assert_array_equal(info["state"], states[i])
        total = 0.0
        for k in range(EPISODE_STEPS):
            _, _, _, _, info = env.step(actions[i, k].astype(np.float32))
            total += 0.9**k * info["cost"]
            np.testing.assert_array_equal(info["state"], found.states[i, k + 1])
        assert total == pytest.approx(found.cost[i], rel=1e-12)


def test_no_guess_is_cheaper() -> None:
    states = starting_states(gym.make(CARTPOLE), ["broad"] * 3, seed=0)
    guess = np.random.default_rng(1).uniform(-0.5, 0.5, size=(3, EPISODE_STEPS, 1))
    costs = best_known_costs("cartpole", states, [guess])
    assert (costs <= replay(CARTPOLE, states, guess).cost).all()
    assert (costs <= best_known_costs("cartpole", states)).all()


@pytest.mark.slow
def test_it_agrees_with_dynamic_programming() -> None:
    states = starting_states(gym.make(PENDULUM), ["broad"] * 8 + ["hanging"] * 4, seed=0)
    loops = simulate(GridOptimum(), states)
    costs = best_known_costs("pendulum", states, discount=0.9)
    # The grid's policy is optimal up to its resolution: it must not be much better, nor much worse.
    assert 0.97 < costs.mean() / loops.discounted_cost.mean() < 1.02


def test_other_tasks_are_refused() -> None:
    with pytest.raises(InvalidArgumentError, match=r"task: expected a plant with an equation of motion.*got 'linear'"):
        best_known_costs("linear", np.zeros((1, 4)))
    with pytest.raises(UnknownIdError, match="Did you mean 'pendulum'"):
        best_known_costs("pendulom", np.zeros((1, 2)))
