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
from mpcoffline.core.text import listed
from mpcoffline.datasets.table.memory import remembering, with_memory
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.estimation.beginnings import beginnings
from mpcoffline.learning import FitResult, Known, Method, Stage, Training, ValueFunction
from mpcoffline.learning.ends import innermost, inside
from mpcoffline.learning.stages import Arrays, Change
from mpcoffline.mpc import MPC


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

    method: Method

    def __init__(self, method: Method, start: Known) -> None:
        mpc = start.mpc
        for data in (start.table, start.shards):
            if data is not None:
                data.check_fits(mpc.ny, mpc.nu, np.asarray(mpc.action_low), np.asarray(mpc.action_high))
        _check_device(start.device)
        self.method, self._start = method, start
        self._mpc = method.restructured(mpc.replace(model=mpc.model.suited_to_log(start.table)))
        _check_discount(start.value_function, self._mpc.discount)
        self._outcome: Callable[[], Known] | None = None
        self.value_function = start.value_function
        self.result: FitResult | None = None
        self._trainings: dict[str, Training] = {}
        self._restored: dict[str, Arrays] = {}

    def epochs(
        self,
        n_steps: int | None = None,
        tell: Callable[[str], None] = lambda _: None,
        foresee: Callable[[list[MPC]], None] = lambda _: None,
    ) -> Iterator[Epoch]:
        """Runs the stages; yields at the end of each epoch.

        Args:
            n_steps: Steps in an epoch; by default what each stage says.
            tell: Is told the name of what begins now and has no epochs.
            foresee: Is given, before the first step, MPCs of the form that will be tried at the end.

        Raises:
            InvalidDataError: If the data do not fit.
            MPCOfflineError: If a regression fails.
        """
        tell("looking at the data")
        known = self._prepared()
        self.value_function = known.value_function
        stages, total = list(self.method.stages().items()), 0
        while stages:
            (name, stage), *stages = stages
            tell(name)
            if not isinstance(stage, Stage):
                known = stage(known)
                continue
            if not self._trainings:
                foresee(self.method.foreseen(known))
            training = stage.begin(known)
            if training is None:
                continue
            self._trainings[name] = training
            if name in self._restored:
                training.restore(self._restored.pop(name))
            changes = [later for _, later in stages if not isinstance(later, Stage)]
            while not training.done:
                metrics = training.advance(n_steps or stage.epoch)
                _check_alike(known.shards, stage.phase, training)
                if len(changes) == len(stages):  # the last stage with steps; what is found once holds until the next
                    self._outcome = functools.cache(functools.partial(_ended, known, stage, training, changes))
                    if _is_done(training):
                        tell(listed([later for later, _ in stages]) or name)
                        self.result = self._outcome().result
                yield Epoch(stage.phase, training.step, training.n_steps, total + training.step, metrics)
            if self._outcome is not None:
                return
            known, total = stage.outcome(known, training), total + training.step
            self.value_function = known.value_function
        self._outcome, self.result = lambda: _complete(known), _complete(known).result
        yield Epoch("learning", 1, 1, total + 1, {})

    def _prepared(self) -> Known:
        """What the stages begin with: past inputs beside the observations where the MPC holds some, then trimmed."""
        known = self.method.prepared(replace(self._start, mpc=self._mpc, given=self._start.mpc))
        layout, discount = known.mpc.layout, known.mpc.discount
        table, shards = with_memory(known.table, layout), known.shards
        begun, how = beginnings(known.table, layout, known.seed), (self.method.trim, discount, layout.n_states)
        if shards is not None and layout.n_memory:
            shards = shards.mapped(functools.partial(remembering, layout=layout))
        if shards is not None and (trimmed := inside(table, *how)) is not None:
            shards = shards.mapped(trimmed)
        return replace(known, table=innermost(table, *how), begun=begun, shards=shards)

    @property
    def learned(self) -> Callable[[], MPC] | None:
        """The MPC that would be handed out now, found when called; None before the last stage that takes steps."""
        outcome = self._outcome
        return None if outcome is None else lambda: outcome().mpc

    @property
    def known(self) -> Known:
        """What is known at the end, once all is done."""
        if self._outcome is None:
            raise InvalidArgumentError("run", expected="one that is done", actual="one before its end")
        return self._outcome()

    @property
    def identity(self) -> str:
        """What decides the result (data, MPC, method, options, seed) as a SHA-256."""
        start = self._start
        described = {
            "nominal": start.mpc.to_json(),
            "groups": start.groups,
            "method": self.method.name,
            "options": self.method.to_json(),
            "seed": start.seed,
        }
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
        for column in (start.table.rows, start.table.episode_ids, *start.table.centring):
            digest.update(np.ascontiguousarray(column).data)
        if start.shards is not None:
            digest.update(start.shards.identity)
        if start.start is not None:
            digest.update(json.dumps(start.start.to_json(), sort_keys=True).encode())
        if start.value_function is not None:
            for array in start.value_function.to_arrays().values():
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
        """Makes :meth:`epochs` go on from a state of :meth:`to_arrays` of a run with the same arguments."""
        for key, array in arrays.items():
            name, _, own = key.partition("/")
            self._restored.setdefault(name, {})[own] = array


def _check_alike(shards: ShardedTable | None, phase: str, training: Training) -> None:
    """Refuses to go on where the processes of a job have learned different things."""
    if shards is not None and shards.ranks.size > 1:
        state = b"".join(np.ascontiguousarray(array).tobytes() for _, array in sorted(training.to_arrays().items()))
        shards.ranks.check_alike(f"state of {phase}", state)


def _is_done(training: Training) -> bool:
    return training.done


def _ended(known: Known, stage: Stage, training: Training, changes: list[Change]) -> Known:
    """What is known if the last stage with steps ends now."""
    known = stage.outcome(known, training)
    for change in changes:
        known = change(known)
    return _complete(known)


def _complete(known: Known) -> Known:
    if known.result is None:
        raise InvalidArgumentError("stages", expected="one that leaves a result", actual="none")
    return known


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
