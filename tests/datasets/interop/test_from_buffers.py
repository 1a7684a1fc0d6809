"""Other libraries' buffers: objects of their layout built by hand, each transition compared one by one."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from foreign_data import Episode, assert_same, trajectories
from stable_baselines3.common.buffers import ReplayBuffer

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import from_d3rlpy, from_dict, from_sb3_replay_buffer, from_torchrl, to_dict


def flat(episodes: list[Episode], kind: str = "f4") -> dict[str, Any]:
    """As D4RL keeps them: rewards, ends of both kinds, an observation for each action."""
    ends = [np.arange(len(e.a)) == len(e.a) - 1 for e in episodes]
    arrays = {
        "observations": np.concatenate([e.s[:-1] for e in episodes]),
        "actions": np.concatenate([e.a for e in episodes]),
        "rewards": -np.concatenate([e.cost for e in episodes]),
        "terminals": np.concatenate([end & e.terminated for end, e in zip(ends, episodes, strict=True)]),
        "timeouts": np.concatenate([end & (not e.terminated) for end, e in zip(ends, episodes, strict=True)]),
    }
    return {k: v if v.dtype == np.bool_ else v.astype(kind) for k, v in arrays.items()}


def reached(episodes: list[Episode]) -> Any:
    return np.concatenate([e.s[1:] for e in episodes])


@pytest.mark.parametrize("kind", ["f4", ">f4", "f8"])
def test_flat_arrays(kind: str) -> None:
    episodes = trajectories()
    data = flat(episodes, kind)
    assert_same(from_dict(data | {"next_observations": reached(episodes)}), episodes)
    with pytest.warns(UserWarning, match="2 episodes terminated"):
        assert_same(from_dict(data), episodes, without_last=True)
    again = to_dict(from_dict(data | {"next_observations": reached(episodes)}))
    assert_same(from_dict(again), episodes)


def test_an_episode_may_be_unfinished_and_two_may_touch() -> None:
    """An episode that happens to begin where the one before was cut off is another one."""
    first, second = trajectories((3, 3), (False, False))
    second.s[0] = first.s[-1]
    data = flat([first, second]) | {"next_observations": reached([first, second])}
    assert_same(from_dict(data), [first, second])
    data["timeouts"] = data["timeouts"] & (np.arange(6) < 5)
    assert_same(from_dict(data), [first, second])
    assert_same(
        from_dict({k: v for k, v in data.items() if k != "next_observations"}), [first, second], without_last=True
    )


def test_safety_costs_are_no_stage_costs() -> None:
    """DSRL keeps violated limits as costs beside the rewards."""
    episodes = trajectories()
    data = flat(episodes) | {"next_observations": reached(episodes)}
    data["costs"] = (data["observations"][:, 0] > 0.0).astype(np.float32)
    assert_same(from_dict(data), episodes)
    priced = from_dict(data, cost=-data["rewards"] + 8.0 * data["costs"])
    over = np.concatenate([e.s[:-1, 0] > 0.0 for e in episodes])
    np.testing.assert_array_equal(priced.costs, np.concatenate([e.cost for e in episodes]) + 8.0 * over)
    computed = from_dict(data, cost=lambda s, a: s[:, 0] ** 2 + a[:, 0] ** 2)
    s, a = data["observations"], data["actions"]
    np.testing.assert_allclose(computed.costs, s[:, 0] ** 2 + a[:, 0] ** 2, rtol=1e-6)


def test_an_open_file_is_a_mapping(tmp_path: Path) -> None:
    episodes = trajectories()
    with h5py.File(tmp_path / "d4rl.hdf5", "w") as file:
        for key, values in (flat(episodes) | {"next_observations": reached(episodes)}).items():
            file[key] = values
        file["infos/qpos"] = np.zeros(11)
    with h5py.File(tmp_path / "d4rl.hdf5", "r") as file:
        assert_same(from_dict(file), episodes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"timeouts": None}, "timeouts, episode_ids or next_observations, to tell episodes apart"),
        ({"rewards": None}, "no rewards among .* cost= says what is minimised"),
        ({"terminals": None}, "the arrays observations, actions, terminals, rewards, got no terminals"),
        ({"actions": np.arange(11)}, "expected a continuous action: .* got int64 .*, the numbers of discrete actions"),
        ({"actions": np.eye(11, dtype=bool)}, "expected a continuous action: .* got bool"),
        ({"observations": np.zeros((11, 8, 8, 3), np.uint8)}, r"uint8 of shape \(11, 8, 8, 3\), images"),
        ({"actions": np.zeros((4, 1))}, "actions: expected 11 rows, as in observations, got 4"),
        ({"rewards": np.zeros(4)}, r"costs: expected shape \(11,\)"),
        ({"rewards": np.full(11, np.nan)}, "episode 0, step 0: cost: .* got nan"),
        ({"terminals": np.full(11, 0.5)}, "terminals: expected 11 booleans"),
        ({"terminals": np.zeros(4)}, "terminals: expected 11 booleans"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*episodes terminated")
def test_arrays_that_are_refused(changes: dict[str, Any], message: str) -> None:
    data = {k: v for k, v in (flat(trajectories()) | changes).items() if v is not None}
    with pytest.raises((InvalidArgumentError, InvalidDataError), match=message):
        from_dict(data)


def of_d3rlpy(episodes: list[Episode]) -> SimpleNamespace:
    """T observations, T actions, rewards (T, 1): d3rlpy's ``Episode``, in what looks like its buffer."""
    kept = [
        SimpleNamespace(
            observations=e.s[:-1].astype("f4"),
            actions=e.a.astype("f4"),
            rewards=-e.cost[:, None].astype("f4"),
            terminated=e.terminated,
        )
        for e in episodes
    ]
    return SimpleNamespace(episodes=kept)


