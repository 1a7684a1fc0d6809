"""Logs of three described plants, sound or with one planted defect each, and the words that name it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from two_tanks import two_tanks

from mpcoffline import Input, InvalidDataError, Parameter, Plant, Signal, State
from mpcoffline.tune import check_log

Columns = dict[str, Any]


def heater() -> Plant:
    return Plant(
        "heater",
        dt=5.0,
        states=[State("T", "°C", -50, 400, start=(25, 45), noise=0.05)],
        inputs=[Input("power", "%", 0, 100)],
        signals=[Signal("ambient", "°C", low=10, high=30)],
        parameters={"K": Parameter(0.75, spread=0.3), "tau": Parameter(90.0, unit="s", spread=0.3)},
        dynamics=lambda x, u, d, p: [(d.ambient + p.K * u.power - x.T) / p.tau],
        cost={"T": 1.0, "power": 0.002},
        references={"T": 55.0},
    )


def motor() -> Plant:
    return Plant(
        "motor",
        dt=0.01,
        states=[
            State("i", "A", -1e5, 1e5, start=0.0, noise=0.05),
            State("w", "rad/s", -1e5, 1e5, start=0.0, noise=0.3),
        ],
        inputs=[Input("v", "V", -24, 24)],
        signals=[Signal("wanted", "rad/s", low=-150, high=150)],
        parameters={
            "R": Parameter(0.5, spread=0.3),
            "k": Parameter(0.1, spread=0.3),
            "b": Parameter(0.004, spread=0.3),
        },
        dynamics=lambda x, u, p: [
            (u.v - p.R * x.i - p.k * x.w) / 0.02,
            (p.k * x.i - p.b * x.w - 0.05 * ca.tanh(x.w)) / 0.002,
        ],
        cost={"w": 1.0, "v": 0.01},
        references={"w": "wanted"},
    )


#: Each plant: its controller's gain and offset from what it tracks, and how strongly it explores.
PLANTS: dict[str, Callable[[], Plant]] = {"tanks": lambda: tanks(), "heater": heater, "motor": motor}


def tanks(**changes: Any) -> Plant:
    """Two tanks with sensors of 0.05 cm."""
    levels = [State(name, "cm", 0, 40, start=(5, 15), noise=0.05) for name in ("h1", "h2")]
    return two_tanks(**{"states": levels} | changes)


def logged(
    kind: str, seed: int, n: int = 600, *, explore: float = 1.0, noise: float = 1.0, pump: Any = None
) -> Columns:
    """What a plant does that differs from its description by its spreads, under a controller that explores."""
    plant = PLANTS[kind]()
    env = plant.env(noise=noise, steps=n + 1)
    y, _ = env.reset(seed=seed)
    rng, offset, rows = np.random.default_rng(seed), 0.0, []
    low, high = (float(v[0]) for v in plant.action_bounds)
    for k in range(n):
        x = np.asarray(y, dtype=np.float64)
        if rng.random() < 0.2:
            offset = explore * 0.25 * (high - low) * rng.normal()
        wanted = _feedback(kind, x)
        u = float(np.clip(wanted + offset, low, high)) if pump is None else float(pump(k, x))
        rows.append((*x, u))
        y, *_ = env.step(np.array([u], np.float32))
    names = [*plant.names("states"), *plant.names("signals"), *plant.names("inputs")]
    return {"time": plant.dt * np.arange(n)} | dict(zip(names, np.array(rows).T, strict=True))


def _feedback(kind: str, x: Any) -> float:
    """What each plant's controller asks for."""
    if kind == "tanks":
        return float(3.0 + 0.5 * (x[2] - x[1]))
    return float(45.0 + 2.0 * (55.0 - x[0])) if kind == "heater" else float(0.14 * x[2] + 0.02 * (x[2] - x[1]))


class Case(NamedTuple):
    """A log: the plant, its columns, and a word that must be in what is found; none of a sound log."""

    name: str
    kind: str
    columns: Callable[[], Columns]
    words: tuple[str, ...] = ()


