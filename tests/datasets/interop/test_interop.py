"""Each other library runs for real on what it is given, and every transition is compared, one by one."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pendulum_data import PENDULUM, recorded, stored
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.interop.convert import to_d3rlpy, to_dict, to_sb3_replay_buffer, to_torchrl

LENGTH, EPISODES = 7, 5
N = LENGTH * EPISODES


@pytest.fixture
def dataset() -> Any:
    """Five episodes, of which the second and the fourth terminate."""
    return stored(episodes=recorded(LENGTH, EPISODES, terminate=True))


@pytest.fixture
def truth(dataset: Any) -> dict[str, NDArray[Any]]:
    """The transitions as the file has them, read without any of our code."""
    rows: dict[str, list[Any]] = {key: [] for key in ("s", "a", "r", "s_next", "terminated", "truncated", "id")}
    for episode in dataset.iterate_episodes():
        for k in range(len(episode.rewards)):
            rows["s"].append(episode.observations[k])
            rows["a"].append(episode.actions[k])
            rows["r"].append(np.float32(-episode.infos["cost"][k + 1, 0]))
            rows["s_next"].append(episode.observations[k + 1])
            rows["terminated"].append(episode.terminations[k])
            rows["truncated"].append(episode.truncations[k])
            rows["id"].append(episode.id)
    arrays = {key: np.array(values) for key, values in rows.items()}
    assert len(arrays["r"]) == N
    assert (arrays["r"] < 0.0).all()
    assert arrays["terminated"].sum() == 2
    assert arrays["truncated"].sum() == 3
    return arrays


def test_plain_arrays(dataset: Any, truth: dict[str, NDArray[Any]]) -> None:
    for given in (dataset, "test/set-v0", TransitionTable.from_minari(dataset)):
        found = to_dict(given)
        for key, name in (
            ("s", "observations"),
            ("a", "actions"),
            ("r", "rewards"),
            ("s_next", "next_observations"),
            ("terminated", "terminals"),
            ("truncated", "timeouts"),
            ("id", "episode_ids"),
        ):
            np.testing.assert_array_equal(found[name], truth[key])
        np.testing.assert_array_equal(found["costs"], -truth["r"])
        assert found["observations"].dtype == found["rewards"].dtype == np.float32
        assert all(array.base is None and array.flags.c_contiguous for array in found.values())


def test_sb3_learns_from_every_transition(dataset: Any, truth: dict[str, NDArray[Any]]) -> None:
    buffer = to_sb3_replay_buffer(dataset, device="cpu")
    assert buffer.size() == N
    samples = buffer._get_samples(np.arange(N))
    low, high = dataset.action_space.low, dataset.action_space.high
    for k in range(N):
        np.testing.assert_array_equal(samples.observations[k], truth["s"][k])
        scaled = samples.actions[k].numpy()
        np.testing.assert_allclose(low + 0.5 * (scaled + 1.0) * (high - low), truth["a"][k], atol=1e-6)
        assert samples.rewards[k].item() == truth["r"][k]
        np.testing.assert_array_equal(samples.next_observations[k], truth["s_next"][k])
        assert bool(samples.dones[k].item()) == truth["terminated"][k]
    np.testing.assert_array_equal(buffer.timeouts[:, 0] > 0.0, truth["truncated"])

    agent = SAC("MlpPolicy", gym.make(PENDULUM), policy_kwargs={"net_arch": [16]}, seed=0, device="cpu")
    agent.replay_buffer = buffer
    agent.set_logger(configure(None, []))
    before = [p.clone() for p in agent.critic.parameters()]
    agent.train(gradient_steps=5, batch_size=N)
    after = list(agent.critic.parameters())
    assert all(torch.isfinite(p).all() for p in after)
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_sb3_scales_as_its_agents_do(dataset: Any, truth: dict[str, NDArray[Any]]) -> None:
    agent = SAC("MlpPolicy", gym.make(PENDULUM), policy_kwargs={"net_arch": [4]}, device="cpu")
    buffer = to_sb3_replay_buffer(dataset)
    np.testing.assert_allclose(buffer.actions[:, 0], agent.policy.scale_action(truth["a"]), atol=1e-6)
    plain = to_sb3_replay_buffer(dataset, scale_actions=False)
    np.testing.assert_array_equal(plain.actions[:, 0], truth["a"])


def test_sb3_needs_spaces_that_fit(dataset: Any) -> None:
    table = TransitionTable.from_minari(dataset)
    with pytest.raises(InvalidArgumentError, match=r"observation_space: .* shape \(3,\).*A table does not"):
        to_sb3_replay_buffer(table)
    box = dataset.observation_space
    with pytest.raises(InvalidArgumentError, match=r"action_space: expected a Box of shape \(1,\)"):
        to_sb3_replay_buffer(table, observation_space=box, action_space=box)
    free = spaces.Box(-np.inf, np.inf, (1,))
    with pytest.raises(InvalidArgumentError, match="finite bounds"):
        to_sb3_replay_buffer(table, observation_space=box, action_space=free)
    assert to_sb3_replay_buffer(table, observation_space=box, action_space=free, scale_actions=False).size() == N


def test_gaps_are_truncations(dataset: Any) -> None:
    table = TransitionTable.from_minari(dataset)
    kept = np.delete(np.arange(N), [3, 17])
    gappy = TransitionTable(table.rows[kept], table.ny, table.nu, table.episode_ids[kept])
    timeouts = to_dict(gappy)["timeouts"]
    assert timeouts[2]
    assert timeouts[np.flatnonzero(kept == 16)[0]]
    assert timeouts.sum() == 3 + 2


def test_torchrl_stores_samples_and_learns(dataset: Any, truth: dict[str, NDArray[Any]]) -> None:
    pytest.importorskip("torchrl", reason='needs pip install "mpcoffline[interop]"')
    from tensordict.nn import TensorDictModule
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
    from torchrl.modules import ValueOperator
    from torchrl.objectives import DDPGLoss

    batch = to_torchrl(dataset)
    assert batch.batch_size == torch.Size([N])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(N), sampler=SamplerWithoutReplacement(shuffle=False), batch_size=N
    )
    buffer.extend(batch)
    sample = buffer.sample()
    for k in range(N):
        row = sample[k]
        np.testing.assert_array_equal(row["observation"], truth["s"][k])
        np.testing.assert_array_equal(row["action"], truth["a"][k])
        assert row["next", "reward"].item() == truth["r"][k]
        np.testing.assert_array_equal(row["next", "observation"], truth["s_next"][k])
        assert row["next", "terminated"].item() == truth["terminated"][k]
        assert row["next", "truncated"].item() == truth["truncated"][k]
        assert row["next", "done"].item() == (truth["terminated"][k] or truth["truncated"][k])
    actor = TensorDictModule(torch.nn.Linear(3, 1), in_keys=["observation"], out_keys=["action"])
    critic = ValueOperator(_Critic(), in_keys=["observation", "action"])
    loss = DDPGLoss(actor, critic)
    loss.make_value_estimator(gamma=0.9)
    value = loss(sample)["loss_value"]
    assert torch.isfinite(value)
    assert value.item() > 0.0


class _Critic(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(4, 1)

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        value: torch.Tensor = self.layer(torch.cat([observation, action], dim=-1))
        return value


@pytest.mark.interop
@pytest.mark.skipif(find_spec("d3rlpy") is None, reason="runs in an environment of its own: scripts/test_interop")
def test_d3rlpy_learns_from_every_transition(dataset: Any, truth: dict[str, NDArray[Any]]) -> None:
    import d3rlpy

    buffer = to_d3rlpy(dataset)
    assert buffer.transition_count == N
    assert buffer.size() == EPISODES
    found = [buffer.transition_picker(*buffer.buffer[k]) for k in range(N)]
    for k, row in enumerate(found):
        np.testing.assert_array_equal(row.observation, truth["s"][k])
        np.testing.assert_array_equal(row.action, truth["a"][k])
        assert row.reward.item() == truth["r"][k]
        assert row.terminal == truth["terminated"][k]
        next_observation = np.zeros(3) if truth["terminated"][k] else truth["s_next"][k]
        np.testing.assert_array_equal(row.next_observation, next_observation)
        assert row.interval == 1
    algorithm = d3rlpy.algos.SACConfig(batch_size=16).create(device="cpu:0")
    algorithm.build_with_dataset(buffer)
    for _ in range(3):
        metrics = algorithm.update(buffer.sample_transition_batch(16))
        assert all(np.isfinite(value) for value in metrics.values())
    assert algorithm.predict(truth["s"]).shape == (N, 1)


def test_a_missing_library_says_how_to_get_it(dataset: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for package, function in (("d3rlpy", to_d3rlpy), ("tensordict", to_torchrl)):
        for module in [name for name in sys.modules if name.split(".")[0] == package]:
            monkeypatch.setitem(sys.modules, module, None)
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(InvalidArgumentError, match=f"package {package}: .*pip install"):
            function(dataset)