def test_a_buffer_of_d3rlpy() -> None:
    episodes = trajectories()
    buffer = of_d3rlpy(episodes)
    with pytest.warns(UserWarning, match="d3rlpy's buffer: 2 episodes terminated"):
        assert_same(from_d3rlpy(buffer), episodes, without_last=True)
    for each, e in zip(buffer.episodes, episodes, strict=True):
        each.last_observation = e.s[-1].astype("f4")
    assert_same(from_d3rlpy(buffer.episodes), episodes)
    priced = from_d3rlpy(buffer, cost=lambda s, a: 2.0 * s[:, 0] + a[:, 0])
    assert priced.costs[0] == 2.0 * episodes[0].s[0, 0] + episodes[0].a[0, 0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": np.array([[0], [1], [1], [0]], np.int32)}, "episode 0: actions: expected a continuous action"),
        ({"observations": np.zeros((4, 1, 84, 84), np.uint8)}, "images"),
        ({"observations": [np.zeros((4, 2)), np.zeros((4, 3))]}, "one array of observations, got 2 of them"),
        ({"rewards": np.full((4, 1), np.nan)}, "episode 0, step 0: cost"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*episodes terminated")
def test_episodes_of_d3rlpy_that_are_refused(changes: dict[str, Any], message: str) -> None:
    buffer = of_d3rlpy(trajectories())
    for key, value in changes.items():
        setattr(buffer.episodes[0], key, value)
    with pytest.raises(InvalidDataError, match=message):
        from_d3rlpy(buffer)


def dumped(path: Path, episodes: list[Episode], version: str = "2.1") -> Path:
    """A file as ``ReplayBuffer.dump`` writes it."""
    with h5py.File(path, "w") as file:
        file.create_dataset("columns", data=["observations", "actions", "rewards", "terminated"])
        file.create_dataset("num_episodes", data=len(episodes))
        for i, e in enumerate(of_d3rlpy(episodes).episodes):
            for key in ("observations", "actions", "rewards", "terminated"):
                file.create_dataset(f"{key}_{i}", data=getattr(e, key))
        file.create_dataset("version", data=version)
    return path


def test_files_of_d3rlpy(tmp_path: Path) -> None:
    episodes = trajectories()
    with pytest.warns(UserWarning, match="2 episodes terminated"):
        assert_same(from_d3rlpy(dumped(tmp_path / "a b é.h5", episodes)), episodes, without_last=True)
    old = flat(episodes)
    with h5py.File(tmp_path / "v1.h5", "w") as file:
        for key in ("observations", "actions", "rewards", "terminals"):
            file[key] = np.asarray(old[key], dtype="f4")
        file["episode_terminals"] = (old["terminals"] | old["timeouts"]).astype("f4")
        file["discrete_action"] = False
    with pytest.warns(UserWarning, match="2 episodes terminated"):
        assert_same(from_d3rlpy(str(tmp_path / "v1.h5")), episodes, without_last=True)


def test_files_of_d3rlpy_that_are_refused(tmp_path: Path) -> None:
    episodes = trajectories()
    with pytest.raises(FileFormatError, match=r"newer\.h5: expected a file of d3rlpy, version 2\.1, got version 3\.0"):
        from_d3rlpy(dumped(tmp_path / "newer.h5", episodes, "3.0"))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["numbers"] = np.arange(3)
    with pytest.raises(FileFormatError, match="version none"):
        from_d3rlpy(tmp_path / "other.h5")
    path = dumped(tmp_path / "less.h5", episodes)
    with h5py.File(path, "a") as file:
        del file["actions_1"]
    with pytest.raises(FileFormatError, match="an intact file of d3rlpy, got KeyError"):
        from_d3rlpy(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(FileFormatError, match=r"less\.h5"):
        from_d3rlpy(path)
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(FileFormatError, match=r"text\.h5"):
        from_d3rlpy(tmp_path / "text.h5")
    with pytest.raises(
        InvalidArgumentError, match="expected a ReplayBuffer of d3rlpy, its episodes, or a file, got int"
    ):
        from_d3rlpy(3)


def tensors(episodes: list[Episode]) -> Any:
    """As a collector of TorchRL gives them."""
    tensordict = pytest.importorskip("tensordict", reason='needs pip install "mpcoffline[interop]"')
    data = flat(episodes)
    n = len(data["rewards"])
    ended = torch.from_numpy(data["terminals"] | data["timeouts"])[:, None]
    return tensordict.TensorDict(
        {
            "observation": torch.from_numpy(data["observations"]),
            "action": torch.from_numpy(data["actions"]),
            "done": torch.zeros(n, 1, dtype=torch.bool),
            "terminated": torch.zeros(n, 1, dtype=torch.bool),
            "next": {
                "observation": torch.from_numpy(reached(episodes).astype("f4")),
                "reward": torch.from_numpy(data["rewards"])[:, None],
                "done": ended,
                "terminated": torch.from_numpy(data["terminals"])[:, None],
                "truncated": torch.from_numpy(data["timeouts"])[:, None],
            },
        },
        batch_size=[n],
    )


def test_tensors_of_torchrl() -> None:
    episodes = trajectories()
    batch = tensors(episodes)
    assert_same(from_torchrl(batch), episodes)
    batch["next", "reward"].requires_grad_()
    assert_same(from_torchrl(batch), episodes)
    priced = from_torchrl(batch.exclude(("next", "reward")), cost=lambda s, a: s[:, 1] - a[:, 0])
    assert priced.costs[1] == episodes[0].s[1, 1] - episodes[0].a[1, 0]


def test_batches_of_time_and_padding() -> None:
    """Two environments of six steps; the first one's episode ended after four, what follows is padding."""
    tensordict = pytest.importorskip("tensordict", reason='needs pip install "mpcoffline[interop]"')
    short, long = trajectories((4, 6), (True, False))
    one, two = tensors([short]), tensors([long])
    padded = tensordict.pad(one, [0, 2], value=0.0)
    batch = torch.stack([padded, two])
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[0, 4:] = False
    batch["collector", "mask"] = mask
    assert batch.batch_size == torch.Size([2, 6])
    assert_same(from_torchrl(batch), [short, long])


def test_a_ring_buffer_begins_anywhere() -> None:
    """Ten places for eleven transitions: the last one lies where the first one was."""
    torchrl = pytest.importorskip("torchrl.data", reason='needs pip install "mpcoffline[interop]"')
    episodes = trajectories()
    buffer = torchrl.TensorDictReplayBuffer(storage=torchrl.LazyTensorStorage(10), batch_size=2)
    buffer.extend(tensors(episodes)[:8])
    buffer.extend(tensors(episodes)[8:])
    first, second, third = episodes
    rest = Episode(first.s[1:], first.a[1:], first.cost[1:], terminated=False)
    end = Episode(third.s[5:], third.a[5:], third.cost[5:], terminated=True)
    third = Episode(third.s[:6], third.a[:5], third.cost[:5], terminated=False)
    assert_same(from_torchrl(buffer), [end, rest, second, third])


def test_tensors_that_are_refused() -> None:
    batch = tensors(trajectories())
    with pytest.raises(InvalidArgumentError, match=r"the entry 'state', got .*observation= and action= name others"):
        from_torchrl(batch, observation="state")
    with pytest.raises(InvalidArgumentError, match=r"the entry \('next', 'terminated'\)"):
        from_torchrl(batch.exclude(("next", "terminated")))
    batch["action"] = torch.nn.functional.one_hot(torch.arange(11))
    with pytest.raises(InvalidDataError, match=r"action: expected a continuous action: .* got int64"):
        from_torchrl(batch)
    for other in ({"observation": 1}, 3, [1, 2]):
        with pytest.raises(InvalidArgumentError, match="data: expected a TensorDict or a buffer of it"):
            from_torchrl(other)


@pytest.mark.parametrize("size", [40, 12])
def test_a_replay_buffer_of_sb3(size: int) -> None:
    """Two environments side by side, actions scaled as SB3's agents scale them, a buffer that runs over."""
    box, inputs = gym.spaces.Box(-99, 99, (2,)), gym.spaces.Box(np.array([0.0], "f4"), np.array([16.0], "f4"))
    pair = trajectories((4, 6), (False, True)), trajectories((7, 3), (True, False))[::-1]
    buffer = ReplayBuffer(size, box, inputs, device="cpu", n_envs=2)
    steps = [[(e, k) for e in each for k in range(len(e.a))] for each in pair]
    for now in zip(*steps, strict=True):
        ends = [k == len(e.a) - 1 for e, k in now]
        buffer.add(
            np.array([e.s[k] for e, k in now]),
            np.array([e.s[k + 1] for e, k in now]),
            np.array([2.0 * (e.a[k] - 0.0) / 16.0 - 1.0 for e, k in now]),
            np.array([-e.cost[k] for e, k in now]),
            np.array(ends),
            [{"TimeLimit.truncated": end and not e.terminated} for end, (e, _) in zip(ends, now, strict=True)],
        )
    kept = [list(each) for each in pair]
    if size == 12:  # six places for each of them: what was first is gone
        kept = [_tail(list(each), 6) for each in pair]
    assert_same(from_sb3_replay_buffer(buffer), [e for each in kept for e in each])
    plain = from_sb3_replay_buffer(buffer, scaled_actions=False)
    np.testing.assert_allclose(8.0 * (plain.actions + 1.0), from_sb3_replay_buffer(buffer).actions, rtol=1e-6)


def _tail(episodes: list[Episode], n: int) -> list[Episode]:
    """The last n transitions."""
    kept: list[Episode] = []
    for e in episodes[::-1]:
        count = min(n, len(e.a))
        n -= count
        if count:
            kept.insert(0, Episode(e.s[-count - 1 :], e.a[-count:], e.cost[-count:], e.terminated))
    return kept


def test_a_replay_buffer_that_is_refused() -> None:
    box = gym.spaces.Box(-1, 1, (2,))
    for other in (
        3,
        ReplayBuffer(4, box, box, optimize_memory_usage=True, handle_timeout_termination=False),
    ):
        with pytest.raises(InvalidArgumentError, match="a plain ReplayBuffer of Stable-Baselines3"):
            from_sb3_replay_buffer(other)
    buffer = ReplayBuffer(4, box, gym.spaces.Discrete(3))
    buffer.add(np.zeros((1, 2)), np.ones((1, 2)), np.ones((1, 1)), np.zeros(1), np.zeros(1), [{}])
    with pytest.raises(InvalidDataError, match="expected a continuous action"):
        from_sb3_replay_buffer(buffer)
    with pytest.raises(InvalidDataError, match="the replay buffer: expected at least one transition"):
        from_sb3_replay_buffer(ReplayBuffer(4, box, box))
