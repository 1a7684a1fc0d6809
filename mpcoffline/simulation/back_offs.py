"""Limits made tighter by what the models of a log disagree about, so that closed loops on these keep the given ones."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import casadi as ca
import numpy as np

from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Constraint, StateBounds

from .episodes import Episodes
from .quick import quick_policy
from .trials import Surroundings
from .violations import TRIFLE, LimitFunction, limit_functions, moved

_ROUNDS = 6
_FARTHER = 1.2  # times what is missing: the loop follows a tighter limit by less than that
_LEFT = 0.2  # of the room between two bounds, that is left
_BETTER = 0.9  # times the violations of the round before, at most: else nothing is gained by more
_SELDOM = 0.98  # in which share of the steps limits are kept at most, where they are kept as far as that pays
_SURE = 2.0  # standard errors

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class BackOffs:
    """What became of the limits of an MPC.

    Attributes:
        mpc: The MPC with tighter limits; the given one where they are kept already, or tighter ones do not help.
        before: In which share of the simulated steps each limit is kept by the given one.
        after: The same by this one.
        amounts: By how much each element is tighter, in the unit of h.
    """

    mpc: MPC
    before: Mapping[str, float]
    after: Mapping[str, float]
    amounts: Mapping[str, Array]

    def __str__(self) -> str:
        """Each limit that is tighter, in a sentence."""
        told = [
            f"{name!r} by {', '.join(f'{v:.3g}' for v in amount)} (kept in {self.before[name]:.1%} of the steps before,"
            f" {self.after[name]:.1%} now)"
            for name, amount in self.amounts.items()
            if amount.any()
        ]
        kept = ", ".join(f"{name!r} in {share:.1%}" for name, share in self.before.items())
        return f"Limits tightened: {'; '.join(told)}." if told else f"Limits not tightened; kept: {kept} of the steps."

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description, without the MPC."""
        shares = {name: [self.before[name], self.after[name]] for name in self.before}
        return {name: {"kept": shares[name], "amounts": self.amounts[name].tolist()} for name in shares}

    @classmethod
    def from_json(cls, mpc: MPC, data: Mapping[str, Any]) -> BackOffs:
        """The inverse of :meth:`to_json`.

        Raises:
            FileFormatError: For other limits than the MPC's.
        """
        names = {limit.name for limit in limit_functions(mpc)}
        if set(data) - names:
            raise FileFormatError("back-offs", expected=f"some of {sorted(names)}", actual="others")
        before, after = ({name: float(each["kept"][i]) for name, each in data.items()} for i in (0, 1))
        amounts = {name: np.array(each["amounts"], dtype=np.float64).ravel() for name, each in data.items()}
        return cls(mpc, before, after, amounts)


