"""The vector twin equals the scalar environments bit for bit."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mpcoffline.envs import ENV_IDS

CASES = [(env_id, {}) for env_id in ENV_IDS] + [("mpcoffline/LinearTracking-v0", {"alpha": 0.5})]


def make_vec(env_id: str, n: int, **kwargs: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(env_id, n, vectorization_mode="vector_entry_point", **kwargs)


@pytest.mark.parametrize(("env_id", "kwargs"), CASES)
@pytest.mark.parametrize("n", [1, 3, 7])
def test_equals_the_scalar_environments_bitwise(env_id: str, kwargs: dict[str, Any], n: int) -> None:
    """Against Gymnasium's own SyncVectorEnv of scalar copies, across automatic resets."""
    twin = make_vec(env_id, n, **kwargs)
    scalar = gym.make_vec(env_id, n, vectorization_mode="sync", **kwargs)
    assert twin.metadata["autoreset_mode"] == scalar.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert twin.observation_space == scalar.observation_space
    assert twin.action_space == scalar.action_space
    (observed, info), (expected, expected_info) = twin.reset(seed=5), scalar.reset(seed=5)
    rng = np.random.default_rng(1)
    low, high = twin.single_action_space.low, twin.single_action_space.high
    for _ in range(340):
        np.testing.assert_array_equal(observed, expected, strict=True)
        for key in ("state", "is_success"):
            np.testing.assert_array_equal(info[key], expected_info[key], strict=True)
        action = rng.uniform(1.2 * low, 1.2 * high, (n, len(low))).astype(np.float32)
        observed, reward, terminated, truncated, info = twin.step(action)
        expected, expected_reward, expected_terminated, expected_truncated, expected_info = scalar.step(action)
        np.testing.assert_array_equal(reward, expected_reward, strict=True)
        np.testing.assert_array_equal(terminated, expected_terminated, strict=True)
        np.testing.assert_array_equal(truncated, expected_truncated, strict=True)
        np.testing.assert_array_equal(reward, -info["cost"])


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_ten_thousand_steps_bitwise(env_id: str) -> None:
    """10^4 steps of the physics, among 50 copies and alone."""
    twin, alone = make_vec(env_id, 50), gym.make(env_id).unwrapped
    twin.reset(seed=0)
    rng = np.random.default_rng(2)
    _, info = twin.reset(seed=1)
    for _ in range(200):
        state = info["state"]
        action = rng.uniform(
            twin.single_action_space.low, twin.single_action_space.high, (50, twin.action_space.shape[1])
        )
        _, _, _, truncated, info = twin.step(action)
        if truncated.any():
            _, info = twin.reset()
            continue
        for i in range(50):
            np.testing.assert_array_equal(info["state"][i], alone.next_state(state[i], action[i]), strict=True)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_start_states_and_seeds(env_id: str) -> None:
    twin = make_vec(env_id, 4)
    _, info = twin.reset(seed=3)
    states = info["state"]
    observed, again = twin.reset(options={"state": states[::-1]})
    np.testing.assert_array_equal(again["state"], states[::-1])
    np.testing.assert_array_equal(observed, twin.unwrapped.task.observe(states[::-1]))
    np.testing.assert_array_equal(twin.reset(seed=[3, 4, 5, 6])[1]["state"], states)
    assert (twin.reset()[1]["state"] != states).any()


def test_start_distribution_holds_for_automatic_resets() -> None:
    twin = make_vec("mpcoffline/PendulumSwingUp-v0", 5)
    twin.reset(seed=0, options={"start": "hanging"})
    for _ in range(101):
        _, _, _, _, info = twin.step(np.zeros((5, 1), np.float32))
    assert (np.pi - np.abs(info["state"][:, 0]) <= 0.2).all()


def test_bad_input_is_refused() -> None:
    twin = make_vec("mpcoffline/PendulumSwingUp-v0", 3)
    with pytest.raises(gym.error.ResetNeeded):
        twin.step(np.zeros((3, 1)))
    twin.reset(seed=0)
    with pytest.raises(ValueError, match=r"action: expected shape \(3, 1\), got \(1,\)"):
        twin.step(np.zeros(1))
    with pytest.raises(ValueError, match="action: expected finite numbers"):
        twin.step(np.full((3, 1), np.nan))
    with pytest.raises(ValueError, match="expected 3 rows, got 2"):
        twin.reset(options={"state": np.zeros((2, 2))})
    with pytest.raises(ValueError, match="expected at most one of"):
        twin.reset(options={"begin": "broad"})
    with pytest.raises(ValueError, match="seed: expected one, or 3, got 2"):
        twin.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="num_envs: expected a positive integer, got 0"):
        make_vec("mpcoffline/PendulumSwingUp-v0", 0)
