"""How often limits are violated: in the log, and by MPC_1 and the proposal on the identified model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC, Penalty
from mpcoffline.simulation.episodes import Episodes
from mpcoffline.simulation.violations import TRIFLE, limit_functions, moved

from .verdict import Judgement

_SURE = 2.0  # standard errors
_LEAST = 0.005  # of the steps: a smaller difference is none


@dataclass(frozen=True)
class LimitCheck:
    """Violations of a limit along the horizon, by more than a thousandth of how far it moves.

    Limits are those of the MPC that was given, with its parameters; those at the end of the horizon are left out, as no
    episode ends there.

    Attributes:
        name: Of the constraint.
        kind: ``"hard"``, or its prices; and those that the proposal has, where they are others.
        shares: Of the steps of the log, of MPC_1's and of the proposal's that violate it.
        largest: The largest violation of each, 0 for none, in the unit of the element of h that has it.
        worse: Whether the proposal violates it in more steps than MPC_1, beyond two standard errors.
    """

    name: str
    kind: str
    shares: tuple[float, float, float]
    largest: tuple[float, float, float]
    worse: bool


def limit_checks(
    mpc: MPC, table: TransitionTable, first: Episodes, proposal: Episodes, learned: MPC | None = None
) -> tuple[LimitCheck, ...]:
    """Counts violations.

    Args:
        mpc: The MPC that was given, of whose limits they are.
        table: The log, in the MPC's states.
        first: What MPC_1 does.
        proposal: What the controller does that is judged.
        learned: The MPC that it is, of which hard limits may have become soft.
    """
    now = {} if learned is None else {limit.name: limit.soft for limit in limit_functions(learned)}
    columns = table.values()
    log = columns.observations[None], np.asarray(columns.actions, dtype=np.float64)[None]
    runs = [log, *((each.states[:, :-1], each.actions) for each in (first, proposal))]
    found = []
    for limit in limit_functions(mpc):
        name, soft, _ = limit
        elements = [limit.along(*run, mpc.theta) for run in runs]
        far = moved(np.concatenate([h.reshape(-1, h.shape[-1]) for h in elements]))
        violated = [(h > TRIFLE * far).any(axis=-1) for h in elements]
        shares = tuple(float(each.mean()) for each in violated)
        more = violated[2].mean(axis=1) - violated[1].mean(axis=1)
        error = more.std() / np.sqrt(len(more))
        largest = tuple(_largest(h, far) for h in elements)
        worse = bool(more.mean() > max(_SURE * error, _LEAST))
        kind = _kind(soft) if soft == now.get(name, soft) else f"{_kind(soft)}, handed out with {_kind(now[name])}"
        found.append(LimitCheck(name, kind, _three(shares), _three(largest), worse))
    return tuple(found)


def with_limits(judgement: Judgement, checks: tuple[LimitCheck, ...]) -> Judgement:
    """The judgement, with a recommendation withheld where the proposal violates limits more often than MPC_1."""
    worse = [check for check in checks if check.worse]
    if not worse:
        return judgement
    told = tuple(
        f"{judgement.proposal} violates the limit {check.name!r} ({check.kind}) in {check.shares[2]:.1%} of the steps,"
        f" MPC_1 in {check.shares[1]:.1%}: make it tighter than it is by what the models miss, or price it higher."
        for check in worse
    )
    kept = "try with care" if judgement.verdict == "recommend" else judgement.verdict
    return replace(judgement, verdict=kept, reasons=(*judgement.reasons[:1], *told, *judgement.reasons[1:]))


def _largest(h: Array, far: Array) -> float:
    """The largest of the violations, each compared with others by how far its element moves."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative: NDArray[np.float64] = np.nan_to_num(np.maximum(h, 0.0) / far, nan=0.0, posinf=0.0)
    return float(max(h.reshape(-1)[relative.argmax()], 0.0))


def _kind(soft: Penalty | None) -> str:
    if soft is None:
        return "hard"
    return ", ".join(f"{name} = {weight:.3g}" for name, weight in zip(soft._fields, soft, strict=True) if weight)


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    first, second, third = values
    return first, second, third
