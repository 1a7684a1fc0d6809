"""What arguments may be, and how others are refused."""

from __future__ import annotations

import numpy as np
import pytest

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError


@pytest.mark.parametrize("good", [1, 7, np.int64(3), np.uint8(1)])
def test_integers_of_python_and_numpy_are_taken(good: object) -> None:
    check_integers(1, n=good)


@pytest.mark.parametrize("bad", [0, -1, 1.0, 2.7, True, np.nan, "3", None, [1], np.float64(2.0)])
def test_anything_else_is_no_positive_integer(bad: object) -> None:
    with pytest.raises(InvalidArgumentError, match="n: expected a positive integer, got "):
        check_integers(1, one=1, n=bad)


def test_the_lowest_integer_is_named() -> None:
    with pytest.raises(InvalidArgumentError, match="seed: expected an integer >= 0, got -1"):
        check_integers(0, seed=-1)


@pytest.mark.parametrize("bad", [0.0, -1.0, 2.1, np.nan, np.inf, True, "1", None])
def test_numbers_outside_the_interval_are_refused(bad: object) -> None:
    with pytest.raises(InvalidArgumentError, match="x: expected a finite number above 0 to 2, got "):
        check_number("x", bad, 0.0, 2.0)


def test_ends_of_the_interval() -> None:
    check_number("x", 2.0, 0.0, 2.0)
    check_number("x", 0, 0.0, open_low=False)
    check_number("x", np.float32(1e30), 0.0)
