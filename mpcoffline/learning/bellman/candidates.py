"""MPCs that a fit knows by the way: each takes from the log a part of what the whole fit takes."""

from __future__ import annotations

import dataclasses
import logging

from mpcoffline.estimation import fit_residual, with_residual
from mpcoffline.learning.known_cost import as_logged
from mpcoffline.learning.stages import Known
from mpcoffline.mpc import MPC

from .stages import TerminalConfig, in_units_of, with_terminal_cost

_log = logging.getLogger(__name__)

_MISSED = 0.01  # of an increment, above which a residual is looked for


def candidates(known: Known, terminal: TerminalConfig) -> dict[str, MPC]:
    """The MPCs between MPC_1 and the whole fit, by name.

    * ``"identified"``: the identified model, all else as given;
    * ``"identified, farther"``: the same with horizon and discount of the whole fit;
    * ``"identified, V"``: the identified model, the given stage cost, and V as the terminal cost;
    * ``"fitted cost"``: model and stage cost of the whole fit, all else as given.

    What is the same as another is left out; so is V as terminal cost where V says nothing.

    Args:
        known: What is known at the end of the fit.
        terminal: How the terminal cost follows from V.
    """
    given, full = known.given, known.mpc
    if given is None or known.found is None:
        return {}
    model = known.found.model if "model" in known.groups else full.model
    own = given.replace(model=given.model.with_delay(full.model.delay))
    if known.cost is not None:
        own = own.replace(stage_cost=full.stage_cost)  # with the logged weights, where these were taken over
    plain = own.replace(model=model)
    found = {"identified": plain}
    farther = plain.replace(horizon=full.horizon, discount=full.discount)
    if farther != plain and (full.horizon, full.discount) != (given.horizon, given.discount):
        found["identified, farther"] = farther
    if known.cost is None:
        alike = in_units_of(farther, known.table)
        found["fitted cost"] = in_units_of(plain, known.table).replace(model=full.model, stage_cost=full.stage_cost)
        if terminal.method != "given" and known.value_function is not None:
            result = None if known.result is None else dataclasses.replace(known.result, potential=None)
            start = dataclasses.replace(known, mpc=alike, result=result)
            found["identified, V"] = with_terminal_cost(start, terminal).mpc
    return found


def with_learned_residual(known: Known, name: str, mpc: MPC) -> dict[str, MPC]:
    """A candidate whose model is the identified one, with a learned residual where held-out episodes ask for one.

    Args:
        known: What is known at the end of the fit.
        name: The candidate's name.
        mpc: The candidate.
    """
    found, learned = known.found, "model" in known.groups and known.residual_share is None
    if not learned or found is None or found.error_after < _MISSED or mpc.layout != known.mpc.layout:
        return {}
    mpc = mpc.replace(model=found.model)
    residual = fit_residual(mpc, as_logged(mpc, known.table, known.cost), known.seed)
    _log.info("%s", residual)
    return {f"{name}, residual": with_residual(mpc, residual)} if residual.taken else {}
