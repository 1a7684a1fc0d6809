"""The combinations of options that have a name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mpcoffline.core.checks import check_known
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.learning import (
    METHODS,
    Bellman,
    CostConfig,
    Method,
    ParameterConfig,
    StartConfig,
    TerminalConfig,
    ValueConfig,
)

_DEFAULT = Bellman(
    least_discount=0.95,
    least_horizon=30,
    # What the user wrote is used as it is where the logged costs are just that.
    cost=CostConfig("auto"),
    # A model that cannot become the plant is adapted to what (FIT) needs of it; one that predicts well is left alone:
    # models of the wrong structure missed 13 % of an increment in the study, right ones less than 1 %, noise or not.
    identify=StartConfig(init="identified", adapt_above=0.03),
    value=ValueConfig(method="auto", tau=0.1, n_steps=3_000, learning_rate=2e-3, polyak=None),
    fit=ParameterConfig(n_steps=200, prediction_weight=0.1),
    # Half of it is a convex quadratic: a network alone has local minima, to which short plans fall. None is needed
    # where the learned MPC is linear-quadratic.
    terminal=TerminalConfig(method="auto", blend=0.5),
)

PRESETS: dict[str, Method] = {
    # The published recipe: (VALUE) by Bellman residual, then (FIT); discount, horizon and terminal cost are the MPC's.
    "paper": Bellman(),
    # What most users should get: the model by identification, the stage cost by (FIT), the terminal cost from V.
    "default": _DEFAULT,
    # The same at a third of the horizon, which leaves more to the terminal cost: it has to be closer to V.
    "fast": replace(_DEFAULT, least_horizon=10, terminal=replace(_DEFAULT.terminal, blend=0.25)),
    # Looking farther ahead, by V and by the plan: better wherever the model can become the plant, and more at the
    # mercy of its errors where it cannot. The larger discount gives V more to bridge, so it learns for longer.
    "best": replace(_DEFAULT, least_horizon=50, least_discount=0.97, value=replace(_DEFAULT.value, n_steps=6_000)),
}


def method_of(preset: str, method: str | Method | None, options: Mapping[str, Any]) -> Method:
    """The learning method of a preset, or one that is given, with options.

    Raises:
        UnknownIdError: For an unknown preset, method or option.
        InvalidArgumentError: For a preset beside a method, or an option out of range.
    """
    check_known("preset", preset, PRESETS)
    if method is not None and preset != "default":
        expected = "none beside a method: a preset names its own"
        raise InvalidArgumentError("preset", expected=expected, actual=repr(preset))
    if method is None:
        method = PRESETS[preset]
    elif not isinstance(method, Method):
        method = METHODS[method]()
    return method.replaced(options)
