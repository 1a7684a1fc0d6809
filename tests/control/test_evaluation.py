"""evaluate() against an independent loop, in foreign environments, and with bad arguments."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DDPG

from mpcoffline.control.evaluation import evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.envs import ENV_IDS
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.sb3.model import MPCModel

Array = NDArray[np.float64]
PENDULUM = "mpcoffline/PendulumSwingUp-v0"


class Linear:
    """u = clip(K y), a policy without memory that notes how it was called."""

    def __init__(self, ny: int, nu: int, high: float) -> None:
        self.K, self.high = np.random.default_rng(0).normal(size=(nu, ny)), high
        self.calls: list[tuple[int, Any, list[bool], bool]] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any]:
        self.calls.append((len(observation), state, list(episode_start), deterministic))
        actions = np.clip(np.asarray(observation, np.float64) @ self.K.T, -self.high, self.high)
        return actions.astype(np.float32), (state or 0) + 1


def policy_for(env: gym.Env[Any, Any]) -> Linear:
    assert isinstance(env.action_space, spaces.Box)
    assert env.observation_space.shape is not None
    return Linear(env.observation_space.shape[0], env.action_space.shape[0], float(env.action_space.high[0]))


def looped(env_id: str, policy: Linear, seed: int, discount: float, **options: Any) -> tuple[float, float, bool, Array]:
    """One episode, step by step; its cost from the environment's own formula."""
    env = gym.make(env_id)
    observation, info = env.reset(seed=seed, options=options or None)
    plant: Any = env.unwrapped
    total = discounted = 0.0
    states = [info["state"]]
    for k in range(1_000):
        action = policy.predict(observation[None], episode_start=[k == 0])[0][0]
        cost = float(plant.cost(states[-1], plant.checked_action(action, action.shape)))
        observation, _, terminated, truncated, info = env.step(action)
        states.append(info["state"])
        total, discounted = total + cost, discounted + discount**k * cost
        if terminated or truncated:
            break
    return total, discounted, info["is_success"], np.array(states)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_figures_equal_those_of_a_plain_loop(env_id: str) -> None:
    env = gym.make(env_id)
    policy = policy_for(env)
    result = evaluate(policy, env, 3, seed=11, discount=0.95)
    for i in range(3):
        cost, discounted, success, states = looped(env_id, policy, 11 + i, 0.95)
        assert result.cost[i] == pytest.approx(cost, rel=1e-12)
        assert result.discounted_cost[i] == pytest.approx(discounted, rel=1e-12)
        assert result.success[i] == success
        np.testing.assert_array_equal(result.states[i], states)
    assert result.length.tolist() == [100] * 3
    assert [actions.shape for actions in result.actions] == [(100, env.action_space.shape[0])] * 3  # type: ignore[index]
    assert result.discount == 0.95


def test_success_is_that_of_the_last_state() -> None:
    """At rest upright, zero torque: success; from a little off it falls."""
    policy = policy_for(gym.make(PENDULUM))
    policy.K *= 0.0
    result = evaluate(policy, PENDULUM, 2, options=[{"state": [0.0, 0.0]}, {"state": [0.2, 0.0]}])
    assert result.success.tolist() == [True, False]
    assert result.cost[0] == 0.0


def test_an_id_an_environment_and_a_module_path_are_the_same() -> None:
    env = gym.make(PENDULUM)
    policy = policy_for(env)
    costs = [evaluate(policy, given, 2).cost for given in (PENDULUM, env, f"mpcoffline:{PENDULUM}")]
    np.testing.assert_array_equal(costs[0], costs[1])
    np.testing.assert_array_equal(costs[0], costs[2])


def test_an_environments_arguments_and_length_are_kept() -> None:
    results = {}
    for alpha in (0.0, 2.0):
        env = gym.make("mpcoffline/LinearTracking-v0", alpha=alpha, max_episode_steps=7)
        results[alpha] = evaluate(policy_for(env), env, 1)
        assert results[alpha].length.tolist() == [7]
    np.testing.assert_array_equal(results[0.0].states[0][0], results[2.0].states[0][0])
    assert results[0.0].cost[0] != results[2.0].cost[0]


def test_the_callers_environment_is_not_touched() -> None:
    env = gym.make(PENDULUM)
    before = env.reset(seed=3)[1]["state"]
    evaluate(policy_for(env), env, 1, seed=8)
    np.testing.assert_array_equal(env.unwrapped._state, before)  # type: ignore[attr-defined]


