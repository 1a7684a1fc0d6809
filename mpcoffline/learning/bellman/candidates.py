"""MPCs that a fit knows by the way: each takes from the log a part of what the whole fit takes."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping

from mpcoffline.estimation import Residual, fit_residual, with_residual
from mpcoffline.learning.known_cost import as_logged
from mpcoffline.learning.stages import Known
from mpcoffline.mpc import MPC

from .stages import TerminalConfig, in_units_of, repriced_as_logged, with_terminal_cost

_log = logging.getLogger(__name__)

_MISSED = 0.01  # of an increment, above which a residual is looked for


def candidates(
    known: Known, terminal: TerminalConfig, *, fixed: bool = False, only_fitted: bool = False
) -> dict[str, MPC]:
    """The MPCs between MPC_1 and the whole fit, by name.

    * ``"identified"``: the identified model, all else as given;
    * ``"identified, farther"``: the same with horizon and discount of the whole fit;
    * ``"identified, V"``: the identified model, the given stage cost, and V as the terminal cost;
    * ``"fitted cost"``: model and stage cost of the whole fit, all else as given;
    * ``"logged cost"``: the same, where the log's costs are a regression exactly, with the terminal cost in their unit.

    What is the same as another is left out; so is V as terminal cost where V says nothing.

    Args:
        known: What is known at the end of the fit.
        terminal: How the terminal cost follows from V.
        fixed: Whether horizon or discount were asked for: then all have those of the whole fit.
        only_fitted: Whether a stage cost was asked for that is learned.
    """
    given, full = known.given, known.mpc
    if given is None or known.found is None:
        return {}
    if fixed:
        given = given.replace(horizon=full.horizon, discount=full.discount)
    model = known.found.model if "model" in known.groups else full.model
    own = given.replace(model=given.model.with_delay(full.model.delay), applied_before=full.applied_before)
    if known.cost is not None and not known.cost.regressed:
        own = own.replace(stage_cost=full.stage_cost)  # with the logged weights, where these were taken over
    plain = own.replace(model=model)
    farther = plain.replace(horizon=full.horizon, discount=full.discount)
    found = {"identified": plain, "identified, farther": farther}  # which may be the same
    if known.cost is not None:
        if known.cost.regressed:
            found["logged cost"] = in_units_of(plain, known.table).replace(stage_cost=full.stage_cost)
        return found
    alike = repriced_as_logged(in_units_of(plain, known.table), known)
    fitted = {"fitted cost": alike.replace(model=full.model, stage_cost=full.stage_cost)}
    if only_fitted:
        return fitted
    if terminal.method != "given" and known.value_function is not None:
        result = None if known.result is None else dataclasses.replace(known.result, potential=None)
        alike = repriced_as_logged(in_units_of(farther, known.table), known)
        start = dataclasses.replace(known, mpc=alike, result=result)
        fitted["identified, V"] = with_terminal_cost(start, terminal).mpc
    return found | fitted


def undiscounted(mpcs: Mapping[str, MPC]) -> dict[str, MPC]:
    """Candidates that plan for what they are judged by: the cost of their steps without a discount.

    A discount keeps V finite and small where little is known; to a plan of a given horizon it is of no use, and the
    cost of an episode is not discounted.
    """
    return {f"{name}, undiscounted": mpc.replace(discount=1.0) for name, mpc in mpcs.items() if mpc.discount < 1.0}


def with_learned_residual(known: Known, mpcs: Mapping[str, MPC]) -> dict[str, MPC]:
    """Candidates whose model is the identified one, with a learned residual where held-out episodes ask for one.

    Args:
        known: What is known at the end of the fit.
        mpcs: The candidates by name.
    """
    found, learned = known.found, "model" in known.groups and known.residual_share is None
    if not learned or found is None or found.error_after < _MISSED:
        return {}
    identified = known.mpc.replace(model=found.model)

    def fitted() -> Residual:
        residual = fit_residual(identified, as_logged(identified, known.table, known.cost), known.seed)
        _log.info("%s", residual)
        return residual

    residual = known.once("residual", fitted)
    alike = {name: mpc.replace(model=found.model) for name, mpc in mpcs.items() if mpc.layout == known.mpc.layout}
    return {f"{name}, residual": with_residual(mpc, residual) for name, mpc in alike.items()} if residual.taken else {}
