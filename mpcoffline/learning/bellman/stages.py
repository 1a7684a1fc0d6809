"""The stages of the regressions on the Bellman equation."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
import torch

from mpcoffline.core.checks import check_known, check_number
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import fit_residual, with_residual
from mpcoffline.estimation.beginnings import applied_before
from mpcoffline.estimation.delays import find_delays
from mpcoffline.estimation.plant import settled
from mpcoffline.learning.ends import ends_matter, going_on, priced_ends
from mpcoffline.learning.known_cost import as_logged, identify_as_logged
from mpcoffline.learning.linear_quadratic import riccati_cost
from mpcoffline.learning.potential import Potential
from mpcoffline.learning.stages import Known, KnownCost, Stage, Training
from mpcoffline.learning.terminal import fit_terminal
from mpcoffline.learning.value.config import ValueConfig
from mpcoffline.learning.value.function import ValueFunction
from mpcoffline.learning.value.training import ValueTraining
from mpcoffline.mpc import MPC, Model, NetworkCost, NormCost, TerminalCost
from mpcoffline.mpc.penalties import paid_in_value, repriced

from .regression import ParameterConfig, ParameterTraining

Init = Literal["nominal", "identified"]
Terminal = Literal["given", "norm", "quadratic", "network", "auto"]

_log = logging.getLogger(__name__)

_SCALE_ROWS = 5_000
_TERMINAL_ROWS = 100_000
_NORM_ROUNDING = 0.05  # of the states' spread


@dataclass(frozen=True)
class StartConfig:
    """Where the model starts.

    Attributes:
        init: ``"nominal"`` at theta_0, ``"identified"`` at the smallest one-step prediction error, which also removes
            measurement noise from the data where there is any.
        adapt_above: With ``init="identified"``, steps on cost and model together (``fit_n_steps``) are made only where
            the identified model misses more than this share of an increment (root mean square of the one-step
            errors): where its structure is not the plant's. Else the model stays and the cost alone is fitted.
        delays: With ``init="identified"``, whether dead time is looked for in the data before all else, where the model
            says nothing of it (``delay=None``), and checked where it does.
        residual: With ``init="identified"``, whether a model that misses more than that gets a learned residual, if
            held-out episodes ask for one (:func:`mpcoffline.estimation.fit_residual`); it stays then, too.
    """

    init: Init = "nominal"
    adapt_above: float = 0.0
    delays: bool = True
    residual: bool = False

    def __post_init__(self) -> None:
        check_known("init", self.init, get_args(Init))
        check_number("adapt_above", self.adapt_above, 0.0, open_low=False)


def with_dead_time(known: Known, config: StartConfig) -> Known:
    """The MPC with the dead time that the log shows, where its model says none; where it does, a check of that."""
    if config.init == "nominal" or not _looks_for_dead_time(known, config):
        return known
    model, search = known.mpc.model, find_delays(known.mpc, known.table, seed=known.seed)
    if not search.found:
        _log.info("Inputs: %s", search)
    elif model.delay is None:
        _log.warning("Inputs act late: found a %s. The learned MPC carries the past inputs.", search)
        mpc, value = known.mpc.with_delay(search.delay), known.value_function
        if value is not None:
            value = value.of_layout(known.mpc.layout, mpc.layout)
        return replace(known, mpc=mpc, value_function=value)
    else:
        _log.warning("The model's delay is %s, the log says otherwise: a %s.", list(model.delay), search)
    return known


def _looks_for_dead_time(known: Known, config: StartConfig) -> bool:
    """It is where it may be, unless a V was given that only whoever wrote its class could extend by past inputs."""
    return config.delays and (known.value_function is None or type(known.value_function) is ValueFunction)


def identified(known: Known, config: StartConfig) -> Known:
    """The table without measurement noise, and the model, where it is learned, by its prediction error."""
    if config.init == "nominal":
        return known
    tried = ["dead times"] if _looks_for_dead_time(known, config) else []
    rows = as_logged(known.mpc, known.table, known.cost)
    found, table = identify_as_logged(known.mpc, known.table, rows, tried=tried, seed=known.seed, start=known.start)
    if known.shards is not None and not found.noise.negligible and found.noise.source != "unknown":
        text = "The log has measurement noise, which is taken out of an excerpt: V and theta are learned of its %d rows"
        _log.warning(text, len(table))
        known = replace(known, shards=None)
    known = replace(known, table=table, found=found, mpc=_begun_as_logged(known, found.model))
    if "model" not in known.groups:
        return known
    known = replace(known, mpc=known.mpc.replace(model=found.model), model_error=found.error_after)
    return completed(known, found.table) if config.residual and found.error_after > config.adapt_above else known


def _begun_as_logged(known: Known, model: Model) -> MPC:
    """The MPC that takes for applied before an episode what the log's episodes say, where nobody has told it."""
    if known.begun is None or known.mpc.applied_before is not None:
        return known.mpc
    cost, costs = known.cost, None
    if cost is not None and not (cost.constant or cost.reached):
        costs = partial(_unscaled, cost)
    applied = applied_before(known.mpc.replace(model=model), known.begun, costs)
    if applied is None:
        return known.mpc
    _log.info("Before episodes of the log, inputs of %s were applied, as their first rows say", applied)
    return known.mpc.replace(applied_before=applied)


