"""Controllers tried on the models of a log: the same starts, the same models, so that differences are paired."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array


class Controller(Protocol):
    """What acts, as :class:`~mpcoffline.control.policy.MPCPolicy` does."""

    def predict(self, observation: Any, state: Any = None) -> tuple[NDArray[Any], Any]:
        """Inputs ``(B, nu)`` for observations ``(B, ny)``, and what the next call wants to know."""


@dataclass(frozen=True)
class Trials:
    """Costs of controllers in closed loop with models of a log, ``(controllers, models, starts)``.

    Attributes:
        names: Of the controllers; the first one is ``"MPC_1"``.
        models: Names of the models; the first one is the identified one.
        votes: Which models predict the log well enough to be asked, ``(models,)``.
        cost: Undiscounted cost of each episode, in the unit of the logged costs; NaN where it was not tried.
        second: The same with another regression of the logged cost.
        lost: Whether the state ran away, or the episode ended as bad ones do.
        rows: The row of the log that each start is, ``(starts,)``.
        returns: What the log itself cost from there over as many steps, ``(starts,)``; NaN where it ends before.
        judged: The starts that had no part in the choice among the controllers, ``(starts,)``.
        n_steps: Length of an episode.
    """

    names: tuple[str, ...]
    models: tuple[str, ...]
    votes: NDArray[np.bool_]
    cost: Array
    second: Array
    lost: NDArray[np.bool_]
    rows: NDArray[np.intp]
    returns: Array
    judged: NDArray[np.bool_]
    n_steps: int

    def of(self, name: str) -> Array:
        """The costs of a controller, ``(models, starts)``."""
        return np.asarray(self.cost[self.names.index(name)])

    def joined(self, others: Sequence[Trials]) -> Trials:
        """With trials of further controllers on the same models from the same starts."""
        parts = [self, *others]
        return replace(
            self,
            names=tuple(name for part in parts for name in part.names),
            **{key: np.concatenate([getattr(part, key) for part in parts]) for key in ("cost", "second", "lost")},
        )