def backed_off(
    mpc: MPC, around: Surroundings, share: float | None, tell: Callable[[int, int, str], None] = lambda *what: None
) -> BackOffs:
    """Tightens limits until closed loops on the models of the log keep the given ones in a share of their steps.

    Or as far as that pays: what is cheapest for an exact model lies at a limit, and what no model knows pushes it over
    that, at its price, so that a margin may be cheaper.

    Round by round: each limit that is violated in too many of the steps, on all models that have a vote together, is
    tightened by what its value lies above zero at the quantile that may not. A loop follows a tighter limit by less
    than its change, or by more, so that it takes some rounds. Limits at the end of the horizon stay.

    Args:
        mpc: The MPC.
        around: Where it acts; from its usual starts, or half of them where that is enough to tell what pays.
        share: In which the limits are to be kept, e.g. 0.95; None for as far as that pays: limits without a price stay.
        tell: Is told which round it is.

    Returns:
        The tightest of the rounds that was still better than the one before: it kept limits in more of the steps, or
        was cheaper, beyond two standard errors on half of the models.
    """
    limits = [each for each in limit_functions(mpc) if share is not None or each.soft is not None]
    if not limits or not around.models.votes.any():
        return BackOffs(mpc, {}, {}, {})
    pays, share = share is None, _SELDOM if share is None else share
    cost, n_starts = np.zeros((1, 1)), -(-around.usual // 2) if pays else around.usual
    none = {limit.name: np.zeros(limit.function.size1_out(0)) for limit in limits}
    amounts, best, kept, before = none, (mpc, none), dict[str, float](), dict[str, float]()
    for k in range(_ROUNDS):
        tell(k, _ROUNDS, "limits made tighter")
        tried = _tightened(mpc, amounts)
        (episodes,) = around.act([around.seeing(quick_policy(tried))], slice(0, n_starts), n_starts)
        found = {limit.name: _values(limit, mpc, episodes, around) for limit in limits}
        now = {name: _share(h) for name, h in found.items()}
        before, own = before or now, episodes.cost[around.models.votes]
        if kept and not (_is_cheaper(own, cost) if pays else _missing(now, share) < _BETTER * _missing(kept, share)):
            break
        best, kept, cost = (tried, amounts), now, own
        if _missing(now, share) == 0.0:
            break
        amounts = {n: a if now[n] >= share else a + _more(found[n], share) for n, a in amounts.items()}
        amounts = _within(mpc, amounts)
    result = BackOffs(best[0], before, kept, best[1])
    logger.info("%s", result)
    return result


def _missing(kept: Mapping[str, float], share: float) -> float:
    """In which share of the steps too many are violated, of all limits together."""
    return float(sum(max(share - each, 0.0) for each in kept.values()))


def _is_cheaper(cost: Array, before: Array) -> bool:
    """Whether episodes ``(models, starts)`` cost less than before, beyond chance, on half of the models."""
    with np.errstate(invalid="ignore"):  # of loops that run away
        gain = before - cost
        error = gain.std(axis=1) / np.sqrt(gain.shape[1])
    return bool(np.mean(gain.mean(axis=1) > _SURE * error) >= 0.5)


def _values(limit: LimitFunction, given: MPC, episodes: Episodes, around: Surroundings) -> Array:
    """H of the given limit in the closed loops of another MPC, ``(models, starts, T, n)``."""
    votes = around.models.votes
    return limit.along(episodes.states_kept[votes][:, :, :-1], episodes.actions_kept[votes], given.theta)


def _share(h: Array) -> float:
    return float(1.0 - (h > TRIFLE * moved(h)).any(axis=-1).mean())


def _more(h: Array, share: float) -> Array:
    """What each element lies above zero at the quantile that may not, ``(n,)``."""
    rows = h.reshape(-1, h.shape[-1])
    quantile = np.quantile(rows, 1.0 - (1.0 - share) / rows.shape[1], axis=0)
    return np.asarray(_FARTHER * np.maximum(quantile, 0.0))


def _within(mpc: MPC, amounts: Mapping[str, Array]) -> dict[str, Array]:
    """The amounts, of bounds no more than leaves some room between them."""
    found = dict(amounts)
    for bounds in mpc.state_bounds:
        low, high = np.asarray(bounds.low), np.asarray(bounds.high)
        above, below = np.flatnonzero(np.isfinite(high)), np.flatnonzero(np.isfinite(low))
        off = found[bounds.name].copy()
        for i, state in enumerate(above):
            if state in below:
                j = len(above) + int(np.flatnonzero(below == state)[0])
                room, taken = (1.0 - _LEFT) * (high - low)[state], off[i] + off[j]
                off[[i, j]] *= min(1.0, room / taken) if taken > 0.0 else 1.0
        found[bounds.name] = off
    return found


def _tightened(mpc: MPC, amounts: Mapping[str, Array]) -> MPC:
    if not any(amount.any() for amount in amounts.values()):
        return mpc
    given = mpc.constraints if isinstance(mpc.constraints, tuple) else ()
    return mpc.replace(constraints=[_tighter(each, amounts.get(each.name)) for each in given])


def _tighter(limit: Constraint | StateBounds, amount: Array | None) -> Constraint | StateBounds:
    if amount is None or not amount.any():
        return limit
    if isinstance(limit, StateBounds):
        low, high = (np.array(bound, dtype=np.float64) for bound in (limit.low, limit.high))
        above, below = np.isfinite(high), np.isfinite(low)
        high[above] -= amount[: above.sum()]
        low[below] += amount[above.sum() :]
        return replace(limit, low=low, high=high)
    function = cast(ca.Function, limit.function)
    symbols = [ca.SX.sym(f"i{k}", function.numel_in(k)) for k in range(function.n_in())]
    return replace(limit, function=ca.Function("h", symbols, [function(*symbols) + ca.DM(amount)]))
