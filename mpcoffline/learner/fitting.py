"""One fit, from a table of transitions to a learned MPC, in epochs between which it can stop and go on."""

from __future__ import annotations

import copy
import functools
import hashlib
import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.smoothing import identify_smoothed
from mpcoffline.learning import FitResult, ParameterTraining, ValueFunction, ValueTraining
from mpcoffline.learning.terminal import fit_terminal
from mpcoffline.mpc import MPC, NormCost, QuadraticCost

from .presets import LearnerConfig

Arrays = dict[str, NDArray[Any]]

_log = logging.getLogger(__name__)

_OTHER_MAGNITUDE = 30.0
_SCALE_ROWS = 5_000
_TERMINAL_ROWS = 100_000


class Epoch(NamedTuple):
    """A stretch of a fit.

    Attributes:
        phase: What was done, for people.
        step: Steps of the phase done so far.
        n_steps: Steps of the phase in all.
        total_step: Steps of all phases done so far.
        metrics: Means over the epoch.
    """

    phase: str
    step: int
    n_steps: int
    total_step: int
    metrics: dict[str, float]


class Fit:
    """The regressions of arXiv:2301.01667 one after the other; no MPC is solved.

    In this order: identification of the model and removal of measurement noise (``init="identified"``), V_phi by
    (VALUE), theta by (FIT), the terminal cost from V. Each is optional or has a simplest form; see
    :class:`~mpcoffline.learner.presets.LearnerConfig`.

    Args:
        nominal: MPC_1.
        groups: The parameter groups that are learned, ``("cost",)`` or ``("cost", "model")``.
        config: What is done, and how.
        table: The transitions.
        seed: Seeds everything.
        device: Torch device for (VALUE).
        value_function: A V_phi learned before; (VALUE) is skipped.

    Raises:
        InvalidDataError: For data of other sizes than the MPC's, or beyond its bounds.
        InvalidArgumentError: For a device that this machine has not, or a V_phi of another discount than the fit's.

    Attributes:
        value_function: V_phi, once it is learned.
        result: What (FIT) found, once it is done.
    """

    def __init__(
        self,
        nominal: MPC,
        groups: tuple[str, ...],
        config: LearnerConfig,
        table: TransitionTable,
        *,
        seed: int,
        device: str = "cpu",
        value_function: ValueFunction | None = None,
    ) -> None:
        table.check_fits(nominal.nx, nominal.nu, np.asarray(nominal.action_low), np.asarray(nominal.action_high))
        self._groups, self._config, self._table = groups, config, table
        self._seed, self._device = seed, device
        self._fit_config = config.fit
        _check_device(device)
        self._nominal, self._mpc = nominal, restructured(nominal, config)
        _check_discount(value_function, self._mpc.discount)
        self._outcome: Callable[[], tuple[MPC, FitResult]] | None = None
        self.value_function = value_function
        self.result: FitResult | None = None
        self._total_step = 0
        self._trainings: dict[str, ValueTraining | ParameterTraining] = {}
        self._restored: dict[str, Arrays] = {}

    def epochs(self, value_epoch: int = 500, fit_epoch: int = 100) -> Iterator[Epoch]:
        """Runs the fit; yields at the end of each epoch.

        Args:
            value_epoch: Steps of (VALUE) in an epoch.
            fit_epoch: Steps of (FIT) in an epoch.

        Raises:
            InvalidDataError: If the data do not fit.
            MPCOfflineError: If a regression fails.
        """
        table = self._identified(self._table.trim(self._config.trim))
        self._mpc = in_units_of(self._mpc, table)
        if self.value_function is None:
            yield from self._learn_value(table, value_epoch)
        yield from self._learn_parameters(table, fit_epoch)

    def _identified(self, table: TransitionTable) -> TransitionTable:
        """The table without measurement noise; the model, where it is learned, by its prediction error."""
        if self._config.init == "nominal":
            return table
        found = identify_smoothed(self._mpc, table, seed=self._seed)
        if "model" in self._groups:
            self._mpc = self._mpc.with_theta(found.identification.theta)
            missed = found.identification.error_after
            if self._config.fit.n_steps and missed <= self._config.adapt_above:
                self._fit_config = replace(self._config.fit, n_steps=0)
                _log.info("The identified model misses %.2g of an increment: it stays, (FIT) finds the cost", missed)
            elif self._config.fit.n_steps:
                _log.info(
                    "The identified model misses %.2g of an increment, adapt_above is %g: (FIT) adapts it with the "
                    "cost. The larger horizon and discount are, the more an MPC relies on its model",
                    missed,
                    self._config.adapt_above,
                )
        return found.table

    def _learn_value(self, table: TransitionTable, epoch: int) -> Iterator[Epoch]:
        training = ValueTraining(table, self._mpc.discount, self._config.value, seed=self._seed, device=self._device)
        self._begin("value", training)
        while not training.done:
            metrics = training.advance(epoch)
            yield Epoch("(VALUE) learning V", training.step, training.n_steps, training.step, metrics)
        self._total_step = training.step
        self.value_function = training.result.cpu()

    def _learn_parameters(self, table: TransitionTable, epoch: int) -> Iterator[Epoch]:
        if self.value_function is None:  # (VALUE) has ended, or V was given
            return
        value = copy.deepcopy(self.value_function).cpu().eval().requires_grad_(False)
        training = ParameterTraining(self._mpc, value, table, self._groups, self._fit_config, seed=self._seed)
        self._begin("fit", training)
        phase, n_steps = f"(FIT) learning {'+'.join(self._groups)}", training.n_steps + 1

        def outcome() -> tuple[MPC, FitResult]:
            """What is handed out at this point of the training."""
            result = training.finish()
            mpc = self._with_terminal_cost(self._mpc.with_theta(result.theta), value, result, table)
            return mpc, replace(result, theta=mpc.theta)

        self._outcome = functools.cache(outcome)
        while not training.done:
            metrics = training.advance(epoch)
            self._outcome = functools.cache(outcome)  # what is found once holds until the next step
            yield Epoch(phase, training.step, n_steps, self._total_step + training.step, metrics)
        self.result = self._outcome()[1]
        yield Epoch(phase, n_steps, n_steps, self._total_step + n_steps, {"fit_loss": self.result.loss_after})

    @property
    def learned(self) -> Callable[[], MPC] | None:
        """The MPC that would be handed out now, terminal cost and all, found when called; None before (FIT)."""
        outcome = self._outcome
        return None if outcome is None else lambda: outcome()[0]

    def _with_terminal_cost(self, mpc: MPC, value: ValueFunction, result: FitResult, table: TransitionTable) -> MPC:
        """The MPC with the terminal cost that the configuration asks for: T = V - Phi, or none from V."""
        kind, config = self._config.terminal, self._config
        if kind == "given":
            return mpc
        goal = np.zeros(mpc.nx) if mpc.reference is None else mpc.reference
        if kind == "norm":
            return mpc.replace(terminal_cost=NormCost(goal))
        potential = result.potential
        terminal_cost = fit_terminal(
            kind,
            value if potential is None else lambda s: value(s) - potential(s),
            table.take(_some_rows(len(table), _TERMINAL_ROWS)).observations,
            x_ref=goal,
            blend=config.terminal_blend,
            seed=self._seed,
        )
        return mpc.replace(terminal_cost=terminal_cost)

    def _begin(self, name: str, training: ValueTraining | ParameterTraining) -> None:
        """Makes a regression known to :meth:`to_arrays`, and takes it to where it was interrupted."""
        self._trainings[name] = training
        if name in self._restored:
            training.restore(self._restored.pop(name))

    @property
    def identity(self) -> str:
        """What decides the result (data, MPC, configuration, seed) as a SHA-256."""
        described = {
            "nominal": self._nominal.to_json(),
            "groups": self._groups,
            "config": self._config.to_json(),
            "seed": self._seed,
        }
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
        for column in (self._table.rows, self._table.episode_ids, *self._table.centring):
            digest.update(np.ascontiguousarray(column).data)
        if self.value_function is not None:
            for array in self.value_function.to_arrays().values():
                digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def to_arrays(self) -> Arrays:
        """What :meth:`restore` needs, between two epochs."""
        return {
            f"{name}/{key}": array
            for name, training in self._trainings.items()
            for key, array in training.to_arrays().items()
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Makes :meth:`epochs` go on from a state of :meth:`to_arrays` of a fit with the same arguments."""
        for name in ("value", "fit"):
            own = {key.removeprefix(f"{name}/"): a for key, a in arrays.items() if key.startswith(f"{name}/")}
            if own:
                self._restored[name] = own


def restructured(nominal: MPC, config: LearnerConfig) -> MPC:
    """The MPC with the discount, the horizon and the form of stage cost that a configuration asks for."""
    discount = max(nominal.discount, config.least_discount) if config.discount is None else config.discount
    horizon = nominal.horizon if config.horizon is None else config.horizon
    mpc = nominal.replace(discount=discount, horizon=horizon)
    cost = nominal.stage_cost
    if config.cross_term and type(cost) is QuadraticCost and cost.nu and "H" not in cost.values:
        values, cross = cost.values, np.zeros((cost.nx, cost.nu))
        constant = float(values["constant"])
        crossed = QuadraticCost(cost.W, cost.R, cross, values["x_ref"], values["u_ref"], constant)
        return mpc.replace(stage_cost=crossed)
    if config.cross_term:
        _log.warning("cross_term has no effect on a stage cost that is not quadratic or has one already")
    return mpc


def in_units_of(mpc: MPC, table: TransitionTable) -> MPC:
    """The MPC with the weights of its stage cost scaled to the logged cost, where these are of other magnitudes.

    (FIT) measures distances in the size of theta_0, which has to be that of the cost in the data within a factor of 30.
    """
    rows = table.columns(table.rows[_some_rows(len(table), _SCALE_ROWS)])
    stage = mpc.stage_function(rows.observations.T, rows.actions.T, mpc.theta).full()
    logged, nominal = float(rows.costs.std(dtype=np.float64)), float(stage.std())
    factor = logged / nominal if nominal > 0.0 else 1.0
    if not np.isfinite(factor) or 1.0 / _OTHER_MAGNITUDE < factor < _OTHER_MAGNITUDE or factor == 0.0:
        return mpc
    weights = [block.name for block in mpc.space if block.group == "cost" and block.kind == "psd"]
    theta = mpc.theta
    for name in weights:
        theta[mpc.space.slices[name]] *= np.sqrt(factor)  # of W = C C'
    outcome = f"{', '.join(weights)} scaled to it" if weights else "scale that by hand"
    _log.warning("the logged cost varies %.3g times as much as the MPC's stage cost: %s", factor, outcome)
    return mpc.with_theta(theta)


def _some_rows(n: int, most: int) -> NDArray[np.int64]:
    """Row numbers in order, at most so many, the same at each call; a stride would meet the length of episodes."""
    return np.sort(np.random.default_rng(0).permutation(n)[:most])


def _check_discount(value_function: ValueFunction | None, discount: float) -> None:
    """Refuses a V_phi of another gamma; a V_phi that knows none is the caller's word."""
    known = None if value_function is None else value_function.discount
    if known is not None and not math.isclose(known, discount, rel_tol=1e-6):
        raise InvalidArgumentError(
            "value_function",
            expected=f"one learned with the discount of this fit, {discount:g}",
            actual=f"one of {known:g}",
            hint=f"Pass discount={known:g} to the learner, or let it learn V anew.",
        )


def _check_device(device: str) -> None:
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch raises both
        raise InvalidArgumentError(
            "device", expected="a torch device of this machine", actual=f"{device!r}: {error}", hint="Use device='cpu'."
        ) from error
