"""What people call the coordinates of an observation and the inputs: names and units, carried along by a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.text import check_name, check_unit


class Label(NamedTuple):
    """A name and a unit.

    Attributes:
        name: The name.
        unit: The unit; empty where there is none.
    """

    name: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class Labels:
    """Names and units of the plant's states and of the inputs; none at all by default.

    Example:
        >>> labels = Labels(states=(Label("h1", "cm"), Label("h2", "cm")), inputs=(Label("pump", "V"),))
        >>> str(labels.inputs[0])
        'pump [V]'

    Args:
        states: A name and a unit a state, or none.
        inputs: One an input, or none.

    Raises:
        InvalidArgumentError: For names or units of other characters than names may have.
    """

    states: tuple[Label, ...] = ()
    inputs: tuple[Label, ...] = ()

    def __post_init__(self) -> None:
        for kind in ("states", "inputs"):
            labels = tuple(Label(*label) for label in getattr(self, kind))
            for label in labels:
                check_name(f"name of one of the {kind}", label.name)
                check_unit(f"unit of {label.name}", label.unit)
            object.__setattr__(self, kind, labels)

    def fitted(self, n_states: int, nu: int) -> Self:
        """These labels, if they are as many as states and inputs, or none.

        Raises:
            InvalidArgumentError: If they are not.
        """
        for what, labels, n in (("states", self.states, n_states), ("inputs", self.inputs, nu)):
            if len(labels) not in (0, n):
                raise InvalidArgumentError(f"labels of {what}", expected=f"{n} of them, or none", actual=str(labels))
        return self

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""
        return {"states": [list(label) for label in self.states], "inputs": [list(label) for label in self.inputs]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`."""
        states, inputs = (tuple(Label(name, unit) for name, unit in data[kind]) for kind in ("states", "inputs"))
        return cls(states, inputs)