def _unscaled(cost: KnownCost, rows: TransitionTable) -> Array:
    return np.asarray((rows.values().costs - cost.offset) / cost.scale)


def completed(known: Known, rows: TransitionTable) -> Known:
    """The identified model with a learned residual on the rows it is of, where held-out episodes ask for one."""
    residual = fit_residual(known.mpc, rows, known.seed)
    _log.info("%s", residual)
    if not residual.taken:
        return known
    mpc = with_residual(known.mpc, residual)
    return replace(known, mpc=mpc, model_error=residual.one_step[1], residual_share=residual.share)


class LearnValue(Stage):
    """V_phi by (VALUE); none is learned where one is given.

    Args:
        config: How.
    """

    phase: str
    epoch: int

    phase, epoch = "(VALUE) learning V", 500

    def __init__(self, config: ValueConfig) -> None:
        self._config = config

    def begin(self, known: Known) -> Training | None:
        """See :class:`~mpcoffline.learning.value.training.ValueTraining`."""
        if known.value_function is not None:
            return None
        seen = known if known.limits is None else known.with_rows(known.limits.added)
        how: dict[str, Any] = {"seed": known.seed, "device": known.device, "shards": seen.shards}
        return ValueTraining(seen.table, known.mpc.discount, self._config, **how)

    def outcome(self, known: Known, training: Training) -> Known:
        """Adds V_phi."""
        return replace(known, value_function=training.result.cpu())


class LearnParameters(Stage):
    """Theta by (FIT).

    Args:
        config: How.
        adapt_above: See :class:`StartConfig`.
    """

    def __init__(self, config: ParameterConfig, adapt_above: float = 0.0) -> None:
        self._config, self._adapt_above = config, adapt_above

    def begin(self, known: Known) -> Training:
        """See :class:`~mpcoffline.learning.bellman.regression.ParameterTraining`."""
        self.phase: str = f"(FIT) learning {'+'.join(known.groups)}"
        mpc = known.mpc if known.cost is not None else in_units_of(known.mpc, known.table)
        value, config, seen = known.constant_value, self._adapting(known), known
        if known.cost is None and ends_matter(known.table, mpc.discount):  # of which T knows; no cost explains them
            seen = known.with_rows(going_on)
        how: dict[str, Any] = {"seed": known.seed, "cost": known.cost, "limits": known.limits, "shards": seen.shards}
        return ParameterTraining(mpc, value, seen.table, known.groups, config, **how)

    def _adapting(self, known: Known) -> ParameterConfig:
        """The configuration, without steps on a model that was identified and predicts well, or has the right cost."""
        config, missed = self._config, 0.0 if known.residual_share else known.model_error
        if known.cost is not None and (known.cost.constant or missed is not None):
            return replace(config, n_steps=0)
        if missed is None or not config.n_steps:
            return config
        if missed <= self._adapt_above:
            _log.info("The identified model misses %.2g of an increment: it stays, (FIT) finds the cost", missed)
            return replace(config, n_steps=0)
        _log.info(
            "The identified model misses %.2g of an increment, adapt_above is %g: (FIT) adapts it with the cost. The "
            "larger horizon and discount are, the more an MPC relies on its model",
            missed,
            self._adapt_above,
        )
        return config

    def outcome(self, known: Known, training: Training) -> Known:
        """Adds theta and the result."""
        limits = None if known.limits is None else (known.limits.scale, known.limits.logged)
        result = replace(training.result, residual_share=known.residual_share, cost=known.cost, limits=limits)
        mpc = repriced_as_logged(known.mpc, known)
        return replace(known, mpc=mpc.with_theta(result.theta), result=result)


