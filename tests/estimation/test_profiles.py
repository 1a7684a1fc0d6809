"""Signals that follow a clock: profiles found in a log of known ones, and what they are worth along a horizon."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline import MPC, Model, OfflineMPCLearner, Parameter, Signal, TransitionTable, make_solver
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.estimation import with_profiles
from mpcoffline.mpc.component import Component
from mpcoffline.mpc.parameters import Block, ParameterSpace

Array = NDArray[np.float64]
PERIOD, PERSISTENCE = 24, 0.8
DAY = Signal("day", period=PERIOD)


def mean(hour: Array | int) -> Array:
    phase = 2.0 * np.pi * np.asarray(hour) / PERIOD
    return np.asarray(0.3 - 0.1 * np.cos(phase) + 0.05 * np.sin(phase) - 0.08 * np.cos(2.0 * phase))


def prices(rng: np.random.Generator, begin: int, steps: int) -> Array:
    off, found = 0.04 * rng.normal(), []
    for k in range(steps):
        found.append(float(mean(begin + k)) + off)
        off = PERSISTENCE * off + 0.02 * rng.normal()
    return np.array(found)


class Trade(Component):
    """What is bought at the price of the step, wear, and a price on a store that is far from half full."""

    uses_signals = True

    def __init__(self) -> None:
        self.space = ParameterSpace([Block.free("wear", Parameter(0.02, low=1e-3, high=1.0), "cost")])

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return d.price * u[0] + p["wear"] * u[0] ** 2 + 0.002 * x[0] ** 2

    def terminal_expression(self, x: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return 0.02 * x[0] ** 2 - 0.3 * x[0]


def store(*signals: Signal) -> MPC:
    model = Model(lambda x, u, p: x + u, 1, 1, 3600.0, discrete=True, signals=signals)
    return MPC(model, Trade(), Trade(), 24, 1.0, [-2.0], [2.0])


def clock(hour: Array) -> Array:
    phase = 2.0 * np.pi * hour / PERIOD
    return np.stack([np.cos(phase), np.sin(phase)], axis=-1)


def log(seed: int = 0, n_episodes: int = 40, steps: int = 72) -> TransitionTable:
    """Random trade at prices of the profile; observation: level, cosine, sine, price."""
    rng, parts = np.random.default_rng(seed), []
    for e in range(n_episodes):
        begin = int(rng.integers(PERIOD))
        price, hours = prices(rng, begin, steps + 1), begin + np.arange(steps + 1)
        u = rng.uniform(-1.0, 1.0, steps)
        level = np.append(0.0, np.cumsum(u))
        y = np.column_stack([level, clock(hours), price])
        cost = price[:-1] * u + 0.02 * u**2 + 0.002 * level[:-1] ** 2
        parts.append((y[:-1], u[:, None], cost, y[1:], np.zeros(steps), np.full(steps, e)))
    s, a, c, reached, t, ids = (np.concatenate(part) for part in zip(*parts, strict=True))
    return TransitionTable.from_arrays(s, a, c, reached, t, ids)


def test_profile_and_persistence_are_those_of_the_log() -> None:
    found = with_profiles(store(DAY, Signal("price", follows="day")), log()).layout.signals[1]
    assert found.persistence == pytest.approx(PERSISTENCE, abs=0.03)
    np.testing.assert_allclose(found.profile, [0.3, -0.1, 0.05, -0.08, 0.0, 0.0, 0.0], atol=0.01)


def test_a_clock_turns_and_a_price_follows_it_along_the_horizon() -> None:
    known = Signal("price", follows="day", preview=1, profile=(0.3, -0.1, 0.05, -0.08, 0.0), persistence=PERSISTENCE)
    model = store(DAY, known).model
    z = np.concatenate([[1.0], clock(np.array(5.0)), [0.5, 0.4]])
    for k in range(1, 30):
        z = model(z, [0.0])
        np.testing.assert_allclose(z[1:3], clock(np.array(5.0 + k)), atol=1e-12)
        expected = mean(6 + k) + PERSISTENCE**k * (0.4 - mean(6))  # of the hour after the present one
        assert z[4] == pytest.approx(float(expected), abs=1e-12)
    read = Model.from_json(json.loads(json.dumps(model.to_json())))
    np.testing.assert_allclose(read(z, [0.3]), model(z, [0.3]), atol=1e-12)
    layout = model.layout
    np.testing.assert_allclose(layout.joined(z[:1], z, np.zeros(1)), model(z, [0.0]), atol=1e-12)


def closed_loop(mpc: MPC, episodes: list[Array], begin: int) -> float:
    """What a day's trade costs, all episodes side by side."""
    solver, level, total = make_solver(mpc), np.zeros(len(episodes)), 0.0
    for k in range(PERIOD):
        price = np.array([episode[k] for episode in episodes])
        hours = np.tile(clock(np.array(float(begin + k))), (len(episodes), 1))
        ahead = np.stack([episode[k + 1 : k + 1 + mpc.layout.signals[-1].preview] for episode in episodes])
        u = solver.solve(np.column_stack([level, hours, price, ahead])).u[:, 0, 0]
        total += float(np.mean(price * u + 0.02 * u**2 + 0.002 * level**2))
        level = level + u
    return total + float(np.mean(0.02 * level**2 - 0.3 * level))


def test_a_learned_profile_is_worth_nearly_as_much_as_a_preview() -> None:
    rng = np.random.default_rng(7)
    days = [prices(rng, 3, 2 * PERIOD + 1) for _ in range(12)]
    held = store(DAY, Signal("price", follows="day"))
    learned, foreseen = with_profiles(held, log()), store(DAY, Signal("price", preview=PERIOD))
    worst, middle, best = (closed_loop(mpc, days, 3) for mpc in (held, learned, foreseen))
    assert best < middle < best + 0.2 * (worst - best)


def test_a_learner_finds_it_first() -> None:
    mpc = store(DAY, Signal("price", follows="day")).replace(discount=0.95)
    learner = OfflineMPCLearner(mpc, preset="paper", value_n_steps=2, fit_n_steps=1)
    learner.fit(log(n_episodes=15), show_progress=False)
    assert learner.mpc.layout.signals[1].persistence == pytest.approx(PERSISTENCE, abs=0.06)
    assert len(learner.mpc.layout.signals[1].profile) == 7


def test_what_is_no_clock_is_refused() -> None:
    mpc = store(replace(DAY, period=12.0), Signal("price", follows="day"))
    with pytest.raises(InvalidDataError, match="turns once in 12 sampling steps"):
        with_profiles(mpc, log(n_episodes=5))
    with pytest.raises(InvalidArgumentError, match="follows: expected a clock among"):
        store(Signal("price", follows="week"))
    with pytest.raises(InvalidArgumentError, match="no preview"):
        Signal("day", period=24, preview=2)
    with pytest.raises(InvalidArgumentError, match="profile of price"):
        Signal("price", follows="day", profile=(1.0, 2.0))
    with pytest.raises(InvalidArgumentError, match="period"):
        Signal("day", period=1.0)
