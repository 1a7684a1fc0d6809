"""Names of any type are refused as unknown names, not by what happens to them on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import lq_plant
import numpy as np
import pytest

from mpcoffline import MPCPolicy, OfflineMPCLearner, make_solver, nominal_mpc
from mpcoffline.core.checks import check_known, checked_seed
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.datasets import load_dataset
from mpcoffline.gallery import collect
from mpcoffline.learning import StartConfig, TerminalConfig
from mpcoffline.learning.terminal import TERMINAL_KINDS
from mpcoffline.studies.setups import setup_of

MPC = lq_plant.make_mpc()
LOOKUPS: dict[str, Callable[[Any], Any]] = {
    "make_solver": lambda name: make_solver(MPC, name),
    "MPCPolicy": lambda name: MPCPolicy(MPC, solver=name),
    "preset": lambda name: OfflineMPCLearner(MPC, preset=name),
    "value": lambda name: OfflineMPCLearner(MPC, value=name if name is not None else 3),
    "terminal": lambda name: TerminalConfig(method=name),
    "init": lambda name: StartConfig(init=name),
    "nominal_mpc": nominal_mpc,
    "collect": lambda name: collect(name, progress=False),
    "setup_of": lambda name: setup_of(name, 1.0, 0),
    "load_dataset": load_dataset,
}
WRONG = [None, 3, 2.5, True, b"ddp", ["ddp"], {"name": "ddp"}, ("ddp",), np.array(["ddp", "lqr"]), object(), "ddpp"]


@pytest.mark.parametrize("lookup", LOOKUPS)
@pytest.mark.parametrize("name", WRONG, ids=lambda name: type(name).__name__)
def test_names_of_any_type_are_unknown_names(lookup: str, name: Any) -> None:
    with pytest.raises(UnknownIdError, match=r"expected one of .*, got "):
        LOOKUPS[lookup](name)


def test_the_nearest_name_is_proposed_for_texts_alone() -> None:
    with pytest.raises(UnknownIdError, match=r"kind: expected one of network, .*Did you mean 'network'"):
        check_known("kind", "netwrok", TERMINAL_KINDS)
    error = UnknownIdError.of("kind", 5, TERMINAL_KINDS)
    assert (error.actual, error.hint) == ("5", "")
    for name in TERMINAL_KINDS:
        check_known("kind", np.str_(name), TERMINAL_KINDS)


@pytest.mark.parametrize("kind", [int, np.int32, np.uint64])
def test_seeds_become_integers_of_python(kind: Any) -> None:
    assert type(checked_seed("seed", kind(7))) is int
    assert type(setup_of("pendulum", 1.0, kind(7)).seed) is int
    with pytest.raises(InvalidArgumentError, match="seed: expected an integer >= 0"):
        checked_seed("seed", -1)
