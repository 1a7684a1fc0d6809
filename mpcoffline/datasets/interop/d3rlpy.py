"""What d3rlpy needs to use the last transition of a truncated episode. Imported only where d3rlpy is installed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from d3rlpy.dataset import BasicTransitionPicker, Episode, Transition
from numpy.typing import NDArray


@dataclass(frozen=True)
class WholeEpisode(Episode):  # type: ignore[misc]
    """A d3rlpy episode that knows the observation after its last action.

    Attributes:
        last_observation: s_T, ``(ny,)``.
    """

    last_observation: NDArray[np.float32]

    @property
    def transition_count(self) -> int:
        """All of them, also without termination."""
        return int(self.size())


class LastTransitionPicker(BasicTransitionPicker):  # type: ignore[misc]
    """d3rlpy's picker, which also gives the last transition of a truncated :class:`WholeEpisode`."""

    def __call__(self, episode: Any, index: int) -> Transition:
        """The transition of an index; the last one's next action, which does not exist, is zero."""
        if episode.terminated or index < episode.size() - 1:
            return super().__call__(episode, index)
        return Transition(
            observation=episode.observations[index],
            action=episode.actions[index],
            reward=episode.rewards[index],
            next_observation=episode.last_observation,
            next_action=np.zeros_like(episode.actions[index]),
            terminal=0.0,
            interval=1,
            rewards_to_go=episode.rewards[index:],
        )
