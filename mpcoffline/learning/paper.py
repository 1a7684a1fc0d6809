"""MPC_2 and MPC_3 of arXiv:2301.01667 as published."""

from __future__ import annotations

from dataclasses import dataclass, field

from mpcoffline.core.errors import InvalidArgumentError

from .bellman.regression import ParameterConfig
from .bellman.stages import LearnParameters, LearnValue
from .method import METHODS, Method
from .stages import Stage
from .value.config import ValueConfig


@METHODS.register("paper")
@dataclass(frozen=True)
class Paper(Method):
    """The published recipe: V_phi by (VALUE), then theta by (FIT); the terminal cost stays the given one.

    Attributes:
        value: How V_phi is learned.
        fit: How theta is learned.
    """

    value: ValueConfig = field(default_factory=ValueConfig)
    fit: ParameterConfig = field(default_factory=ParameterConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fit.potential:
            hint = "Take method='bellman' with terminal='network' or 'quadratic'."
            expected = "a terminal cost from V, as T = V - Phi"
            raise InvalidArgumentError("potential", expected=expected, actual="the given one", hint=hint)

    def stages(self) -> dict[str, Stage]:
        """(VALUE) and (FIT)."""
        return {"value": LearnValue(self.value), "fit": LearnParameters(self.fit)}
