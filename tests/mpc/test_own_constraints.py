"""Constraints of one's own: what solvers see of them, and how they are saved."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.mpc import CONSTRAINTS, MPC, AnyConstraint, Constraint, Model, QuadraticCost, StateBounds
from mpcoffline.mpc.constraints import Sizes


class Disc(AnyConstraint):
    """|x| <= radius."""

    def __init__(self, radius: float) -> None:
        self.radius = radius

    def fitted(self, sizes: Sizes) -> Constraint | StateBounds:
        return Constraint(lambda x, u, p: ca.sumsqr(x) - self.radius**2, "disc").fitted(sizes)


@dataclass(frozen=True, eq=False)
class Signed(Constraint):
    """A constraint that knows who asked for it."""

    author: str = ""

    def to_json(self) -> dict[str, Any]:
        return super().to_json() | {"author": self.author}

    @classmethod
    def from_json(cls, data: Mapping[str, Any], sizes: Sizes) -> Self:
        plain = Constraint.from_json(data, sizes)
        return cls(plain.function, plain.name, plain.soft, plain.terminal, str(data["author"]))


def problem(*constraints: Any) -> MPC:
    model = Model(lambda x, u, p: x + u[0], 2, 1, 0.1, discrete=True)
    cost = QuadraticCost(np.eye(2))
    return MPC(model, cost, cost, 2, 0.9, [-1.0], [1.0], list(constraints))


def again(document: dict[str, Any]) -> MPC:
    return MPC.from_json(json.loads(json.dumps(document)))


def test_an_own_constraint_is_saved_as_what_solvers_see() -> None:
    document = problem(Disc(2.0), Signed(lambda x, u, p: u - 0.5, "signed", author="me")).to_json()
    assert [entry["kind"] for entry in document["constraints"]] == ["Constraint"] * 2
    loaded = again(document)
    assert [constraint.name for constraint in loaded.constraints_at("stages")] == ["disc", "signed"]
    assert loaded.constraint_function is not None
    found = loaded.constraint_function([1.0, 2.0], [0.25], loaded.theta)
    np.testing.assert_allclose(np.asarray(found).ravel(), [1.0, -0.25])


def test_a_registered_one_is_saved_as_its_class_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CONSTRAINTS, "_things", dict(CONSTRAINTS.items()))
    CONSTRAINTS.add("signed", Signed)
    mpc = problem(Signed(lambda x, u, p: u - 0.5, author="me"))
    document = mpc.to_json()
    (loaded,) = again(document).constraints_at("stages")
    assert isinstance(loaded, Signed)
    assert loaded.author == "me"
    assert mpc.to_json(portable=True)["constraints"][0]["kind"] == "Constraint"
    monkeypatch.undo()
    with pytest.raises(FileFormatError, match="constraint: expected a constraint that is known here"):
        again(document)


def test_what_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidArgumentError, match="unique names"):
        problem(Disc(1.0), Disc(2.0))
    monkeypatch.setattr(Disc, "fitted", lambda self, sizes: None)
    with pytest.raises(InvalidArgumentError, match="fitted: expected a Constraint or StateBounds, got None"):
        problem(Disc(1.0))
    with pytest.raises(InvalidArgumentError, match="expected the methods from_json, to_json"):
        CONSTRAINTS.add("disc", Disc)
    assert "disc" not in CONSTRAINTS
