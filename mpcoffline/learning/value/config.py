"""How V_phi is learned: the options, and the schedule of the learning rate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from mpcoffline.core.checks import check_integers, check_known, check_number

from .methods import VALUE_METHODS, ValueMethod, check_tau, method_from_json, method_to_json

SWEEPS = 3.0  # times 1 / (1 - gamma): how often the target must have followed
_LEAST_SWEEPS = 1.5  # the same for a rate that is not given: a faster one costs stability
_POLYAK = (0.02, 0.2)  # the slowest and the fastest of a rate that is not given


@dataclass(frozen=True)
class ValueConfig:
    """How V_phi is learned.

    Attributes:
        method: ``"residual"`` (the paper's (VALUE)), ``"td"``, ``"expectile"``, ``"iql"`` for noisy plants, another
            name in ``VALUE_METHODS``, or ``"auto"``: ``"iql"`` where the data are noisy
            (:func:`~mpcoffline.learning.estimate_stochasticity`), else ``"expectile"``; or a method itself.
        tau: The expectile of methods that are named and have one, as ``"expectile"`` and ``"iql"``.
        n_steps: Gradient steps.
        batch_size: Transitions a step.
        learning_rate: Adam's at the start; falls to zero on a cosine.
        polyak: Rate at which the target network follows; None for 0.02, or faster where V would not settle in
            ``n_steps`` at the discount (:meth:`rate`), up to 0.2.
        hidden: Widths of the hidden layers.
        n_members: Networks that are learned, from different initial weights; V is their mean.
        validation: Share of the episodes that is held out; the weights with the smallest loss on them are kept. With
            0 all are learned from, and the last weights are kept.
        patience: Steps without a smaller validation loss after which learning stops; 0 for never.
    """

    method: str | ValueMethod = "residual"
    tau: float = 0.3
    n_steps: int = 8_000
    batch_size: int = 256
    learning_rate: float = 1e-3
    polyak: float | None = 0.01
    hidden: tuple[int, ...] = (256, 256)
    n_members: int = 1
    validation: float = 0.0
    patience: int = 2_000

    def __post_init__(self) -> None:
        if not isinstance(self.method, ValueMethod):
            check_known("value method", self.method, ("auto", *VALUE_METHODS))
        check_tau(self.tau)
        check_integers(1, n_steps=self.n_steps, batch_size=self.batch_size, n_members=self.n_members)
        check_integers(1, **{f"hidden[{i}]": width for i, width in enumerate(self.hidden)})
        check_integers(0, patience=self.patience)
        check_number("learning_rate", self.learning_rate, 0.0)
        if self.polyak is not None:
            check_number("polyak", self.polyak, 0.0, 1.0)
        check_number("validation", self.validation, 0.0, 0.9, open_low=False)

    def rate(self, discount: float) -> float:
        """The rate at which the target network follows.

        The values that it holds travel back one step each time that it has followed: they have settled after some
        ``1 / (1 - gamma)`` times.
        """
        if self.polyak is not None:
            return self.polyak
        needed = _LEAST_SWEEPS / max(self.n_steps * (1.0 - discount), 1e-12)
        return min(max(needed, _POLYAK[0]), _POLYAK[1])

    def settles(self, discount: float) -> bool:
        """Whether the target follows often enough."""
        sweeps = self.rate(discount) * self.n_steps * (1.0 - discount)
        return sweeps >= (1.0 - 1e-9) * (_LEAST_SWEEPS if self.polyak is None else SWEEPS)

    def build(self, *, noisy: bool = False) -> ValueMethod:
        """The loss.

        Args:
            noisy: What ``"auto"`` goes by.
        """
        if isinstance(self.method, ValueMethod):
            return self.method
        kind: Any = VALUE_METHODS[("iql" if noisy else "expectile") if self.method == "auto" else self.method]
        method: ValueMethod = kind(tau=self.tau) if hasattr(kind, "tau") else kind()
        return method

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; of a method of one's own, its name and its fields.

        Raises:
            InvalidArgumentError: For a method that no file can hold.
        """
        how = self.method if isinstance(self.method, str) else method_to_json(self.method)
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"hidden": list(self.hidden), "method": how}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ValueConfig:
        """The inverse of :meth:`to_json`.

        Raises:
            FileFormatError: For a method that nobody has registered.
        """
        how = data["method"]
        method = method_from_json(how) if isinstance(how, dict) else how
        return cls(**(dict(data) | {"hidden": tuple(data["hidden"]), "method": method}))


def cosine(step: int, n_steps: int) -> float:
    """The cosine schedule from 1 at the first step to 0 at the last."""
    return 0.5 * (1.0 + math.cos(math.pi * (step - 1) / n_steps))
