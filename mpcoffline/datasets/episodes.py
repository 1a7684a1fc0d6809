"""Assembling one episode, apart from where it is stored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .checks import check_numbers

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

RECORDED_INFOS = ("cost", "state")

PIECE_STEPS = 4096  # of a long episode: what a killed process loses at most of the one under way


class EpisodeBuilder:
    """Collects the transitions of one episode in memory.

    Args:
        observation: First observation ``(ny,)``.
        info: The reset's info. Of the infos, ``"cost"`` and ``"state"`` are kept.

    Attributes:
        returned: The sum of the rewards in the pieces that were taken.

    Raises:
        InvalidDataError: For an observation that is not an array of numbers.
    """

    def __init__(self, observation: ArrayLike, info: Mapping[str, Any]) -> None:
        self._observations = [np.array(check_numbers("first observation", observation))]
        self._actions: list[NDArray[Any]] = []
        self._rewards: list[float] = []
        self._terminations: list[bool] = []
        self._truncations: list[bool] = []
        self._infos = [_kept(info)]
        self._taken = 0
        self.returned = 0.0

    def __len__(self) -> int:
        """Number of transitions."""
        return self._taken + len(self._rewards)

    @property
    def is_long(self) -> bool:
        """Whether a piece is to be taken before the next transition."""
        return len(self._rewards) >= PIECE_STEPS

    def take(self) -> EpisodeBuffer:
        """The transitions since the last piece, which are forgotten; without the row before them but in the first."""
        piece = self.finish()
        self._taken = len(self)
        self.returned += float(np.sum(piece.rewards))
        self._observations, self._infos = self._observations[-1:], self._infos[-1:]
        self._actions, self._rewards, self._terminations, self._truncations = [], [], [], []
        return piece

    @property
    def last_observation(self) -> NDArray[Any]:
        """The observation reached last ``(ny,)``."""
        return self._observations[-1]

    @property
    def last_info(self) -> dict[str, NDArray[np.float64]]:
        """What was kept of the info of the last observation."""
        return self._infos[-1]

    def add(
        self,
        action: ArrayLike,
        reward: float,
        next_observation: ArrayLike,
        *,
        terminated: bool,
        truncated: bool,
        info: Mapping[str, Any],
    ) -> None:
        """Adds a transition.

        Args:
            action: Action ``(nu,)`` in the environment's units.
            reward: Used where ``info`` has no ``"cost"``; there the reward recorded is -cost.
            next_observation: The observation reached ``(ny,)``, not that of the next episode.
            terminated: Whether the environment ended in a terminal state.
            truncated: Whether a time limit cut the episode.
            info: The step's info.
        """
        self._actions.append(np.array(action))
        self._rewards.append(-float(info["cost"]) if "cost" in info else float(reward))
        self._observations.append(np.array(next_observation))
        self._terminations.append(terminated)
        self._truncations.append(truncated)
        self._infos.append(_kept(info))

    def finish(self, *, truncate: bool = False) -> EpisodeBuffer:
        """The episode, or what comes after its pieces, as Minari stores it.

        Args:
            truncate: Marks the last step as truncated unless it terminated.
        """
        from minari.data_collector import EpisodeBuffer

        truncations = list(self._truncations)
        if truncate and truncations and not self._terminations[-1]:
            truncations[-1] = True
        return EpisodeBuffer(
            observations=np.stack(self._observations[self._taken > 0 :]),  # type: ignore[arg-type, unused-ignore]
            actions=np.stack(self._actions),  # type: ignore[arg-type, unused-ignore]
            rewards=np.array(self._rewards, dtype=np.float64),  # type: ignore[arg-type, unused-ignore]
            terminations=np.array(self._terminations),  # type: ignore[arg-type, unused-ignore]
            truncations=np.array(truncations),  # type: ignore[arg-type, unused-ignore]
            infos=self._stacked_infos(),
        )

    def _stacked_infos(self) -> dict[str, NDArray[np.float64]]:
        """The kept infos, ``(T+1, 1)`` and ``(T+1, nx)``; a missing row (an unknown reset) is NaN."""
        stacked = {}
        for key in RECORDED_INFOS:
            known = next((info[key] for info in reversed(self._infos) if key in info), None)
            if known is not None:
                missing = np.full_like(known, np.nan)
                stacked[key] = np.stack([info.get(key, missing) for info in self._infos[self._taken > 0 :]])
        return stacked


def _kept(info: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    return {key: np.atleast_1d(np.array(info[key], dtype=np.float64)) for key in RECORDED_INFOS if key in info}
