"""Two tanks, described: what tests of descriptions, simulations and logs share."""

from __future__ import annotations

from typing import Any

from mpcoffline import Input, Limit, Parameter, Plant, Signal, State


def root(h: Any) -> Any:
    return h / (h**2 + 0.01) ** 0.25


def dynamics(x: Any, u: Any, p: Any) -> list[Any]:
    between = p.c1 * root(x.h1)
    return [p.k * u.pump - between, between - p.c2 * root(x.h2)]


def two_tanks(**changes: Any) -> Plant:
    parts: dict[str, Any] = {
        "dt": 5.0,
        "states": [State("h1", "cm", 0, 40), State("h2", "cm", 0, 40)],
        "inputs": [Input("pump", "V", 0, 6)],
        "signals": [Signal("set_point", "cm", low=5, high=20)],
        "parameters": {"k": Parameter(0.07, unit="cm/s/V", spread=0.3), "c1": 0.07, "c2": 0.06},
        "dynamics": dynamics,
        "cost": lambda x, u, d: (x.h2 - d.set_point) ** 2 + 0.02 * u.pump**2,
        "limits": [Limit("overflow", "h1", high=35.0, soft=100.0)],
    }
    return Plant("two tanks", **parts | changes)
