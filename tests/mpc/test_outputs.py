"""Functions of what sensors show: which inputs they depend on, and their files."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc.expressions import function_to_json
from mpcoffline.mpc.outputs import feedthrough, outputs_from_json, outputs_of, shown

NUMBERS = st.floats(-3.0, 3.0)


def mixed(x: Any, u: Any) -> list[Any]:
    return [x[0], u[1] - x[1], ca.sin(x[0]) * u[0]]


def test_only_what_depends_on_inputs_is_given_them() -> None:
    h = outputs_of(mixed, 2, 2)
    assert (h.n_in(), feedthrough(h).tolist()) == (2, [False, True, True])
    for plain in ([1, 0], lambda x: x[0] ** 2, lambda x, u: x[1] + 0.0 * u[0], lambda x, scale=2.0: scale * x):
        alone = outputs_of(plain, 2, 2)
        assert alone.n_in() == 1
        assert not feedthrough(alone).any()
    assert outputs_of(h, 2, 2).n_in() == 2  # a CasADi function, too
    with pytest.raises(InvalidArgumentError, match="outputs: expected places of states, 0 to 1"):
        outputs_of([2], 2, 2)


@given(x=arrays(float, (3, 4, 2), elements=NUMBERS), acted=arrays(float, (3, 4, 3), elements=NUMBERS))
def test_rows_are_shown_as_one_by_one_and_files_say_the_same(x: Array, acted: Array) -> None:
    h = outputs_of(mixed, 2, 2)
    expected = np.stack([x[..., 0], acted[..., 1] - x[..., 1], np.sin(x[..., 0]) * acted[..., 0]], axis=-1)
    np.testing.assert_allclose(shown(h, x, acted), expected, atol=1e-14)
    again = outputs_from_json(function_to_json(h), 2, 2, 3)
    np.testing.assert_array_equal(shown(again, x, acted), shown(h, x, acted))
    np.testing.assert_array_equal(shown(h, x[0, 0], acted[0, 0]), shown(h, x, acted)[0, 0])
    np.testing.assert_array_equal(shown(outputs_of([1], 2, 2), x, acted), x[..., 1:])


@pytest.mark.parametrize("data", [None, [], {"inputs": 2}, {"inputs": [2, 1]}, {"inputs": [2, 2, 2]}, {"inputs": [2]}])
def test_a_damaged_file_is_refused(data: Any) -> None:
    with pytest.raises(FileFormatError, match="outputs"):
        outputs_from_json(data, 2, 2)
