"""(VALUE) in pieces: interruption, ensembles, held-out episodes, and data or settings that are hard on it."""

from __future__ import annotations

from typing import Any

import lq_plant
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mpcoffline.errors import FileFormatError
from mpcoffline.learning import VALUE_METHODS, ValueConfig, fit_value
from mpcoffline.learning.value import ValueTraining

Array = NDArray[np.float64]
GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.8, 0.8, 9)), axis=-1).reshape(-1, 2)
TINY: dict[str, Any] = {"hidden": (8, 8), "n_steps": 30, "batch_size": 64}


def training(config: ValueConfig, n: int = 300, seed: int = 0) -> ValueTraining:
    return ValueTraining(lq_plant.random_log(n), 0.9, config, seed=seed)


def same_arrays(found: dict[str, NDArray[Any]], wanted: dict[str, NDArray[Any]]) -> None:
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


# ---------------------------------------------------------------- interruption


@pytest.mark.parametrize(
    "options",
    [*({"method": method} for method in VALUE_METHODS), {"n_members": 2}, {"validation": 0.3, "n_steps": 400}],
)
@pytest.mark.parametrize("stop", [0, 7, 290])
def test_an_interrupted_training_ends_with_the_same_bits(options: dict[str, Any], stop: int) -> None:
    config = ValueConfig(**(TINY | options))
    whole, first, second = training(config), training(config), training(config)
    whole.advance(config.n_steps)
    first.advance(stop)
    second.restore({name: array.copy() for name, array in first.to_arrays().items()})
    assert second.step == first.step
    second.advance(config.n_steps)
    same_arrays(second.to_arrays(), whole.to_arrays())
    same_arrays(second.result.to_arrays(), whole.result.to_arrays())


@settings(max_examples=10)
@given(pieces=st.lists(st.integers(0, 12), max_size=6))
def test_the_pieces_do_not_matter(pieces: list[int]) -> None:
    config = ValueConfig(**TINY)
    whole, parts = training(config), training(config)
    whole.advance(config.n_steps)
    for n in [*pieces, config.n_steps]:
        parts.advance(n)
    same_arrays(parts.to_arrays(), whole.to_arrays())


def test_a_state_is_a_copy() -> None:
    running = training(ValueConfig(**TINY))
    running.advance(3)
    arrays, kept = running.to_arrays(), running.to_arrays()
    result = running.result
    before = result.predict(GRID)
    running.advance(10)
    same_arrays(arrays, kept)
    np.testing.assert_array_equal(result.predict(GRID), before)


def test_fit_value_is_the_training_from_start_to_end() -> None:
    config = ValueConfig(**TINY)
    running = training(config)
    running.advance(config.n_steps + 5)
    assert running.done
    assert running.step == running.n_steps == 30
    same_arrays(
        fit_value(lq_plant.random_log(300), 0.9, config, seed=0, epoch=7).to_arrays(), running.result.to_arrays()
    )


@pytest.mark.parametrize("damage", ["missing", "other network", "other method"])
def test_a_state_of_another_training_is_refused(damage: str) -> None:
    source = training(ValueConfig(**(TINY | {"hidden": (8, 9)}))) if damage == "other network" else None
    arrays = (source or training(ValueConfig(**TINY))).to_arrays()
    if damage == "missing":
        del arrays["counters"]
    config = ValueConfig(**(TINY | ({"method": "iql"} if damage == "other method" else {})))
    with pytest.raises(FileFormatError, match="state of a value training"):
        training(config).restore(arrays)