def short_episodes(seed: int) -> Columns:
    """Five short episodes of the heater."""
    log = logged("heater", seed, 200)
    return log | {"time": log["time"] + 100.0 * (np.arange(200) // 40)}


def changed(columns: Columns, **others: Any) -> Columns:
    return columns | others


def _swapped() -> Columns:
    c = logged("tanks", 1)
    return changed(c, h1=c["h2"], h2=c["h1"])


def _stuck() -> Columns:
    c = logged("tanks", 3)
    h2 = c["h2"].copy()
    h2[200:300] = h2[200]
    return changed(c, h2=h2)


def _slower() -> Columns:
    """Decided and logged every 15 s; the description says 5 s, and the log has no time."""
    return {name: v for name, v in _differing("tanks", 4, tanks(dt=15.0)).items() if name != "time"}


def _row_late() -> Columns:
    c = logged("motor", 5)
    return changed(c, v=np.append(c["v"][:1], c["v"][:-1]))


def _leak() -> Columns:
    c = logged("tanks", 6)
    rng = np.random.default_rng(6)
    other = np.cumsum(rng.normal(size=600) * 0.5)
    other -= np.linspace(other[0], other[-1], 600)
    return changed(
        c, h1=np.clip(c["h1"] + 3 * np.abs(other), 0, 40), h2=np.clip(c["h2"] + 2 * np.roll(np.abs(other), 50), 0, 40)
    )


def defects() -> Iterator[Case]:
    """One defect each."""
    yield Case(
        "kelvin in place of degrees Celsius",
        "heater",
        lambda: changed(c := logged("heater", 0), T=c["T"] + 273.15),
        ("kelvin",),
    )
    yield Case("two columns exchanged", "tanks", _swapped, ("h1 and h2 are exchanged",))
    yield Case("dead time of 3 steps", "tanks", lambda: _delayed(2, 3), ("pump acts 3 steps late",))
    yield Case("a sensor that is stuck", "tanks", _stuck, ("stuck at",))
    yield Case("another sampling time", "tanks", _slower, ("sampling time",))
    yield Case("sign of an input", "motor", lambda: changed(c := logged("motor", 1), v=-c["v"]), ("sign of v",))
    yield Case(
        "rpm in place of rad/s", "motor", lambda: changed(c := logged("motor", 2), w=9.5493 * c["w"]), ("w", "unit")
    )
    yield Case(
        "an input that never moves", "tanks", lambda: logged("tanks", 7, pump=lambda k, x: 3.0), ("input that varies",)
    )
    yield Case(
        "an input without test signals",
        "tanks",
        lambda: logged("tanks", 8, noise=0.0, pump=lambda k, x: 3 + 0.1 * (12 - x[1])),
        ("test signals",),
    )
    yield Case(
        "a column that was not applied",
        "tanks",
        lambda: changed(logged("tanks", 9), pump=np.random.default_rng(9).uniform(0, 6, 600)),
        ("does something",),
    )
    yield Case("actions a row late", "motor", _row_late, ("actions",))
    yield Case("something else moves the plant", "tanks", _leak, ("structure", "model"))


def _delayed(seed: int, steps: int) -> Columns:
    """A log of tanks whose input acts late, which the description does not say."""
    return _differing("tanks", seed, tanks(inputs=[Input("pump", "V", 0, 6, delay=steps)]))


def _differing(kind: str, seed: int, plant: Plant) -> Columns:
    """A log of another plant than the described one."""
    original = PLANTS[kind]
    PLANTS[kind] = lambda: plant
    try:
        return logged(kind, seed)
    finally:
        PLANTS[kind] = original


def sound() -> Iterator[Case]:
    """Nothing is wrong with these."""
    for i, kind in enumerate(["tanks", "heater", "motor"] * 3 + ["tanks"]):
        noise, n = (1.0, 0.2, 2.0)[i // 3 % 3], (600, 1500, 300)[i % 3]
        yield Case(
            f"{kind}, {n} rows, noise {noise:g} times",
            kind,
            lambda k=kind, s=20 + i, m=n, w=noise: logged(k, s, m, noise=w),
        )  # type: ignore[misc]


def found_in(case: Case, seed: int = 0) -> tuple[list[str], str]:
    """What is said to be mended first, and the advice."""
    plant = PLANTS[case.kind]()
    try:
        page = check_log(plant, plant.read(case.columns()), seed=seed)
    except InvalidDataError as error:
        return [str(error)], ""
    advice = "; ".join(f"{r.about}: {r.text}" for r in page.remarks if r.kind == "advice")
    return [f"{r.about}: {r.text}" for r in page.problems], advice


def is_named(case: Case, problems: list[str], advice: str) -> bool:
    """Whether the defect is named; of a sound log, whether nothing is."""
    if not case.words:
        return not problems
    text = " ".join([*problems, advice])
    return any(word in text for word in case.words)