def test_seeds_give_the_starts() -> None:
    policy = policy_for(gym.make(PENDULUM))
    first, shifted = evaluate(policy, PENDULUM, 3, seed=4), evaluate(policy, PENDULUM, 3, seed=5)
    np.testing.assert_array_equal(first.cost[1:], shifted.cost[:2])
    assert len(np.unique(first.cost)) == 3
    np.testing.assert_array_equal(evaluate(policy, PENDULUM, 3, seed=4).cost, first.cost)


def test_options_for_all_or_one_an_episode() -> None:
    policy = policy_for(gym.make(PENDULUM))
    hanging = evaluate(policy, PENDULUM, 3, options={"start": "hanging"})
    for states in hanging.states:
        assert abs(abs(states[0, 0]) - np.pi) < 0.21
    starts = [[0.1, 0.0], [1.0, -1.0]]
    result = evaluate(policy, PENDULUM, 2, options=[{"state": start} for start in starts])
    np.testing.assert_array_equal([states[0] for states in result.states], starts)
    with pytest.raises(InvalidArgumentError, match="options: expected 3 entries, got 2"):
        evaluate(policy, PENDULUM, 3, options=[{}, {}])


def test_the_policy_sees_one_batch_a_step_and_its_own_state() -> None:
    policy = policy_for(gym.make(PENDULUM))
    evaluate(policy, PENDULUM, 4)
    assert len(policy.calls) == 100
    assert policy.calls[0] == (4, None, [True] * 4, True)
    assert policy.calls[1:] == [(4, k, [False] * 4, True) for k in range(1, 100)]


def test_batched_episodes_of_an_mpc_equal_single_ones() -> None:
    policy = MPCPolicy(nominal_mpc(PENDULUM, alpha=0.5, seed=0).replace(horizon=10))
    together = evaluate(policy, PENDULUM, 3, seed=2)
    alone = [float(evaluate(policy, PENDULUM, 1, seed=2 + i).cost[0]) for i in range(3)]
    np.testing.assert_allclose(together.cost, alone, rtol=1e-6)


# ---------------------------------------------------------------- other environments


def test_an_environment_that_gives_rewards_only() -> None:
    """Gymnasium's own pendulum: cost = -reward; the agent is SB3's."""
    agent = DDPG("MlpPolicy", "Pendulum-v1", seed=0, device="cpu")
    result = evaluate(agent, "Pendulum-v1", 2, seed=3)
    env = gym.make("Pendulum-v1")
    for i in range(2):
        observation, _ = env.reset(seed=3 + i)
        total, done = 0.0, False
        while not done:
            action, _ = agent.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, done = total - float(reward), terminated or truncated
        assert result.cost[i] == pytest.approx(total, rel=1e-6)
    assert result.success.tolist() == [False, False]
    assert result.states[0].shape == (201, 3)  # the observations, as there is no info["state"]


