"""What a line says of an MPC: names, units, values."""

from __future__ import annotations

import numpy as np
from two_tanks import two_tanks

from mpcoffline import MPC, Model, QuadraticCost


def test_a_described_plant_is_told_by_name_and_unit() -> None:
    mpc = two_tanks().mpc()
    text = repr(mpc)
    assert text.startswith("MPC(h1 [cm], h2 [cm], set_point [cm] -> pump [V], 0 to 6; horizon ")
    assert f"horizon {mpc.horizon} of 5 s, discount {mpc.discount:g}; Model(" in text
    value, unit = float(mpc.values["model.k"]), next(block.unit for block in mpc.space if block.name == "model.k")
    assert f"k = {value:.4g} {unit}" in text


def test_what_has_no_names_is_told_too() -> None:
    model = Model(lambda x, u, p: p["A"] @ x + u[0], 2, 1, 0.5, {"A": np.eye(2), "m": 2.5})
    mpc = MPC(model, QuadraticCost(np.eye(2)), QuadraticCost(np.eye(2)), 7, 0.9, [-1.0], [1.0])
    assert repr(mpc) == (
        "MPC(observation 0, observation 1 -> action 0, -1 to 1; horizon 7 of 0.5 s, discount 0.9; "
        f"Model(A (2, 2), m = 2.5); stage cost {mpc.stage_cost!r}; terminal cost {mpc.terminal_cost!r})"
    )


def test_of_many_parameters_the_first_are_told() -> None:
    parameters = {f"k{i}": float(i + 1) for i in range(40)}
    model = Model(lambda x, u, p: sum(p[name] for name in parameters) * x + u, 1, 1, 1.0, parameters)
    assert repr(model).endswith("k11 = 12 and 28 more)")
