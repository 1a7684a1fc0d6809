"""The parts of a learning method: stages, one after another, which can stop between any two steps, and go on."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .bellman.potential import Potential
from .progress import Metrics
from .value.function import ValueFunction

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class FitResult:
    """What a fit found.

    Attributes:
        theta: The learned parameters, ``(size,)``.
        loss_before: The loss of the method where it began; for (FIT) the regression error in units of the cost's
            variance.
        loss_after: The same at theta.
        at_bounds: Names of the learned parameters that ended on a bound.
        potential: The potential that was fitted with the cost, if one was.
    """

    theta: NDArray[np.float64]
    loss_before: float
    loss_after: float
    at_bounds: tuple[str, ...] = ()
    potential: Potential | None = None

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description, without theta."""
        return {
            "loss_before": self.loss_before,
            "loss_after": self.loss_after,
            "at_bounds": list(self.at_bounds),
            "potential": None if self.potential is None else self.potential.to_json(),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], theta: NDArray[np.float64]) -> FitResult:
        """The inverse of :meth:`to_json`."""
        potential = None if data["potential"] is None else Potential.from_json(data["potential"])
        at_bounds = tuple(map(str, data["at_bounds"]))
        return cls(theta, float(data["loss_before"]), float(data["loss_after"]), at_bounds, potential)


@dataclass(frozen=True)
class Known:
    """What is known between two stages of a fit.

    Attributes:
        mpc: The MPC with what is learned of it so far.
        table: The transitions, without what was taken out of them so far.
        groups: The parameter groups that are learned, ``("cost",)`` or ``("cost", "model")``.
        seed: Seeds everything.
        device: Torch device for what is large.
        value_function: V_phi, given or learned; None before.
        model_error: What the model misses in one step, as share of an increment (root mean square); None where it was
            not identified.
        result: What the fit found; the last stage leaves one.
    """

    mpc: MPC
    table: TransitionTable
    groups: tuple[str, ...] = ("cost", "model")
    seed: int = 0
    device: str = "cpu"
    value_function: ValueFunction | None = None
    model_error: float | None = None
    result: FitResult | None = None

    @property
    def constant_value(self) -> ValueFunction:
        """V_phi as a constant on the CPU, a copy.

        Raises:
            InvalidArgumentError: If no stage before has learned one.
        """
        if self.value_function is None:
            raise InvalidArgumentError("stages", expected="one that learns V before this one", actual="none")
        return copy.deepcopy(self.value_function).cpu().eval().requires_grad_(False)


class Stage(ABC):
    """A stretch of a fit: takes what is known, and adds to it.

    A fit calls ``begin``, perhaps ``restore``, then ``advance`` until it is ``done``, then ``outcome``. ``begin`` may
    be called again, for a new start.

    Attributes:
        phase: What it does, for people.
        quick: Whether it takes no steps: then only ``begin`` and ``outcome`` are called, also, where no later stage
            takes any, at the end of an epoch of the one before, to find the MPC that would be handed out now.
        epoch: Steps between two entries of the history.
        step: Steps made; it may fall where a stage starts again.
        n_steps: Steps in all.
        known: What it began with.
    """

    phase: str = ""
    quick: bool = False
    epoch: int = 100
    step: int = 0
    n_steps: int = 0
    known: Known

    def begin(self, known: Known) -> None:
        """Starts anew from what is known."""
        self.known = known

    @property
    def done(self) -> bool:
        """Whether no step is left to make."""
        return self.step >= self.n_steps

    def advance(self, n: int) -> Metrics:
        """Makes n more steps, fewer at the end; returns means over them, by name."""
        return {}

    @abstractmethod
    def outcome(self) -> Known:
        """What is known if the stage ends now."""

    def to_arrays(self) -> Arrays:
        """What :meth:`restore` needs to go on bit for bit."""
        return {}

    def restore(self, arrays: Arrays) -> None:
        """Goes on from a state of :meth:`to_arrays` of a stage that began with the same.

        Raises:
            FileFormatError: If arrays are missing or of another problem.
        """
        raise FileFormatError("state of a stage", expected="none", actual=", ".join(arrays)[:200])
