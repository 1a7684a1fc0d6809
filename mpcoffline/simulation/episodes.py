"""What acts in a simulation, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array


class Controller(Protocol):
    """What acts, as :class:`~mpcoffline.control.policy.MPCPolicy` does."""

    def predict(self, observation: Any, state: Any = None) -> tuple[NDArray[Any], Any]:
        """Inputs ``(B, nu)`` for observations ``(B, ny)``, or outputs, and what the next call wants to know."""


@dataclass(frozen=True)
class Episodes:
    """A controller in closed loop with each model from each start.

    Attributes:
        cost: ``(models, starts)``, as in :class:`~mpcoffline.simulation.trials.Trials`.
        second: Likewise.
        lost: Likewise.
        states: States with the first model, past inputs included, ``(starts, T + 1, nx)``.
        actions: Inputs with the first model, ``(starts, T, nu)``.
        states_kept: States with every model, ``(models, kept, T + 1, nx)``, of the first starts, as many as were asked.
        actions_kept: Inputs with every model, ``(models, kept, T, nu)``.
        least: What the cheapest step cost with each model, by either regression, ``(models,)``; an episode's end is a
            step, and one that has ended costs nothing.
        iterations: Of its solver, in all steps and episodes together; 0 for what has none.
    """

    cost: Array
    second: Array
    lost: NDArray[np.bool_]
    states: Array
    actions: Array
    states_kept: Array
    actions_kept: Array
    least: Array
    iterations: int = 0


def iterations_of(controller: Controller) -> int:
    """Those of a controller's solver so far; 0 where it has none."""
    stats = getattr(controller, "solver_stats", None)
    return 0 if stats is None else int(stats.iterations)
