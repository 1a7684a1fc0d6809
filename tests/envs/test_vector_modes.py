"""The vector twin against Gymnasium's SyncVectorEnv of scalar copies: noise, autoreset modes, options, pictures."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.envs import ENV_IDS
from mpcoffline.envs.pendulum_swing_up import PendulumSwingUpVectorEnv
from mpcoffline.envs.vector import ControlTaskVectorEnv

MODES = ("NextStep", "SameStep", "Disabled")
NOISE: dict[str, Any] = {"process_noise": 0.02, "measurement_noise": 0.05}
CASES = [
    (LINEAR, {"alpha": 0.5}),
    (PENDULUM, {"m": 1.2, "start": "hanging"}),
    (CARTPOLE, {"l": 0.4, "start": [-0.2, 0.2]}),
    *((env_id, NOISE) for env_id in ENV_IDS),
    (PENDULUM, {"process_noise": [0.0, 0.1]}),
    (CARTPOLE, {"measurement_noise": [0.1, 0.0, 0.1, 0.0]}),
]


def twin_of(env_id: str, n: int, **kwargs: Any) -> ControlTaskVectorEnv:
    twin = gym.make_vec(env_id, n, vectorization_mode="vector_entry_point", **kwargs)
    assert isinstance(twin, ControlTaskVectorEnv)
    return twin


def pair(env_id: str, n: int, mode: str, **kwargs: Any) -> tuple[ControlTaskVectorEnv, SyncVectorEnv]:
    """The twin and what it has to equal."""
    twin = twin_of(env_id, n, autoreset_mode=mode, **kwargs)
    scalar = gym.make_vec(env_id, n, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs)
    assert isinstance(scalar, SyncVectorEnv)
    assert twin.metadata["autoreset_mode"] == scalar.metadata["autoreset_mode"] == AutoresetMode(mode)
    return twin, scalar


def assert_same(ours: Any, theirs: Any) -> None:
    """Bit for bit, through Gymnasium's nested infos."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key in theirs:
            assert_same(ours[key], theirs[key])
    elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
        assert ours.shape == theirs.shape
        for a, b in zip(ours, theirs, strict=True):
            assert_same(a, b)
    elif isinstance(theirs, tuple):
        for a, b in zip(ours, theirs, strict=True):
            assert_same(a, b)
    elif theirs is None:
        assert ours is None
    else:
        np.testing.assert_array_equal(ours, theirs, strict=True)


def actions_of(env: ControlTaskVectorEnv, rng: np.random.Generator) -> NDArray[np.float32]:
    low, high = env.single_action_space.low, env.single_action_space.high  # type: ignore[attr-defined]
    return rng.uniform(1.2 * low, 1.2 * high, env.action_space.shape).astype(np.float32)


def run_both(twin: ControlTaskVectorEnv, scalar: SyncVectorEnv, steps: int) -> None:
    """Steps both and compares everything that they return; where nothing resets by itself, resets what has ended."""
    rng = np.random.default_rng(1)
    assert_same(twin.reset(seed=5), scalar.reset(seed=5))
    for _ in range(steps):
        actions = actions_of(twin, rng)
        ours = twin.step(actions)
        assert_same(ours, scalar.step(actions))
        if twin.metadata["autoreset_mode"] == AutoresetMode.DISABLED and ours[3].any():
            ended = ours[3]
            assert_same(twin.reset(options={"reset_mask": ended}), scalar.reset(options={"reset_mask": ended.copy()}))


@pytest.mark.parametrize(("env_id", "kwargs"), CASES)
@pytest.mark.parametrize("mode", MODES)
def test_equals_the_scalar_environments_bitwise(env_id: str, kwargs: dict[str, Any], mode: str) -> None:
    """Episodes of 30 steps, so that a block of noise ends within an episode, and one with a reset."""
    run_both(*pair(env_id, 3, mode, max_episode_steps=30, **kwargs), 130)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("kwargs", [{}, NOISE], ids=["exact", "noisy"])
def test_ten_thousand_steps_bitwise(env_id: str, kwargs: dict[str, Any]) -> None:
    """10^4 steps: 1,250 of eight copies, a dozen episodes each."""
    run_both(*pair(env_id, 8, "NextStep", **kwargs), 1_250)


@pytest.mark.parametrize("mode", MODES)
def test_copies_out_of_step_with_each_other(mode: str) -> None:
    """Some copies are reset in the middle of their episodes; from then on all end at other times."""
    twin, scalar = pair(PENDULUM, 4, mode, max_episode_steps=20, **NOISE)
    rng = np.random.default_rng(0)
    assert_same(twin.reset(seed=0), scalar.reset(seed=0))
    ended = np.zeros(4, dtype=bool)
    for k in range(150):
        mask = ended if mode == "Disabled" else np.zeros(4, dtype=bool)
        if k in (7, 12, 33):
            mask = mask | (rng.random(4) < 0.5)
        if mask.any():
            seed = [None, 9, None, 4] if k == 12 else None
            assert_same(
                twin.reset(seed=seed, options={"reset_mask": mask}),
                scalar.reset(seed=seed, options={"reset_mask": mask.copy()}),
            )
        actions = actions_of(twin, rng)
        ours = twin.step(actions)
        assert_same(ours, scalar.step(actions))
        ended = ours[3]


