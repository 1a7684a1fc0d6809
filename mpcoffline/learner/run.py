"""One run of a learning method, from a table of transitions to a learned MPC, in epochs between which it can stop."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.learning import FitResult, Known, Method, ValueFunction
from mpcoffline.mpc import MPC

Arrays = dict[str, NDArray[Any]]


class Epoch(NamedTuple):
    """A stretch of a run.

    Attributes:
        phase: What was done, for people.
        step: Steps of the stage done so far.
        n_steps: Steps of the stage in all.
        total_step: Steps of all stages done so far.
        metrics: Means over the epoch.
    """

    phase: str
    step: int
    n_steps: int
    total_step: int
    metrics: dict[str, float]


class Run:
    """The stages of a method one after the other.

    Args:
        method: What is done, and how.
        start: What is known before: MPC_1, the transitions, what is learned, seed, device, and perhaps V_phi.

    Raises:
        InvalidDataError: For data of other sizes than the MPC's, or beyond its bounds.
        InvalidArgumentError: For a device that this machine has not, or a V_phi of another discount than the run's.

    Attributes:
        value_function: V_phi, once it is learned.
        result: What was found, once all is done.
    """

    def __init__(self, method: Method, start: Known) -> None:
        mpc = start.mpc
        start.table.check_fits(mpc.nx, mpc.nu, np.asarray(mpc.action_low), np.asarray(mpc.action_high))
        _check_device(start.device)
        self.method, self._start, self._stages = method, start, method.stages()
        self._mpc = method.restructured(mpc)
        _check_discount(start.value_function, self._mpc.discount)
        self._outcome: Callable[[], Known] | None = None
        self.value_function = start.value_function
        self.result: FitResult | None = None
        self._begun: list[str] = []
        self._restored: dict[str, Arrays] = {}

    def epochs(self, n_steps: int | None = None) -> Iterator[Epoch]:
        """Runs the stages; yields at the end of each epoch.

        Args:
            n_steps: Steps in an epoch; by default what each stage says.

        Raises:
            InvalidDataError: If the data do not fit.
            MPCOfflineError: If a regression fails.
        """
        known = replace(self._start, mpc=self._mpc, table=self._start.table.trim(self.method.trim))
        stages, total = list(self._stages.items()), 0
        last = max((i for i, (_, stage) in enumerate(stages) if not stage.quick), default=len(stages) - 1)
        for i, (name, stage) in enumerate(stages[: last + 1]):
            stage.begin(known)
            self._begun.append(name)
            if name in self._restored:
                stage.restore(self._restored.pop(name))
            while not stage.done or (i == last and self._outcome is None):
                metrics = stage.advance(n_steps or stage.epoch)
                if i == last:
                    self._outcome = functools.cache(lambda i=i: self._ended(i))  # holds until the next step
                    self.result = self._outcome().result if stage.done else None
                yield Epoch(stage.phase, stage.step, stage.n_steps, total + stage.step, metrics)
            if i < last:
                known, total = stage.outcome(), total + stage.step
                self.value_function = known.value_function

    def _ended(self, i: int) -> Known:
        """What is known if stage i ends now: the stages after it take no steps."""
        first, *others = list(self._stages.values())[i:]
        known = first.outcome()
        for stage in others:
            stage.begin(known)
            known = stage.outcome()
        if known.result is None:
            raise InvalidArgumentError("stages", expected="one that leaves a result", actual="none")
        return known

    @property
    def learned(self) -> Callable[[], MPC] | None:
        """The MPC that would be handed out now, found when called; None before the last stage that takes steps."""
        outcome = self._outcome
        return None if outcome is None else lambda: outcome().mpc

    @property
    def identity(self) -> str:
        """What decides the result (data, MPC, method, options, seed) as a SHA-256."""
        start = self._start
        described = {
            "nominal": start.mpc.to_json(),
            "groups": start.groups,
            "method": self.method.name,
            "options": self.method.options,
            "seed": start.seed,
        }
        digest = hashlib.sha256(json.dumps(described, sort_keys=True, default=repr).encode())
        for column in (start.table.rows, start.table.episode_ids, *start.table.centring):
            digest.update(np.ascontiguousarray(column).data)
        if start.value_function is not None:
            for array in start.value_function.to_arrays().values():
                digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def to_arrays(self) -> Arrays:
        """What :meth:`restore` needs, between two epochs."""
        return {f"{name}/{key}": array for name in self._begun for key, array in self._stages[name].to_arrays().items()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Makes :meth:`epochs` go on from a state of :meth:`to_arrays` of a run with the same arguments."""
        for name in self._stages:
            own = {key.removeprefix(f"{name}/"): a for key, a in arrays.items() if key.startswith(f"{name}/")}
            if own:
                self._restored[name] = own


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
