"""DistilledPolicy: a small network wherever Stable-Baselines3 expects a policy."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.policies import BasePolicy

from mpcoffline.control.observations import checked_observation
from mpcoffline.core import limits
from mpcoffline.core.archive import (
    box_from_json,
    box_to_json,
    file_errors,
    plain,
    read_archive,
    with_ending,
    write_archive,
)
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.text import check_name, check_unit
from mpcoffline.core.types import Array
from mpcoffline.mpc.labels import Label

from .network import PolicyNetwork
from .report import DistillationReport


class DistilledPolicy(BasePolicy):
    """An explicit policy u = pi(z): a network that was fitted to an MPC by :func:`mpcoffline.control.distill`.

    It has the interface of an SB3 policy, solves nothing, and respects the input bounds exactly. Of limits on states it
    knows what the MPC's inputs have shown it, and guarantees nothing.

    Where the MPC's state z = [y, past inputs] holds past inputs (dead time, prices on changes), they are inputs of the
    network; the ones that were applied travel in ``state``, as they do with :class:`mpcoffline.MPCPolicy`. Else there
    is no state.

    Args:
        network: The network of z.
        observation_space: The environment's.
        action_space: The environment's.
        usual_memory: Past inputs before anything is known, ``(n_memory,)``.
        memory_sources: Where in [past inputs, u] the next value of each past input stands, ``(n_memory,)``.
        y_labels: What the coordinates of an observation are called.
        u_labels: What the inputs are called.
        memory_names: What the past inputs are called.
        report: What was measured.

    Attributes:
        network: The network.
        report: What was measured of it.

    Raises:
        InvalidArgumentError: For parts whose sizes do not fit.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        usual_memory: ArrayLike = (),
        memory_sources: Sequence[int] = (),
        y_labels: Sequence[Label],
        u_labels: Sequence[Label],
        memory_names: Sequence[str] = (),
        report: DistillationReport,
    ) -> None:
        usual = np.array(usual_memory, dtype=np.float64).ravel()
        sources = np.array(memory_sources, dtype=np.intp)
        ny, nu, m = len(y_labels), len(u_labels), len(usual)
        sizes = (network.nz, network.nu, *observation_space.shape, *action_space.shape, len(sources), len(memory_names))
        if sizes != (ny + m, nu, ny, nu, m, m):
            raise InvalidArgumentError("network", expected=f"sizes {(ny + m, nu, ny, nu, m, m)}", actual=str(sizes))
        if not np.isfinite(usual).all() or not all(0 <= source < m + nu for source in sources):
            raise InvalidArgumentError("memory", expected=f"numbers, and places below {m + nu}", actual=str(sources))
        super().__init__(observation_space, action_space)
        self.network, self.report = network, report
        self.usual_memory, self.memory_sources = usual, sources
        self.y_labels, self.u_labels, self.memory_names = tuple(y_labels), tuple(u_labels), tuple(memory_names)

    def extra_repr(self) -> str:
        """What it sees and sets, and its size."""
        sees, sets = (", ".join(map(str, each)) for each in (self.y_labels, self.u_labels))
        return f"{sees} -> {sets}; {self.network.multiply_adds} multiply-adds"

    @property
    def n_memory(self) -> int:
        """Number of past inputs that it sees."""
        return len(self.usual_memory)

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The inputs, and past inputs for the next call.

        Args:
            observation: ``(ny,)``, or ``(B, ny)`` for B environments; dictionaries are refused.
            state: What the previous call returned; None at the beginning.
            episode_start: ``(B,)`` booleans: environments that have just been reset have no past inputs.
            deterministic: Accepted for SB3; it never explores.

        Returns:
            Actions ``(nu,)`` or ``(B, nu)`` within the bounds and in the dtype of the action space, and the state: one
            array of past inputs ``(B, n_memory)``, or None where it sees none.

        Raises:
            InvalidArgumentError: For an observation of the wrong shape or with NaN, or a state of another policy or
                batch size.
        """
        given = checked_observation(observation, len(self.y_labels))
        z = np.atleast_2d(given)
        memory = self._memory(state, episode_start, len(z))
        inputs = self.network(z if memory is None else np.hstack([z, memory]))
        space = self.action_space
        assert isinstance(space, spaces.Box)  # noqa: S101 -- of its construction; narrows the type
        actions = np.clip(inputs.astype(space.dtype), space.low, space.high)
        answer = actions[0] if given.ndim == 1 else actions
        if memory is None:
            return answer, None
        every = np.hstack([memory, actions.astype(np.float64)])
        return answer, (every[:, self.memory_sources],)

    def _memory(self, state: tuple[NDArray[Any], ...] | None, episode_start: ArrayLike | None, n: int) -> Array | None:
        """The past inputs ``(n, n_memory)``; None where there are none."""
        if not self.n_memory:
            return None
        usual = np.tile(self.usual_memory, (n, 1))
        if state is None:
            return usual
        shapes = [np.shape(each) for each in state]
        if shapes != [usual.shape]:
            raise InvalidArgumentError(
                "state", expected=f"what predict returned: past inputs {usual.shape}", actual=f"arrays of {shapes}"
            )
        started = np.zeros(n, dtype=bool) if episode_start is None else np.asarray(episode_start, dtype=bool)
        if started.shape not in ((), (n,)):
            raise InvalidArgumentError("episode_start", expected=f"shape ({n},)", actual=f"shape {started.shape}")
        memory = np.asarray(state[0], dtype=np.float64)
        return np.where(np.broadcast_to(started, (n,))[:, None], usual, memory)

    def _predict(self, observation: torch.Tensor | dict[str, torch.Tensor], deterministic: bool = True) -> torch.Tensor:
        if isinstance(observation, dict):
            raise InvalidArgumentError("observation", expected="a tensor", actual="a dictionary")
        actions, _ = self.predict(observation.detach().cpu().numpy())
        return torch.as_tensor(actions, device=observation.device)

    def forward(self, observation: ArrayLike | torch.Tensor, deterministic: bool = True) -> NDArray[Any] | torch.Tensor:
        """Actions ``(B, nu)`` of observations ``(B, ny)``, or of one, at the beginning: what ``policy(y)`` returns."""
        if isinstance(observation, torch.Tensor):
            return self._predict(observation)
        return self.predict(observation)[0]

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the policy to a zip of JSON and arrays (no pickle).

        Raises:
            StorageError: If the disk or the file system refuses.
        """
        observation_space, action_space = self.observation_space, self.action_space
        assert isinstance(observation_space, spaces.Box)  # noqa: S101 -- of its construction; narrows the type
        assert isinstance(action_space, spaces.Box)  # noqa: S101
        document = {
            "observation_space": box_to_json(observation_space),
            "action_space": box_to_json(action_space),
            "usual_memory": self.usual_memory.tolist(),
            "memory_sources": self.memory_sources.tolist(),
            "memory_names": list(self.memory_names),
            "y_labels": [list(label) for label in self.y_labels],
            "u_labels": [list(label) for label in self.u_labels],
            "report": plain(self.report.to_json()),
        }
        write_archive(path, "distilled", document, self.network.to_arrays())

    @classmethod
    def load(cls, path: str | PathLike[str], device: torch.device | str = "auto") -> Self:
        """Reads what :meth:`save` wrote.

        Args:
            path: The file, with or without ``.zip``.
            device: Accepted for SB3; the network is evaluated on the CPU.

        Raises:
            FileFormatError: If the file is damaged, foreign or of another version.
        """
        path = with_ending(path)
        document, arrays = read_archive(path, "distilled")
        with file_errors(path):
            return cls(
                PolicyNetwork.from_arrays(arrays),
                box_from_json(document["observation_space"]),
                box_from_json(document["action_space"]),
                usual_memory=[float(value) for value in document["usual_memory"]],
                memory_sources=_places(document["memory_sources"]),
                y_labels=_labels(document["y_labels"]),
                u_labels=_labels(document["u_labels"]),
                memory_names=[check_name("memory name", name) for name in document["memory_names"]],
                report=DistillationReport.from_json(document["report"]),
            )


def _labels(given: Sequence[Any]) -> list[Label]:
    """Names and units out of a file."""
    check_limit("labels", "of them", len(given), limits.STATES)
    return [
        Label(check_name("name", name, error=FileFormatError), check_unit("unit", unit, error=FileFormatError))
        for name, unit in given
    ]


def _places(given: Sequence[Any]) -> list[int]:
    """Whole numbers out of a file."""
    if not all(type(place) is int for place in given):
        raise FileFormatError("memory_sources", expected="whole numbers", actual=str(given)[:200])
    return list(given)
