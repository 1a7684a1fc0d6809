"""Assembling one episode, apart from where it is stored."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.datasets.table.numbers import check_numbers

from .stage_cost import PlantInfo

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

PIECE_STEPS = 4096  # of a long episode: what a killed process loses at most of the one under way


class EpisodeBuilder:
    """Collects the transitions of one episode in memory.

    Args:
        observation: First observation ``(ny,)``.
        info: The reset's info.
        rule: What is taken from infos, the same for all episodes of a recording.

    Attributes:
        returned: The sum of the rewards in the pieces that were taken.

    Raises:
        InvalidDataError: For an observation that is not an array of numbers.
    """

    returned: float

    def __init__(self, observation: ArrayLike, info: Mapping[str, Any], rule: PlantInfo) -> None:
        self._rule = rule
        self._observations = [np.array(check_numbers("first observation", observation))]
        self._actions: list[NDArray[Any]] = []
        self._rewards: list[float] = []
        self._terminations: list[bool] = []
        self._truncations: list[bool] = []
        self._costs = [rule.first_cost(info)]
        self._states = [rule.state(info, reset=True)]
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
        self._observations = self._observations[-1:]
        self._costs, self._states = self._costs[-1:], self._states[-1:]
        self._actions, self._rewards, self._terminations, self._truncations = [], [], [], []
        return piece

    @property
    def last_info(self) -> dict[str, Any]:
        """What was kept of the info of the last observation, as the first of another episode."""
        state = self._states[-1]
        known = {} if math.isnan(self._costs[-1]) else {self._rule.key: self._costs[-1]}
        return known if state is None else known | {"state": state}

    @property
    def last_observation(self) -> NDArray[Any]:
        """The observation reached last ``(ny,)``."""
        return self._observations[-1]

    def add(
        self,
        action: ArrayLike,
        reward: float,
        next_observation: ArrayLike,
        *,
        terminated: bool,
        truncated: bool,
        info: Mapping[str, Any],
        given_reward: float | None = None,
    ) -> None:
        """Adds a transition.

        Args:
            action: Action ``(nu,)`` in the environment's units.
            reward: What the plant paid.
            next_observation: The observation reached ``(ny,)``, not that of the next episode.
            terminated: Whether the environment ended in a terminal state.
            truncated: Whether a time limit cut the episode.
            info: The step's info.
            given_reward: What a wrapper made of the reward.

        Raises:
            InvalidArgumentError: See :class:`PlantInfo`.
            InvalidDataError: See :class:`PlantInfo`.
        """
        self._costs.append(self._rule.cost(info, float(reward), given_reward))
        self._states.append(self._rule.state(info))
        self._actions.append(np.array(action))
        self._rewards.append(float(reward))
        self._observations.append(np.array(next_observation))
        self._terminations.append(terminated)
        self._truncations.append(truncated)

    def finish(self, *, truncate: bool = False) -> EpisodeBuffer:
        """The episode, or what comes after its pieces, as Minari stores it.

        Its reward is minus the cost where the info's cost counts.

        Args:
            truncate: Marks the last step as truncated unless it terminated.
        """
        from minari.data_collector import EpisodeBuffer

        truncations = list(self._truncations)
        if truncate and truncations and not self._terminations[-1]:
            truncations[-1] = True
        rewards = [-cost for cost in self._costs[1:]] if self._rule.has_cost else self._rewards
        return EpisodeBuffer(
            observations=np.stack(self._observations[self._taken > 0 :]),  # type: ignore[arg-type, unused-ignore]
            actions=np.stack(self._actions),  # type: ignore[arg-type, unused-ignore]
            rewards=np.array(rewards, dtype=np.float64),  # type: ignore[arg-type, unused-ignore]
            terminations=np.array(self._terminations),  # type: ignore[arg-type, unused-ignore]
            truncations=np.array(truncations),  # type: ignore[arg-type, unused-ignore]
            infos=self._stacked_infos(),
        )

    def _stacked_infos(self) -> dict[str, NDArray[np.float64]]:
        """The infos that count, ``cost (T+1, 1)`` and ``state (T+1, nx)``; an unknown first row is NaN."""
        stacked = {}
        rows = slice(int(self._taken > 0), None)
        if self._rule.has_cost:
            stacked["cost"] = np.array(self._costs[rows], dtype=np.float64)[:, None]
        if self._rule.has_state:
            missing = np.full_like(self._states[-1], np.nan, dtype=np.float64)
            stacked["state"] = np.stack([missing if state is None else state for state in self._states[rows]])
        return stacked
