"""Past inputs travel in SB3's state: what was applied, reset with an episode, and nothing hidden."""

from __future__ import annotations

from typing import Any

import casadi as ca
import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mpcoffline import MPC, Model, MPCPolicy, QuadraticCost, evaluate
from mpcoffline.control.predictors import D3rlpyPredictor
from mpcoffline.core.errors import InvalidArgumentError


def make_mpc(delay: Any = (2, 0), **changes: Any) -> MPC:
    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return 0.9 * x + ca.vertcat(u[0] + 0.2 * u[1], u[1])

    cost = QuadraticCost(np.eye(2), 0.1 * np.eye(2), u_ref=[0.1, 5.0], **changes)
    end = QuadraticCost(np.eye(2))
    return MPC(Model(step, 2, 2, 0.1, discrete=True, delay=delay), cost, end, 8, 0.95, [-1.0, -1.0], [1.0, 1.0])


def test_the_observation_stays_what_it_was() -> None:
    policy = MPCPolicy(make_mpc())
    assert policy.observation_space.shape == (2,)
    with pytest.raises(InvalidArgumentError, match=r"observation: expected shape \(2,\)"):
        policy.predict(np.zeros(4))


def test_applied_inputs_travel_and_decide() -> None:
    mpc = make_mpc()
    policy, y, state = MPCPolicy(mpc), np.array([2.0, -1.0]), None
    past = [mpc.usual_input] * 2
    for _ in range(6):
        action, state = policy.predict(y, state=state)
        z = np.concatenate([y, [past[-1][0], past[-2][0]]])
        np.testing.assert_allclose(action, policy.solver.solve(z).u0, atol=1e-5)
        past.append(action.astype(np.float64))
        np.testing.assert_array_equal(state[2][0], [past[-1][0], past[-2][0]])
        y = mpc.model(z, action)[:2]


def test_what_is_usual_is_asked_only_where_nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Finding it takes as long as a solve of a small problem."""
    policy, y = MPCPolicy(make_mpc()), np.array([2.0, -1.0])
    _, state = policy.predict(y)
    expected, asked, usual = policy.predict(y, state=state)[0], [], MPC.usual_input.fget

    def counted(mpc: MPC) -> Any:
        asked.append(mpc)
        return usual(mpc)

    monkeypatch.setattr(MPC, "usual_input", property(counted))
    np.testing.assert_array_equal(policy.predict(y, state=state)[0], expected)
    assert asked == []
    policy.predict(y, state=state, episode_start=True)
    assert len(asked) == 1


def test_noise_and_clipping_are_remembered() -> None:
    space = spaces.Box(np.float32([-0.05, -1.0]), np.float32([0.05, 1.0]))
    policy = MPCPolicy(make_mpc(1), action_space=space, exploration_noise=0.3, seed=3)
    actions, state = policy.predict(np.array([[2.0, 1.0], [-2.0, 3.0]]), deterministic=False)
    assert (np.abs(actions[:, 0]) <= 0.05).all()
    np.testing.assert_array_equal(state[2], actions)


def test_an_episode_begins_without_past_inputs() -> None:
    policy, y = MPCPolicy(make_mpc()), np.array([[2.0, -1.0], [2.0, -1.0]])
    cold, state = policy.predict(y)
    later, after = policy.predict(y, state=state, episode_start=np.array([True, False]))
    np.testing.assert_allclose(later[0], cold[0], atol=1e-6)
    assert np.abs(later[1] - cold[1]).max() > 1e-3
    np.testing.assert_array_equal(after[2][0], [later[0, 0], 0.1])  # u_ref is what was before
    np.testing.assert_array_equal(policy(y), cold)  # state=None again: nothing is hidden
    unknown = (state[0], state[1], np.full((2, 2), np.nan))
    np.testing.assert_allclose(policy.predict(y, state=unknown)[0], cold, atol=1e-6)


@pytest.mark.parametrize("kept", [slice(0, 2), slice(0, 1)])
def test_a_state_without_past_inputs_is_refused(kept: slice) -> None:
    policy = MPCPolicy(make_mpc())
    state = tuple(policy.predict(np.zeros(2))[1])
    with pytest.raises(InvalidArgumentError, match="states, inputs and past inputs"):
        policy.predict(np.zeros(2), state=state[kept])
    with pytest.raises(InvalidArgumentError, match="past inputs of shape"):
        policy.predict(np.zeros(2), state=(*state[:2], np.zeros((1, 3))))


def test_a_policy_without_memory_hands_on_two_arrays() -> None:
    assert len(MPCPolicy(make_mpc(0)).predict(np.zeros(2))[1]) == 2


def test_files_and_values(tmp_path: Any) -> None:
    policy = MPCPolicy(make_mpc([1, 2], D=np.eye(2)))
    policy.save(tmp_path / "p.zip")
    y = np.array([[1.0, 0.5]])
    np.testing.assert_array_equal(MPCPolicy.load(tmp_path / "p.zip").predict(y)[0], policy.predict(y)[0])
    action = policy.predict(y)[0]
    value = D3rlpyPredictor(policy).predict_value(y, action)
    np.testing.assert_allclose(value, -policy.solver.value(policy.mpc.state(y)), rtol=1e-5)


class Late(gym.Env[Any, Any]):
    """A chain that its input reaches after two steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.past, self.k = self.np_random.uniform(1.0, 3.0), [0.0, 0.0], 0
        return np.array([self.x]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        cost = self.x**2 + 0.1 * float(action[0]) ** 2
        self.past.append(float(action[0]))
        self.x, self.k = 1.1 * self.x + 0.5 * self.past.pop(0), self.k + 1
        return np.array([self.x]), -cost, False, self.k >= 30, {}


def test_in_closed_loop_a_policy_that_knows_the_dead_time_costs_less() -> None:
    """x+ = 1.1 x + 0.5 u[k-2]: with the inputs under way the loop settles, without it swings."""
    costs = []
    for delay in (0, 2):
        model = Model(lambda x, u, p: 1.1 * x + 0.5 * u, 1, 1, 0.1, discrete=True, delay=delay)
        cost = QuadraticCost([[1.0]], [[0.1]])
        mpc = MPC(model, cost, QuadraticCost([[5.0]]), 20, 1.0, [-1.0], [1.0])
        costs.append(evaluate(MPCPolicy(mpc), Late(), n_episodes=4, seed=0).cost.mean())
    assert costs[1] < 0.7 * costs[0]
