"""Logs of two tanks as text, right and wrong in one way each."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from two_tanks import two_tanks

from mpcoffline import Plant

START = np.datetime64("2026-03-02T06:00:00")


class Log(NamedTuple):
    """Columns of a log, one row every 5 s."""

    t: Any
    h1: Any
    h2: Any
    pump: Any
    set_point: Any


def simulated(n: int = 60, dt: float = 5.0, seed: int = 0, **changes: Any) -> Log:
    """What two tanks do, with test signals: levels exact to 1e-4 cm."""
    plant: Plant = two_tanks(**changes)
    rng = np.random.default_rng(seed)
    model = plant.mpc().model
    every = max(1, round(5.0 / dt))
    x, rows = np.array([9.0, 7.0]), []
    pump, set_point = 3.0, 10.0
    function, theta = model.ode, model.space.theta
    for k in range(n):
        if k % every == 0:
            pump = round(float(np.clip(3.0 + rng.normal(), 0, 6)), 2)
            set_point = float(rng.integers(8, 14)) if rng.random() < 0.1 else set_point
        rows.append((dt * k, *np.round(x, 4), pump, set_point))
        for _ in range(4):
            x = x + dt / 4 * function(x, [pump, set_point], theta).full().ravel()
    return Log(*np.array(rows).T)


def stamps(log: Log) -> Any:
    return START + (1000 * log.t).astype("timedelta64[ms]")


def text(log: Log, header: str = "time,h1 [cm],h2 [cm],pump,set_point", times: list[str] | None = None) -> str:
    times = [f"{t:g}" for t in log.t] if times is None else times
    rows = (
        f"{t},{a:.4f},{b:.4f},{u:g},{s:g}" for t, (a, b, u, s) in zip(times, zip(*log[1:], strict=True), strict=True)
    )
    return "\n".join([header, *rows]) + "\n"