@dataclass(frozen=True)
class TerminalConfig:
    """What the terminal cost of the learned MPC becomes.

    Attributes:
        method: ``"given"`` keeps the given one's, ``"norm"`` is (TERM), ``"quadratic"`` and ``"network"`` are fitted
            to V, as Theorem 1 asks for (doi:10.1109/TAC.2019.2913768); ``"auto"`` is the exact value of the learned
            MPC where it has one, with an affine model, a quadratic stage cost
            (by its Riccati equation) and no ends at a price, else ``"network"``.
        blend: Share of the convex quadratic in ``"network"``: steadier at short horizons.
    """

    method: Terminal = "given"
    blend: float = 0.0

    def __post_init__(self) -> None:
        check_known("terminal", self.method, get_args(Terminal))
        check_number("blend", self.blend, 0.0, 1.0, open_low=False)


def with_terminal_cost(known: Known, config: TerminalConfig, *, horizon: int | None = None) -> Known:
    """The MPC with the terminal cost that is asked for: T = V - Phi, or none from V.

    The exact value of an MPC is V - Phi of its own: Phi changes none of its inputs. Where all logged costs are one
    number, V is in no unit of the stage cost: then the given terminal cost stays, and with it the given horizon, unless
    one was asked for (``horizon``). Where V knows what soft limits cost, bounds of states are not asked at x_N besides:
    by Theorem 1 (doi:10.1109/TAC.2019.2913768) all that is paid there is V.
    """
    if config.method == "given":
        return known
    if known.cost is not None and known.cost.constant:
        mpc = known.mpc if horizon is not None or known.given is None else _as_far_as(known.given, known.mpc)
        return replace(known, mpc=mpc)
    goal = settled(known.mpc, known.table)
    unpriced = config.method == "auto" and not ends_matter(known.table, known.mpc.discount)  # ends are no part of f
    exact = riccati_cost(known.mpc) if unpriced else None
    cost: TerminalCost = NormCost(goal, _norm_rounding(known.table)) if exact is None else exact
    if exact is not None:
        _log.info("The learned MPC is linear-quadratic: its terminal cost is its exact value")
    elif config.method != "norm":
        cost, distilled = _distilled(known, config, goal)
        known = replace(known, distilled=distilled)
    mpc = known.mpc.replace(terminal_cost=cost)
    if exact is None and config.method != "norm" and known.limits is not None:
        mpc = paid_in_value(mpc)
    return replace(known, mpc=mpc, result=None if known.result is None else replace(known.result, theta=mpc.theta))


def with_terminal_form(known: Known, config: TerminalConfig) -> MPC:
    """The MPC with a terminal cost of the kind that :func:`with_terminal_cost` will find, mostly, with any numbers."""
    mpc, constant = repriced_as_logged(known.mpc, known), known.cost is not None and known.cost.constant
    if constant or config.method not in ("network", "auto"):
        return mpc
    if config.method == "auto" and riccati_cost(mpc) is not None and not ends_matter(known.table, mpc.discount):
        return mpc
    mpc = mpc.replace(terminal_cost=NetworkCost.random(mpc.nx, seed=0))
    return mpc if known.limits is None else paid_in_value(mpc)


