"""The verdict: is the learned controller better than MPC_1 on the models that the log leaves possible?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.simulation.closed_loop import Simulation

from .measures import LagCheck

Verdict = Literal["recommend", "try with care", "keep MPC_1"]

_WORST = 0.98  # the largest relative cost of any member that may be recommended
_DISAGREEMENT = 0.5  # what is asked for besides, per log(max / min) of the members
_CARE = 0.95  # relative cost with the identified model below which a trial is worth it
_BELOW = 0.1  # of the range of all mean costs
_MUCH_NOISE = 0.12  # of the states' spread
_FEW_ROWS = 500
_LITTLE_NOISE = 0.02  # where rows are few
_COST_R2 = 0.9

_UNDECIDED = "and {:.3g} times as much as on the best: models that disagree so much allow no recommendation"


@dataclass(frozen=True)
class Comparison:
    """Both controllers on the ensemble; entry 0 of each is the identified model.

    Attributes:
        nominal_cost: Mean cost of MPC_1 above the cheapest logged cost, ``(members,)``.
        learned_cost: The same of the learned MPC.
        nominal_success: Share of the starts from which MPC_1 ends at low cost, ``(members,)``.
        learned_success: The same of the learned MPC.
        lost: Share of the learned MPC's episodes that ran away.
        n_starts: Starts.
        n_steps: Steps of an episode.
        cost_r2: Share of the logged costs' variance that the cost used here explains.
    """

    nominal_cost: tuple[float, ...]
    learned_cost: tuple[float, ...]
    nominal_success: tuple[float, ...]
    learned_success: tuple[float, ...]
    lost: float
    n_starts: int
    n_steps: int
    cost_r2: float

    @classmethod
    def of(cls, nominal: Simulation, learned: Simulation, cost_r2: float) -> Comparison:
        """From the simulations of both."""
        # A controller may become cheaper than anything logged, and costs have no zero of their own: then ratios are
        # taken from a tenth of the range below the cheapest of both.
        low, high = (float(f([f(each.mean_cost) for each in (nominal, learned)])) for f in (np.min, np.max))
        low = 0.0 if low >= 0.0 else low - _BELOW * (high - low)
        floor = 1e-9 * max(float(nominal.mean_cost.max()), 1e-300)
        return cls(
            nominal_cost=tuple(float(v) for v in np.maximum(nominal.mean_cost - low, floor)),
            learned_cost=tuple(float(v) for v in np.maximum(learned.mean_cost - low, floor)),
            nominal_success=tuple(float(v) for v in nominal.success.mean(axis=1)),
            learned_success=tuple(float(v) for v in learned.success.mean(axis=1)),
            lost=float(learned.lost.mean()),
            n_starts=nominal.cost.shape[1],
            n_steps=nominal.actions.shape[1],
            cost_r2=cost_r2,
        )

    @property
    def ratios(self) -> tuple[float, ...]:
        """Cost of the learned MPC over that of MPC_1, a member each."""
        return tuple(b / a for a, b in zip(self.nominal_cost, self.learned_cost, strict=True))

    @property
    def spread(self) -> float:
        """How much the members disagree: log(max / min) of :attr:`ratios`."""
        return float(np.log(max(self.ratios) / min(self.ratios)))

    @property
    def limit(self) -> float:
        """The largest ratio of any member that may be recommended; 0, so none, where they disagree too much."""
        return max(0.0, min(_WORST, 1.0 - _DISAGREEMENT * self.spread))


def decide(comparison: Comparison, lag: LagCheck, noise: NoiseEstimate, n_rows: int) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict and why.

    Recommended is a learned MPC that costs less than MPC_1 on every member, by a margin that grows with their
    disagreement, and succeeds no less often. The rule cannot see what all members have in common: where inputs act
    late, where noise is strong, or rows are few and noisy, nothing is recommended.

    Args:
        comparison: Both controllers on the ensemble.
        lag: Whether inputs act late.
        noise: Measurement noise.
        n_rows: Transitions in the data.

    Returns:
        The verdict, and its reasons with what to do, the decisive one first.
    """
    c, withheld = comparison, _withheld(comparison, lag, noise, n_rows)
    worst, first = max(c.ratios), c.ratios[0]
    fewer = [learned < nominal for nominal, learned in zip(c.nominal_success, c.learned_success, strict=True)]
    if worst < c.limit and not any(fewer) and not withheld:
        least, most = 100.0 * (1.0 - worst), 100.0 * (1.0 - min(c.ratios))
        text = (
            f"Better on models of your data: {least:.0f} % to {most:.0f} % less cost than MPC_1 on all"
            f" {len(c.ratios)} of them. The plant may still differ: begin with supervised trials."
        )
        return "recommend", (text,)
    doubts = list(withheld)
    if any(fewer):
        doubts.append(
            f"On {sum(fewer)} of {len(fewer)} models fewer episodes end at low cost than with MPC_1: look at these"
            " closed loops before any trial."
        )
    if first >= _CARE:
        doubts.insert(0, f"{first:.2f} times the cost of MPC_1 on the identified model is no clear gain: keep MPC_1.")
        return "keep MPC_1", tuple(doubts)
    if worst >= c.limit:
        asked = f"where less than {c.limit:.2f} is asked for" if c.limit > 0.0 else _UNDECIDED.format(np.exp(c.spread))
        doubts.append(
            f"{first:.2f} times the cost of MPC_1 on the identified model, but {worst:.2f} times on the worst of"
            f" {len(c.ratios)}, {asked}: record more data where the models disagree."
        )
    return ("keep MPC_1" if fewer[0] else "try with care"), tuple(doubts)


def _withheld(comparison: Comparison, lag: LagCheck, noise: NoiseEstimate, n_rows: int) -> tuple[str, ...]:
    """Why nothing may be recommended, whatever the simulations say."""
    reasons = []
    if lag.found:
        reasons.append(
            f"Inputs act late (past ones move the state {100 * lag.share:.0f} % as much as present ones), which no"
            " model here knows: give the model their dead time (Model(..., delay=)), or the actuator's own state."
        )
    if noise.level > _MUCH_NOISE:
        reasons.append(
            f"Measurement noise is {100 * noise.level:.0f} % of the states' spread; all models share its bias: filter"
            " the measurements before logging."
        )
    elif noise.level > _LITTLE_NOISE and n_rows < _FEW_ROWS:
        reasons.append(f"Only {n_rows} rows, with {100 * noise.level:.0f} % measurement noise: record more.")
    if comparison.cost_r2 < _COST_R2:
        reasons.append(
            f"The logged cost is hardly a function of state and input (R2 {comparison.cost_r2:.2f}): check that the"
            " state holds all that the cost depends on."
        )
    if comparison.lost > 0.0:
        reasons.append(
            f"In {100 * comparison.lost:.0f} % of the simulated episodes the state ran away: restrict the inputs, or"
            " record data there."
        )
    return tuple(reasons)
