"""Logs of three described plants, sound or with one planted defect each, and the words that name it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from two_tanks import two_tanks

from mpcoffline import Input, InvalidDataError, Parameter, Plant, Signal, State
from mpcoffline.tune import check_log

Columns = dict[str, Any]
#: Options of ``tune`` with which it learns little, and fast.
QUICK: dict[str, Any] = {"preset": "fast", "value_n_steps": 60, "show_progress": False}


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
    """A log: the plant, its columns, and words that one of the findings must hold; none of a sound log."""

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
    return _paced("tanks", 4, 3.0)


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


def _scaled(kind: str, seed: int, name: str, factor: float, offset: float = 0.0) -> Columns:
    c = logged(kind, seed)
    return changed(c, **{name: factor * c[name] + offset})


def _exchanged(kind: str, seed: int, a: str, b: str) -> Columns:
    c = logged(kind, seed)
    return changed(c, **{a: c[b], b: c[a]})


def _drifting() -> Columns:
    c = logged("heater", 13)
    return changed(c, T=c["T"] + 3.0 * c["T"].std() * np.linspace(0.0, 1.0, 600))


def _coarse() -> Columns:
    c = logged("tanks", 14)
    step = 0.4 * c["h2"].std()
    return changed(c, h2=step * np.round(c["h2"] / step))


def _shuffled() -> Columns:
    c = logged("heater", 15)
    return changed(c, power=np.random.default_rng(15).permutation(c["power"]))


def defects() -> Iterator[Case]:
    """One defect each."""
    cases: list[tuple[str, str, Callable[[], Columns], tuple[str, ...]]] = [
        ("kelvin in place of degrees Celsius", "heater", lambda: _scaled("heater", 0, "T", 1, 273.15), ("T", "kelvin")),
        ("two columns exchanged", "tanks", _swapped, ("h1 and h2 are exchanged",)),
        ("dead time of 3 steps", "tanks", lambda: _delayed("tanks", 2, 3), ("pump acts 3 steps late",)),
        ("a sensor that is stuck", "tanks", _stuck, ("h2", "stuck at", "100 rows")),
        ("another sampling time", "tanks", _slower, ("dt", "sampling time", "15 s")),
        ("sign of an input", "motor", lambda: _scaled("motor", 1, "v", -1.0), ("the sign of v is flipped",)),
        ("rpm in place of rad/s", "motor", lambda: _scaled("motor", 2, "w", 9.5493), ("w", "rpm", "unit")),
        (
            "an input that never moves",
            "tanks",
            lambda: logged("tanks", 7, pump=lambda k, x: 3.0),
            ("input that varies",),
        ),
        (
            "an input without test signals",
            "tanks",
            lambda: logged("tanks", 8, noise=0.0, pump=lambda k, x: 3 + 0.1 * (12 - x[1])),
            ("pump", "test signals"),
        ),
        (
            "a column that was not applied",
            "tanks",
            lambda: changed(logged("tanks", 9), pump=np.random.default_rng(9).uniform(0, 6, 600)),
            ("pump", "does something"),
        ),
        ("actions a row late", "motor", _row_late, ("actions of the row before",)),
        ("something else moves the plant", "tanks", _leak, ("moves the plant that the equations do not know",)),
        (
            "millimetres in place of centimetres",
            "tanks",
            lambda: _scaled("tanks", 10, "h2", 10.0),
            ("h2", "unit", "row"),
        ),
        (
            "metres in place of centimetres",
            "tanks",
            lambda: _scaled("tanks", 10, "h2", 0.01),
            ("h2", "multiplied by 100"),
        ),
        (
            "milliamperes in place of amperes",
            "motor",
            lambda: _scaled("motor", 11, "i", 1e3),
            ("i is divided by 1000",),
        ),
        ("Fahrenheit in place of Celsius", "heater", lambda: _scaled("heater", 11, "T", 1.8, 32), ("T", "Fahrenheit")),
        ("a share in place of per cent", "heater", lambda: _scaled("heater", 12, "power", 0.01), ("power", "by 100")),
        (
            "a signal in another unit",
            "tanks",
            lambda: _scaled("tanks", 12, "set_point", 10),
            ("set_point", "unit", "row"),
        ),
        ("sign of a state", "motor", lambda: _scaled("motor", 12, "w", -1.0), ("the sign of w is flipped",)),
        (
            "state and input exchanged",
            "heater",
            lambda: _exchanged("heater", 3, "T", "power"),
            ("T and power are exchanged",),
        ),
        (
            "state and set-point exchanged",
            "tanks",
            lambda: _exchanged("tanks", 4, "h2", "set_point"),
            ("h2 and set_point",),
        ),
        ("dead time of 1 step", "motor", lambda: _delayed("motor", 5, 1), ("v acts 1 step late",)),
        ("dead time of 6 steps", "heater", lambda: _delayed("heater", 6, 6), ("power acts 6 steps late",)),
        ("a fifth of the sampling time", "motor", lambda: _paced("motor", 7, 0.2), ("dt", "sampling time", "0.002 s")),
        ("a time constant that cannot be", "heater", lambda: _paced("heater", 8, 3.0), ("tau", "90 +- 30% described")),
        ("a sensor that drifts", "heater", _drifting, ("T", "drifts")),
        ("a coarse sensor", "tanks", _coarse, ("h2 comes in steps",)),
        ("an input in another order", "heater", _shuffled, ("power", "does something")),
        ("an input at its bounds", "motor", lambda: logged("motor", 16, explore=20.0), ("v is at its bounds",)),
        ("an actuator that moves slowly", "heater", _sluggish, ("power never changes by more than 8 %", "rate=8")),
        ("a goal that was never reached", "heater", lambda: logged("heater", 17, pump=_cold), ("T is never nearer",)),
    ]
    for case in cases:
        yield Case(*case)


def _sluggish() -> Columns:
    """Its controller asks for more than an actuator can, which moves by 8 % in a control interval."""
    rng, at, wanted = np.random.default_rng(18), [50.0], [55.0]

    def moved(k: int, x: Any) -> float:
        if rng.random() < 0.1:
            wanted[0] = float(rng.uniform(40.0, 70.0))
        asked = float(np.clip(45.0 + 4.0 * (wanted[0] - x[0]), 0.0, 100.0))
        at[0] += float(np.clip(asked - at[0], -8.0, 8.0))
        return at[0]

    return logged("heater", 18, pump=moved)


def _cold(k: int, x: Any) -> float:
    return float(20.0 + 10.0 * ((k // 20) % 2))


def _delayed(kind: str, seed: int, steps: int) -> Columns:
    """A log of a plant whose input acts late, which the description does not say."""
    plant = PLANTS[kind]()
    return _differing(kind, seed, replace(plant, inputs=[replace(each, delay=steps) for each in plant.inputs]))


def _paced(kind: str, seed: int, factor: float) -> Columns:
    """A log of so many times the control interval that is described, without its time."""
    plant = PLANTS[kind]()
    columns = _differing(kind, seed, replace(plant, dt=factor * plant.dt))
    return {name: v for name, v in columns.items() if name != "time"}


def _differing(kind: str, seed: int, plant: Plant) -> Columns:
    """A log of another plant than the described one."""
    original = PLANTS[kind]
    PLANTS[kind] = lambda: plant
    try:
        return logged(kind, seed)
    finally:
        PLANTS[kind] = original


def sound(first: int = 20) -> Iterator[Case]:
    """Nothing is wrong with these."""
    for i, kind in enumerate(["tanks", "heater", "motor"] * 3 + ["tanks"]):
        noise, n = (1.0, 0.2, 2.0)[i // 3 % 3], (600, 1500, 300)[i % 3]
        yield Case(
            f"{kind}, {n} rows, noise {noise:g} times",
            kind,
            lambda k=kind, s=first + i, m=n, w=noise: logged(k, s, m, noise=w),
        )  # type: ignore[misc]


def found_in(case: Case, seed: int = 0) -> tuple[list[str], list[str]]:
    """What is said to be mended first, and the advice."""
    plant = PLANTS[case.kind]()
    try:
        page = check_log(plant, plant.read(case.columns()), seed=seed)
    except InvalidDataError as error:
        return [str(error)], []
    advice = [f"{r.about}: {r.text}" for r in page.remarks if r.kind == "advice"]
    return [f"{r.about}: {r.text}" for r in page.problems], advice


def is_named(case: Case, problems: list[str], advice: list[str]) -> bool:
    """Whether the defect is named, in one sentence; of a sound log, whether there is no problem."""
    if not case.words:
        return not problems
    return any(all(word in text for word in case.words) for text in [*problems, *advice])