def _distilled(
    known: Known, config: TerminalConfig, goal: Array
) -> tuple[TerminalCost, tuple[Array, TerminalCost] | None]:
    """T from V, and once more with its goal where it is V alone: another MPC's is the same then, if its goal is."""
    value, potential = known.constant_value, None if known.result is None else known.result.potential
    ends = _ends(known, potential)
    alone = potential is None and known.cost is None and ends is None
    if alone and known.distilled is not None and np.array_equal(known.distilled[0], goal):
        return known.distilled[1], known.distilled
    cost = fit_terminal(
        "quadratic" if config.method == "quadratic" else "network",
        partial(_terminal, known, value, potential),
        known.table.sample(_TERMINAL_ROWS, 0).observations,
        x_ref=goal,
        blend=config.blend,
        seed=known.seed,
        ends=ends,
    )
    return cost, (goal, cost) if alone else None


def _terminal(known: Known, value: ValueFunction, potential: Potential | None, s: torch.Tensor) -> torch.Tensor:
    """V - Phi in the unit of the stage cost, and what this lacks at x_N where it is of the state reached."""
    wanted: torch.Tensor = value(s) if potential is None else value(s) - potential(s)
    if known.cost is not None:
        wanted = wanted / known.cost.scale
    if known.cost is not None and known.cost.reached:
        wanted = wanted + torch.from_numpy(known.cost.of_state(known.mpc, s.double().numpy())).to(wanted)
    return wanted


def _norm_rounding(table: TransitionTable) -> float:
    """Where the norm's kink is rounded, in the unit of the states: a share of how far they spread."""
    spread = table.sample(_SCALE_ROWS, 0).values().observations.std(axis=0)
    return _NORM_ROUNDING * (float(np.linalg.norm(spread)) or 1.0)


def _as_far_as(given: MPC, mpc: MPC) -> MPC:
    """The MPC with the given one's horizon and discount."""
    return mpc.replace(horizon=given.horizon, discount=given.discount)


def _ends(known: Known, potential: Potential | None) -> tuple[Array, Array] | None:
    """Where episodes end at a price, and T there; with Phi, ``Lhat + Phi(s) + gamma T(s+) = L``."""
    ends = priced_ends(known.mpc, known.table, known.cost)
    if ends is None:
        return None
    shaping = 0.0 if potential is None else potential(torch.from_numpy(ends.before)).numpy() / known.mpc.discount
    return ends.states, np.asarray(ends.values - shaping)


def repriced_as_logged(mpc: MPC, known: Known) -> MPC:
    """The MPC with the prices of its soft limits in logged costs, where its stage cost is learned from these."""
    return mpc if known.limits is None or known.cost is not None else repriced(mpc, known.limits.scale)


def in_units_of(mpc: MPC, table: TransitionTable) -> MPC:
    """The MPC with the weights of its stage cost scaled to the logged cost, which has its unit from whoever logged it.

    (FIT) is drawn to theta_0, of which the ratios of the weights count, not their size.
    """
    rows = table.sample(_SCALE_ROWS, 0).values()  # at random: a stride would meet the length of episodes
    stage = mpc.stage_costs(rows.observations, rows.actions)
    logged, nominal = float(rows.costs.std()), float(stage.std())
    factor = logged / nominal if nominal > 0.0 else 1.0
    if not np.isfinite(factor) or factor == 0.0:
        return mpc
    weights = [block.name for block in mpc.space if block.group == "cost" and block.kind == "psd"]
    theta = mpc.theta
    for name in weights:
        theta[mpc.space.slices[name]] *= np.sqrt(factor)  # of W = C C'
    _log.info(
        "the logged cost varies %.3g times as much as the MPC's stage cost, whose weights are scaled to it", factor
    )
    return mpc.with_theta(theta)
