"""How far inputs travel from step to step: in the log, and by MPC_1 and the proposal in closed loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import rows_before
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.simulation.episodes import Episodes

_MUCH = 3.0  # times what it travels in the log
_LEAST = 0.005  # of its range, a step: less wears nothing out


@dataclass(frozen=True)
class Travel:
    """How far an input travels: the mean size of its change from a step to the next.

    Attributes:
        name: Of the input.
        shares: Of its range, in the log, by MPC_1 and by the proposal; NaN for a log without two steps in a row.
        held: Whether a price on changes of the inputs or a rate limit holds it back.
    """

    name: str
    shares: tuple[float, float, float]
    held: bool

    @property
    def much(self) -> bool:
        """Whether the proposal moves it much more than the log has seen, and nobody has priced that."""
        logged, _, proposed = self.shares
        return not self.held and proposed > max(_MUCH * logged, _LEAST)  # False for NaN


def travels(mpc: MPC, table: TransitionTable, first: Episodes, proposal: Episodes) -> tuple[Travel, ...]:
    """How far each input travels.

    Args:
        mpc: The MPC that was given: its bounds are the inputs' range, what was logged where they are infinite.
        table: The transitions as they were logged.
        first: What MPC_1 does, on models of the log and with its measurement noise.
        proposal: What the controller does that is judged.

    Returns:
        One an input.
    """
    logged = np.asarray(table.actions, dtype=np.float64)
    goes_on = rows_before(table)[1:] > 0
    runs = (np.diff(logged, axis=0)[goes_on], *(_changes(each) for each in (first, proposal)))
    span = np.asarray(mpc.action_high, dtype=np.float64) - np.asarray(mpc.action_low)
    span = np.where(np.isfinite(span), span, np.ptp(logged, axis=0))
    span = np.where(span > 0.0, span, np.inf)
    means = [np.abs(run).mean(axis=0) / span if len(run) else np.full(len(span), np.nan) for run in runs]
    limits = mpc.constraints if isinstance(mpc.constraints, tuple) else ()
    held = any(getattr(each, "uses_previous", False) for each in (mpc.stage_cost, *limits))
    return tuple(
        Travel(label.name, (float(log), float(one), float(other)), held)
        for label, log, one, other in zip(mpc.layout.u_labels, *means, strict=True)
    )


def _changes(episodes: Episodes) -> Array:
    """From step to step, with the first model, ``(changes, nu)``."""
    return np.asarray(np.diff(episodes.actions, axis=1).reshape(-1, episodes.actions.shape[-1]))
