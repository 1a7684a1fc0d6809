"""Data sets for other offline-RL libraries, transition by transition: (s, a, r = -L, s+, terminated, truncated).

The loaders that the libraries bring for Minari lose data (d3rlpy 2.8 misaligns actions after the first episode and
drops the last transition of a truncated one, TorchRL 0.14 returns zeros); these keep every transition. What is cut
without terminating (a time limit, an unfinished episode, a gap that ``trim`` left) is truncated, never terminated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.hub.loading import load_dataset
from mpcoffline.datasets.table.transitions import TransitionTable

if TYPE_CHECKING:
    from minari import MinariDataset
    from stable_baselines3.common.buffers import ReplayBuffer

Data: TypeAlias = "TransitionTable | MinariDataset | str"


def to_dict(data: Data) -> dict[str, NDArray[Any]]:
    """The transitions as plain numpy arrays.

    Args:
        data: A table, a Minari data set, or the id of one.

    Returns:
        ``observations (n, ny)``, ``actions (n, nu)``, ``rewards (n,)`` = -cost, ``costs (n,)``,
        ``next_observations (n, ny)``, all float32, or float64 where that is too coarse; ``terminals (n,)`` and
        ``timeouts (n,)``, boolean: whether an episode terminated there, or ended without; ``episode_ids (n,)``, int64.
        All are copies.
    """
    table = TransitionTable.of(data)
    costs = table.costs.copy()
    return {
        "observations": table.observations.copy(),
        "actions": table.actions.copy(),
        "rewards": -costs,
        "costs": costs,
        "next_observations": table.next_observations.copy(),
        "terminals": table.terminations > 0.0,
        "timeouts": _timeouts(table),
        "episode_ids": np.array(table.episode_ids),
    }


def to_sb3_replay_buffer(
    data: Data,
    *,
    observation_space: spaces.Space[Any] | None = None,
    action_space: spaces.Space[Any] | None = None,
    scale_actions: bool = True,
    device: str = "auto",
) -> ReplayBuffer:
    """The transitions as a full Stable-Baselines3 replay buffer, so that an agent learns from data alone.

    Use it as ``agent.replay_buffer = buffer; agent.train(gradient_steps=..., batch_size=...)``.

    Args:
        data: A table, a Minari data set, or the id of one.
        observation_space: Space of the observations; by default the data set's. A table needs it.
        action_space: Space of the actions; by default the data set's. A table needs it.
        scale_actions: Whether actions are mapped from their bounds to [-1, 1], as SB3's agents keep them.
        device: Where SB3 puts the minibatches.

    Returns:
        A buffer of as many transitions; its samples have ``dones`` 1 where an episode terminated.

    Raises:
        InvalidArgumentError: For a table without the spaces, spaces of another shape, or unbounded actions to scale.
    """
    from stable_baselines3.common.buffers import ReplayBuffer

    if isinstance(data, str):
        data = load_dataset(data)
    table = TransitionTable.of(data)
    if not isinstance(data, TransitionTable):
        observation_space = observation_space or data.observation_space
        action_space = action_space or data.action_space
    for name, space, size in (
        ("observation_space", observation_space, table.ny),
        ("action_space", action_space, table.nu),
    ):
        if not isinstance(space, spaces.Box) or space.shape != (size,):
            raise InvalidArgumentError(
                name,
                expected=f"a Box of shape ({size},)",
                actual=str(space),
                hint="A table does not know its spaces: pass those of the environment." if space is None else "",
            )
    actions: NDArray[Any] = table.actions
    if scale_actions:
        actions = _scaled(actions, action_space)
    buffer = ReplayBuffer(
        len(table),
        observation_space,  # type: ignore[arg-type]
        action_space,  # type: ignore[arg-type]
        device=device,
        handle_timeout_termination=True,
    )
    terminated, timeouts = table.terminations, _timeouts(table).astype(np.float32)
    buffer.observations[:, 0], buffer.next_observations[:, 0] = table.observations, table.next_observations
    buffer.actions[:, 0], buffer.rewards[:, 0] = actions, -table.costs
    # SB3's own convention: done at any end, and the samples' dones are done and not timeout.
    buffer.dones[:, 0], buffer.timeouts[:, 0] = np.maximum(terminated, timeouts), timeouts
    buffer.pos, buffer.full = 0, True
    return buffer


def to_torchrl(data: Data) -> Any:
    """The transitions as a ``tensordict.TensorDict`` in TorchRL's layout.

    Use it as ``buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(td))); buffer.extend(td)``.

    Args:
        data: A table, a Minari data set, or the id of one.

    Returns:
        Batch size ``[n]``: ``observation (n, ny)``, ``action (n, nu)``, ``terminated``, ``truncated`` and ``done
        (n, 1)`` (all False: nothing follows an end) and, below ``next``, ``observation (n, ny)``, ``reward (n, 1)`` =
        -cost and the three flags.

    Raises:
        InvalidArgumentError: Where tensordict is not installed.
    """
    import torch

    try:
        from tensordict import TensorDict
    except ImportError as error:
        raise _missing("tensordict", 'pip install "mpcoffline[interop]"', error) from error

    def tensor(array: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.array(array))

    table = TransitionTable.of(data)
    terminated = tensor(table.terminations[:, None] > 0.0)
    truncated = tensor(_timeouts(table)[:, None])
    never = torch.zeros_like(terminated)
    return TensorDict(
        {
            "observation": tensor(table.observations),
            "action": tensor(table.actions),
            "terminated": never,
            "truncated": never.clone(),
            "done": never.clone(),
            "next": {
                "observation": tensor(table.next_observations),
                "reward": tensor(-table.costs[:, None]),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        batch_size=[len(table)],
    )


def to_d3rlpy(data: Data) -> Any:
    """The transitions as a ``d3rlpy.dataset.ReplayBuffer``, for d3rlpy's algorithms on transitions.

    An episode that is truncated has one transition less in d3rlpy than it has actions, since nothing follows its last
    action; the episodes here carry the last observation along, and the buffer's transition picker uses it. (Where a
    terminated episode ends, s+ is zero, as always in d3rlpy: nothing depends on it.) What d3rlpy writes to a file with
    ``dump`` is the plain form, without that last transition.

    Args:
        data: A table, a Minari data set, or the id of one.

    Raises:
        InvalidArgumentError: Where d3rlpy is not installed.
    """
    try:
        from d3rlpy.dataset import create_infinite_replay_buffer
    except ImportError as error:
        # d3rlpy asks for one old version of gymnasium, so that it cannot be an ordinary dependency.
        hint = "pip install --no-deps d3rlpy; pip install gym structlog dataclasses-json scikit-learn colorama tqdm"
        raise _missing("d3rlpy", hint, error) from error
    from .d3rlpy import LastTransitionPicker, WholeEpisode

    table = TransitionTable.of(data)
    ends = np.flatnonzero((table.terminations > 0.0) | _timeouts(table)) + 1
    starts = np.concatenate([[0], ends[:-1]])
    episodes = []
    for start, end in zip(starts, ends, strict=True):
        columns = table.columns(table.rows[start:end])
        episode = WholeEpisode(
            observations=columns.observations.copy(),
            actions=columns.actions.copy(),
            rewards=-columns.costs[:, None],
            terminated=bool(columns.terminations[-1] > 0.0),
            last_observation=columns.next_observations[-1].copy(),
        )
        episodes.append(episode)
    return create_infinite_replay_buffer(episodes=episodes, transition_picker=LastTransitionPicker())


def _timeouts(table: TransitionTable) -> NDArray[np.bool_]:
    """Where a run of rows ends without terminating, ``(n,)``: the next row does not go on from it."""
    follows = (table.episode_ids[1:] == table.episode_ids[:-1]) & table.goes_on()
    last = np.concatenate([~follows, [True]])
    return np.asarray(last & (table.terminations == 0.0))


def _scaled(actions: NDArray[Any], space: Any) -> NDArray[np.float32]:
    if not space.is_bounded():
        raise InvalidArgumentError(
            "action_space", expected="finite bounds to scale by", actual=str(space), hint="Pass scale_actions=False."
        )
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    return np.asarray(2.0 * (actions - low) / (high - low) - 1.0, dtype=np.float32)


def _missing(package: str, command: str, error: ImportError) -> InvalidArgumentError:
    return InvalidArgumentError(
        f"package {package}", expected="an installed one", actual=str(error), hint=f"Install it: {command}"
    )
