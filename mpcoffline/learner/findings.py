"""What a fit found of plant and costs beside the parameters, in sentences."""

from __future__ import annotations

from mpcoffline.learning import FitResult
from mpcoffline.mpc import MPC


def findings(given: MPC, learned: MPC, result: FitResult | None) -> tuple[str, ...]:
    """Each is a sentence; none is there for what is as it was given.

    Args:
        given: MPC_1.
        learned: The learned MPC.
        result: What the fit left.
    """
    found = []
    if result is not None and result.cost is not None:
        kept = "the given stage and terminal cost stay" if result.cost.constant else "the stage cost is not learned"
        found.append(f"Logged cost: {result.cost}; {kept}.")
    if result is not None and result.limits is not None:
        scale, logged = result.limits
        seen = "the logged costs contain them" if logged else "they were added to the logged costs"
        unit = "" if scale == 1.0 else f", times {scale:.4g}"
        found.append(f"Prices of soft limits: V has learned them, {seen}{unit}.")
    if learned.model.delay != given.model.delay:
        found.append(f"Dead time: {list(learned.layout.delay)} steps, found in the log.")
    if learned.applied_before is not None and given.applied_before is None:
        applied = ", ".join(f"{value:.4g}" for value in learned.usual_input)
        found.append(f"Before an episode, inputs of [{applied}] count as applied, as the log's first rows say.")
    if learned.model.scheme is not None and learned.model.scheme != given.model.scheme:
        found.append(f"Integrator: {learned.model.scheme}, chosen from the log.")
    if result is not None and result.residual_share is not None:
        found.append(f"Learned residual: explains {result.residual_share:.0%} of what the identified model missed.")
    return tuple(found)
