"""The regression of V_phi as an object that can stop between any two steps, be saved, and go on."""

from __future__ import annotations

import copy
import logging
import math
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError
from mpcoffline.core.threads import one_torch_thread
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import Columns, TransitionTable
from mpcoffline.learning.reduction import Source

from .config import SWEEPS, ValueConfig, cosine
from .function import ValueFunction, tanh_network
from .methods import Residual, ValueMethod
from .network import Member, same_shape, whole_numbers
from .noise import Stochasticity, estimate_stochasticity
from .units import Units

VALIDATE_EVERY = 250  # steps
_VALIDATION_ROWS = 8_192
_LOST = 25  # steps in a row without a finite gradient
_SMALL = 1e8  # products of a step, a weight and a row, below which one thread is as good as several

_log = logging.getLogger(__name__)


class ValueTraining:
    """The state of a regression of V_phi between two of its steps.

    It learns in the units of the network (:class:`~mpcoffline.learning.value.units.Units`). The members of an ensemble
    see the same minibatches and differ by their initial weights.

    Example:
        >>> training = ValueTraining(table, 0.95, ValueConfig(), seed=0)
        >>> while not training.done:
        ...     metrics = training.advance(500)
        >>> value = training.result

    Args:
        table: The transitions.
        discount: gamma.
        config: Loss and schedule.
        seed: Seeds weights, minibatches and the choice of the validation episodes; the same seed gives the same
            weights on the same machine.
        device: Torch device.
        shards: Where the table is an excerpt, all transitions: minibatches, units and bounds are of these.

    Raises:
        InvalidArgumentError: For a share of validation beside shards.

    Attributes:
        step: Steps made.
        n_steps: Steps in all, unless the validation loss stops falling before.
        method: The loss; what ``"auto"`` chose.
        stochasticity: What ``"auto"`` found in the data; None where the method was given.
    """

    step: int
    n_steps: int
    stochasticity: Stochasticity | None

    def __init__(
        self,
        table: TransitionTable,
        discount: float,
        config: ValueConfig,
        *,
        seed: int,
        device: str = "cpu",
        shards: ShardedTable | None = None,
    ) -> None:
        if shards is not None and config.validation:
            expected = "0 where rows come from shards: no episodes are held out of these"
            raise InvalidArgumentError("validation", expected=expected, actual=f"{config.validation:g}")
        self.step, self.n_steps = 0, config.n_steps
        self._config, self._discount, self._device = config, discount, device
        self.stochasticity = estimate_stochasticity(table, seed=seed) if config.method == "auto" else None
        self.method: ValueMethod = config.build(noisy=self.stochasticity is not None and self.stochasticity.is_noisy)
        _tell(self.method, self.stochasticity, config, discount)
        table, held_out = split_episodes(table, config.validation, seed)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self._value = ValueFunction(table.ny, config.hidden, config.n_members)
            nets = [[net] for net in self._value.members]
            if self.method.learns_q:
                nets = [[net, tanh_network(table.ny + table.nu, config.hidden)] for [net] in nets]
        source = Source.of(table, shards, config.batch_size, np.random.default_rng(seed), seed)
        self._value.normalise(source.data, discount)
        self._units = Units(source.data, self._value, discount, device)
        self._members = [Member(pair, self._units.bounds, device, source.reduction) for pair in nets]
        self._batches = source.batches
        self._validation = None if held_out is None else self._batch(next(held_out.batches(_VALIDATION_ROWS, seed)))
        self._validation_loss, self._best_loss = math.nan, math.inf
        self._best_step, self._best = 0, self._weights()
        self._skipped = 0

    @property
    def done(self) -> bool:
        """Whether all steps are made, or the validation loss has not fallen for ``config.patience`` steps."""
        patience = self._config.patience
        stalled = self._validation is not None and 0 < patience <= self.step - self._best_step
        return stalled or self.step >= self.n_steps

    def advance(self, n: int) -> dict[str, float]:
        """Makes n more steps, fewer at the end.

        Returns:
            ``value_loss``: the mean loss of these steps, in units of the mean loss of V = offset; and, with a split,
            ``validation_loss``: the latest one, NaN before the first.

        Raises:
            MPCOfflineError: If the loss stays NaN or infinite.
        """
        losses: list[float] = []
        with one_torch_thread() if self._is_small else nullcontext():
            for _ in range(n):
                if self.done:
                    break
                self.step += 1
                losses += self._gradient_step()
                if self.step % VALIDATE_EVERY == 0 or self.step == self.n_steps:
                    self._validate()
        metrics = {"value_loss": float(np.mean(losses)) if losses else math.nan}
        return metrics if self._validation is None else metrics | {"validation_loss": self._validation_loss}

    @property
    def _is_small(self) -> bool:
        return self._config.batch_size * self._members[0].critic.weights[0].numel() < _SMALL

    @property
    def result(self) -> ValueFunction:
        """V_phi: of the smallest validation loss, or of the last step without a split; a constant, for evaluation."""
        value = copy.deepcopy(self._value)
        best = self._weights() if self._validation is None else self._best
        for member, weights, net in zip(self._members, best, value.members, strict=True):
            member.critic.networks[0].store(weights.cpu(), net)
        return value.to(self._device).eval().requires_grad_(False)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """What :meth:`restore` needs to go on bit for bit."""
        counters = [self.step, self._best_step, self._skipped]
        arrays: dict[str, NDArray[Any]] = {
            "counters": np.array(counters),
            "losses": np.array([self._validation_loss, self._best_loss]),
        }
        for i, (member, best) in enumerate(zip(self._members, self._best, strict=True)):
            parts = member.to_arrays() | {"best": best.cpu().numpy()}
            arrays |= {f"{i}.{name}": array for name, array in parts.items()}
        return arrays

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Takes over a state from :meth:`to_arrays` of a training with the same arguments, before any step of this one.

        Raises:
            FileFormatError: If arrays are missing or of another network.
        """
        try:
            step, best_step, skipped = whole_numbers(arrays["counters"], 3)
            validation_loss, best_loss = arrays["losses"].astype(np.float64).tolist()
            for i, member in enumerate(self._members):
                member.restore({name[len(f"{i}.") :]: a for name, a in arrays.items() if name.startswith(f"{i}.")})
                self._best[i].copy_(same_shape(arrays[f"{i}.best"], self._best[i]))
            if not (self.step <= step <= self.n_steps and 0 <= best_step <= step and 0 <= skipped <= step):
                raise ValueError(f"steps {step}, {best_step}, {skipped} of {self.n_steps}")
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise FileFormatError(
                "state of a value training", expected="that of the same network and method", actual=str(error)
            ) from error
        # The order of the rows is a function of the seed.
        for _ in range(step - self.step):
            next(self._batches)
        self.step, self._best_step, self._skipped = step, best_step, skipped
        self._validation_loss, self._best_loss = validation_loss, best_loss

    def _batch(self, rows: Tensor) -> Columns:
        return self._units.columns(rows.to(self._device))

    def _weights(self) -> list[Tensor]:
        return [member.critic.weights[0].detach().clone() for member in self._members]

    def _gradient_step(self) -> list[float]:
        """One step of each member; returns the losses that were finite."""
        config, parts = self._config, [(share, self._batch(rows)) for share, rows in next(self._batches)]
        learning_rate = config.learning_rate * cosine(self.step, self.n_steps)
        polyak = config.rate(self._discount)
        losses = [member.descend(self.method, parts, self._discount, learning_rate, polyak) for member in self._members]
        finite = [loss for loss in losses if math.isfinite(loss)]
        self._skipped = 0 if len(finite) == len(losses) else self._skipped + 1
        if self._skipped == 1:
            _log.warning("(VALUE) skipped step %d: its loss or gradient is not finite", self.step)
        if self._skipped == _LOST:
            raise MPCOfflineError(
                "(VALUE)",
                expected="a finite loss",
                actual=f"NaN or inf in {_LOST} steps in a row, up to step {self.step}",
                hint=f"Lower learning_rate (now {config.learning_rate:g}), or trim outliers from the data.",
            )
        return finite

    def _validate(self) -> None:
        """Keeps the weights where the loss on the held-out episodes is the smallest so far."""
        if self._validation is None:
            return
        losses = [member.loss(self.method, self._validation, self._discount) for member in self._members]
        self._validation_loss = float(np.mean(losses))
        if self._validation_loss < self._best_loss:
            self._best_loss, self._best_step, self._best = self._validation_loss, self.step, self._weights()


def split_episodes(table: TransitionTable, share: float, seed: int) -> tuple[TransitionTable, TransitionTable | None]:
    """Holds out a share of the episodes; where there is only one, none, which is logged."""
    if share == 0.0:
        return table, None
    if table.n_episodes < 2:
        _log.warning("%s is one episode: (VALUE) learns from all of it, without validation", table.name)
        return table, None
    return table.split(1.0 - share, seed)


def _tell(method: ValueMethod, found: Stochasticity | None, config: ValueConfig, discount: float) -> None:
    """Logs what was chosen, and a schedule too short for this discount."""
    if found is not None:
        _log.info(
            "(VALUE) learns by %s: given (s, a), %.1f %% of the variance of s+ - s and %.1f %% of that of L are noise",
            method,
            100.0 * found.change,
            100.0 * found.cost,
        )
    polyak = config.rate(discount)
    if not config.settles(discount) and discount < 1.0 and not isinstance(method, Residual):
        _log.warning(
            "(VALUE) may end before V has settled: polyak * n_steps * (1 - discount) is %.2g, below %g; raise n_steps "
            "(%d) or polyak (%g)",
            polyak * config.n_steps * (1.0 - discount),
            SWEEPS,
            config.n_steps,
            polyak,
        )
