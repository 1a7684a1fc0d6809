"""Registries: what is added, what is refused, what a file may name."""

from __future__ import annotations

from abc import ABC, abstractmethod

import pytest

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.core.registry import Registry


class Shape(ABC):
    @abstractmethod
    def area(self) -> float: ...


@pytest.fixture
def shapes() -> Registry[type[Shape]]:
    registry: Registry[type[Shape]] = Registry("shape", Shape, methods=("corners|radius",))

    @registry.register("square")
    class Square(Shape):
        corners = 4

        def area(self) -> float:
            return 1.0

    return registry


def test_names_give_what_was_registered(shapes: Registry[type[Shape]]) -> None:
    assert list(shapes) == ["square"]
    assert shapes["square"]().area() == 1.0
    assert shapes.of_file("square", "a.zip") is shapes["square"]
    assert shapes.add("square", shapes["square"]) is shapes["square"]
    assert shapes.name_of(shapes["square"]) == "square"
    assert shapes.name_of(shapes["square"], shared=True) == ""  # of this test
    assert shapes.name_of(Shape) == ""


@pytest.mark.parametrize("name", ["sqare", 3, None, b"square", ["square"]])
def test_other_names_are_unknown(name: object, shapes: Registry[type[Shape]]) -> None:
    with pytest.raises(UnknownIdError, match="shape: expected one of square"):
        shapes[name]  # type: ignore[index]
    assert name not in shapes
    with pytest.raises(FileFormatError, match="import what registers that shape first"):
        shapes.of_file(name, "a.zip")


def test_what_is_refused(shapes: Registry[type[Shape]]) -> None:
    class Round(Shape):
        corners = 0

        def area(self) -> float:
            return 3.0

    class Cornerless(Shape):
        def area(self) -> float:
            return 3.0

    class Abstract(Shape):
        corners = 2

    with pytest.raises(InvalidArgumentError, match="expected a name that is free, got taken"):
        shapes.add("square", Round)
    with pytest.raises(InvalidArgumentError, match=r"expected the methods corners\|radius"):
        shapes.add("round", Cornerless)
    with pytest.raises(InvalidArgumentError, match="expected the methods area"):
        shapes.register("round")(Abstract)
    with pytest.raises(InvalidArgumentError, match="expected a Shape"):
        shapes.add("round", int)  # type: ignore[arg-type]
    for name in ("", "a b", "../x", "a" * 65, 3, None):
        with pytest.raises(InvalidArgumentError, match="expected a name of letters"):
            shapes.add(name, Round)  # type: ignore[arg-type]
    assert list(shapes) == ["square"]