class Countdown(gym.Env[NDArray[Any], NDArray[Any]]):
    """Ends itself after as many steps as the seed says; an observation after the end is NaN."""

    observation_space = spaces.Box(-10, 10, (1,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    left = 0
    opened = 0
    closed = 0

    def __init__(self) -> None:
        type(self).opened += 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        if options:
            raise ValueError("no such option")
        self.left = seed or 1
        return np.array([1.0]), {}

    def step(self, action: NDArray[Any]) -> Any:
        self.left -= 1
        assert self.left >= 0, "stepped after its end"
        over = self.left == 0
        return np.array([np.nan if over else 1.0]), -1.0, over, False, {"is_success": over}

    def close(self) -> None:
        type(self).closed += 1


@pytest.fixture
def countdown() -> Iterator[str]:
    gym.register("test/Countdown-v0", entry_point=lambda: Countdown(), disable_env_checker=True)
    Countdown.opened = Countdown.closed = 0
    yield "test/Countdown-v0"
    gym.registry.pop("test/Countdown-v0")


def test_episodes_of_different_lengths(countdown: str) -> None:
    policy = Linear(1, 1, 1.0)
    policy.K[:] = 0.5
    result = evaluate(policy, countdown, 3, seed=2, discount=0.5)
    assert result.length.tolist() == [2, 3, 4]
    assert result.cost.tolist() == [2.0, 3.0, 4.0]
    assert result.discounted_cost.tolist() == [1.5, 1.75, 1.875]
    assert result.success.all()
    assert [len(states) for states in result.states] == [3, 4, 5]
    assert len(policy.calls) == 4
    assert Countdown.closed >= 3
    assert Countdown.closed == Countdown.opened


def test_a_policy_never_sees_what_comes_after_the_end(countdown: str) -> None:
    class Strict(Linear):
        def predict(self, observation: Any, *rest: Any, **more: Any) -> tuple[NDArray[Any], Any]:
            assert np.isfinite(observation).all()
            return super().predict(observation, *rest, **more)

    evaluate(Strict(1, 1, 1.0), countdown, 3, seed=1)


def test_what_fails_leaves_nothing_open_and_nobody_watching(countdown: str) -> None:
    policy, given = Linear(1, 1, 1.0), Countdown()
    with pytest.raises(ValueError, match="no such option"):
        evaluate(policy, given, 1, options={"a": 1})
    assert not {"step", "reset"} & vars(given).keys()
    Countdown.opened = 0
    with pytest.raises(ValueError, match="no such option"):
        evaluate(policy, countdown, 3, seed=1, options=[{}, {"a": 1}, {}])
    with pytest.raises(InvalidArgumentError, match="max_episode_steps"):
        evaluate(policy, countdown, 3, max_episode_steps=0)
    assert Countdown.closed == Countdown.opened > 0


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize("n", [0, -1])
def test_no_episodes_are_refused(n: int) -> None:
    with pytest.raises(InvalidArgumentError, match="n_episodes"):
        evaluate(Linear(3, 1, 2.0), PENDULUM, n)


@pytest.mark.parametrize("discount", [0.0, 1.1, -0.5, np.nan])
def test_bad_discounts_are_refused(discount: float) -> None:
    with pytest.raises(InvalidArgumentError, match=r"discount: expected a number in \(0, 1\]"):
        evaluate(Linear(3, 1, 2.0), PENDULUM, 1, discount=discount)


@pytest.mark.parametrize(
    ("env_id", "nearest"),
    [("mpcoffline/PendulumSwingUpp-v0", "PendulumSwingUp"), ("mpcoffline/PendulumSwingUp-v9", "v0")],
)
def test_unknown_environments_are_refused_with_the_nearest(env_id: str, nearest: str) -> None:
    with pytest.raises(UnknownIdError, match=f"environment id: .*{nearest}"):
        evaluate(Linear(3, 1, 2.0), env_id, 1)


def test_an_environment_without_a_spec_is_stepped_itself() -> None:
    assert evaluate(Linear(1, 1, 1.0), Countdown(), 3, seed=2).length.tolist() == [2, 3, 4]


def test_the_text_names_the_figures() -> None:
    result = evaluate(policy_for(gym.make(PENDULUM)), PENDULUM, 2)
    assert str(result).startswith(f"2 episodes: cost {result.cost.mean():.1f} +- ")
    assert f"discounted {result.discounted_cost.mean():.2f}, success 0%" in str(result)


def test_failed_solves_are_counted_and_said() -> None:
    """Of this evaluation alone, and of the policy in a model of SB3's too; what is no MPC has none."""
    env = gym.make(PENDULUM)
    policy = MPCPolicy(nominal_mpc(PENDULUM), "ddp", max_iterations=1)
    policy.predict([1.0, 0.0, 0.0])
    before = policy.solver_stats.n_failures
    result = evaluate(policy, env, 1)
    assert result.n_solves == result.length.sum()
    assert 0 < result.n_failures == policy.solver_stats.n_failures - before
    assert f"failed solves {result.n_failures} of {result.n_solves} (" in str(result)
    assert f"n_failures={result.n_failures}" in repr(result)
    assert evaluate(MPCModel(policy, env), env, 1).n_failures == result.n_failures
    assert "failed" not in str(evaluate(Linear(3, 1, 1.0), env, 1))


def test_a_vector_environment_is_refused_by_name() -> None:
    from stable_baselines3.common.env_util import make_vec_env

    env = make_vec_env("mpcoffline/PendulumSwingUp-v0", 1)
    with pytest.raises(InvalidArgumentError, match=r"DummyVecEnv.*evaluate_policy"):
        evaluate(MPCPolicy(nominal_mpc("mpcoffline/PendulumSwingUp-v0")), env, 2)  # type: ignore[arg-type]
