"""How V_phi is learned: the options, and the schedule of the learning rate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from mpcoffline.core.checks import check_integers, check_known, check_number
from mpcoffline.core.errors import InvalidArgumentError

from .methods import Expectile, ImplicitQ, Residual, TemporalDifference, ValueMethod

# The loss of each name, given the expectile tau.
_LOSSES: dict[str, Callable[[float], ValueMethod]] = {
    "residual": lambda tau: Residual(),
    "td": lambda tau: TemporalDifference(),
    "expectile": Expectile,
    "iql": ImplicitQ,
}
VALUE_METHODS = (*_LOSSES, "auto")


@dataclass(frozen=True)
class ValueConfig:
    """How V_phi is learned.

    Attributes:
        method: ``"residual"`` (the paper's (VALUE)), ``"td"``, ``"expectile"``, ``"iql"`` for noisy plants, or
            ``"auto"``: ``"iql"`` where the data are noisy
            (:func:`~mpcoffline.learning.estimate_stochasticity`), else ``"expectile"``.
        tau: The expectile, for ``"expectile"`` and ``"iql"``.
        n_steps: Gradient steps.
        batch_size: Transitions a step.
        learning_rate: Adam's at the start; falls to zero on a cosine.
        polyak: Rate at which the target network follows.
        hidden: Widths of the hidden layers.
        n_members: Networks that are learned, from different initial weights; V is their mean.
        validation: Share of the episodes that is held out; the weights with the smallest loss on them are kept. With
            0 all are learned from, and the last weights are kept.
        patience: Steps without a smaller validation loss after which learning stops; 0 for never.
    """

    method: str = "residual"
    tau: float = 0.3
    n_steps: int = 8_000
    batch_size: int = 256
    learning_rate: float = 1e-3
    polyak: float = 0.01
    hidden: tuple[int, ...] = (256, 256)
    n_members: int = 1
    validation: float = 0.0
    patience: int = 2_000

    def __post_init__(self) -> None:
        check_known("value method", self.method, VALUE_METHODS)
        if not 0.0 < self.tau < 1.0:
            raise InvalidArgumentError("tau", expected="a number in (0, 1)", actual=str(self.tau))
        check_integers(1, n_steps=self.n_steps, batch_size=self.batch_size, n_members=self.n_members)
        check_integers(1, **{f"hidden[{i}]": width for i, width in enumerate(self.hidden)})
        check_integers(0, patience=self.patience)
        check_number("learning_rate", self.learning_rate, 0.0)
        check_number("polyak", self.polyak, 0.0, 1.0)
        check_number("validation", self.validation, 0.0, 0.9, open_low=False)

    def build(self, *, noisy: bool = False) -> ValueMethod:
        """The loss.

        Args:
            noisy: What ``"auto"`` goes by.
        """
        name = ("iql" if noisy else "expectile") if self.method == "auto" else self.method
        return _LOSSES[name](self.tau)


def cosine(step: int, n_steps: int) -> float:
    """The cosine schedule from 1 at the first step to 0 at the last."""
    return 0.5 * (1.0 + math.cos(math.pi * (step - 1) / n_steps))