def test_options_for_all_copies_and_one_a_copy() -> None:
    twin = twin_of(PENDULUM, 3)
    scalar = [gym.make(PENDULUM) for _ in range(3)]
    each: list[dict[str, Any]] = [{"start": "hanging"}, {"state": [0.5, -1.0]}, {"low": -0.1, "high": [0.1, 0.2]}]
    _, info = twin.reset(seed=7, options=each)
    for i, env in enumerate(scalar):
        np.testing.assert_array_equal(info["state"][i], env.reset(seed=7 + i, options=each[i])[1]["state"])
    np.testing.assert_array_equal(twin.reset(options={"state": [0.5, -1.0]})[1]["state"], [[0.5, -1.0]] * 3)


def test_seeds_of_some_copies() -> None:
    twin, scalar = pair(PENDULUM, 3, "NextStep", **NOISE)
    for seed in ([1, 2, 3], None, [None, 8, None], 4):
        assert_same(twin.reset(seed=seed), scalar.reset(seed=seed))
        assert_same(twin.step(np.ones((3, 1), np.float32)), scalar.step(np.ones((3, 1), np.float32)))


def test_no_limit_of_the_episode() -> None:
    for length in (None, -1):
        twin = PendulumSwingUpVectorEnv(2, max_episode_steps=length)
        twin.reset(seed=0)
        assert not any(twin.step(np.zeros((2, 1)))[3].any() for _ in range(120))


def test_what_is_returned_is_the_callers() -> None:
    twin = twin_of(PENDULUM, 2, **NOISE)
    observation, info = twin.reset(seed=0)
    expected = twin_of(PENDULUM, 2, **NOISE)
    expected.reset(seed=0)
    for array in (observation, *info.values()):
        array[...] = 0
    assert_same(twin.step(np.ones((2, 1))), expected.step(np.ones((2, 1))))


def test_disabled_resets_are_asked_for() -> None:
    twin = twin_of(PENDULUM, 2, max_episode_steps=1, autoreset_mode=AutoresetMode.DISABLED)
    twin.reset(seed=0)
    twin.step(np.zeros((2, 1)))
    with pytest.raises(gym.error.ResetNeeded, match=r"got those of copies \[0 1\]"):
        twin.step(np.zeros((2, 1)))


def test_pictures_of_all_copies() -> None:
    twin = twin_of(CARTPOLE, 2, render_mode="rgb_array")
    scalar = gym.make(CARTPOLE, render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match="render"):
        twin.render()
    twin.reset(seed=3)
    scalar.reset(seed=4)
    for _ in range(5):
        twin.step(np.ones((2, 1), np.float32))
        scalar.step(np.ones(1, np.float32))
    frames = twin.render()
    assert frames is not None
    assert len(frames) == 2
    expected: Any = scalar.render()
    np.testing.assert_array_equal(frames[1], expected)
    assert (frames[0] != expected).any()
    twin.close()
    twin.close()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert twin_of(CARTPOLE, 2).render() is None


def test_frames_a_second_follow_the_task() -> None:
    assert [twin_of(env_id, 1).metadata["render_fps"] for env_id in ENV_IDS[:3]] == [10, 20, 20]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([{}, {}], "reset options: expected one, or 3, got 2"),
        ([{}, {"begin": 1}, {}], "at most one of"),
        ({"reset_mask": [1, 0, 1]}, "'reset_mask': expected 3 booleans"),
        ({"reset_mask": np.zeros(3, bool)}, "'reset_mask': expected 3 booleans, one of them true"),
        ({"reset_mask": np.ones(2, bool)}, "'reset_mask': expected 3 booleans"),
        ({"state": [4.0, 0.0]}, "'state': expected finite values"),
        ({"state": [[0.0], [0.0, 1.0], [0.0]]}, "'state': expected numbers of shape"),
        ({"state": np.zeros((3, 2)), "start": "broad"}, "at most one of"),
    ],
)
def test_bad_options(options: Any, message: str) -> None:
    twin = twin_of(PENDULUM, 3)
    twin.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        twin.reset(options=options)


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match=r"autoreset_mode: expected one of .*'SameStep'.*got 'Never'"):
        twin_of(PENDULUM, 2, autoreset_mode="Never")
    with pytest.raises(ValueError, match=r"render_mode: expected None or one of \('rgb_array',\), got 'human'"):
        twin_of(PENDULUM, 2, render_mode="human")
    with pytest.raises(gym.error.ResetNeeded, match="'reset_mask'"):
        twin_of(PENDULUM, 2).reset(options={"reset_mask": np.ones(2, bool)})
    twin = twin_of(PENDULUM, 2)
    with pytest.raises(ValueError, match="'state'"):
        twin.reset(options={"state": [9.0, 9.0]})
    with pytest.raises(gym.error.ResetNeeded):  # the refused reset was none
        twin.step(np.zeros((2, 1)))
