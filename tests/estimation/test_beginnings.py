"""Tests of what the log says of inputs before episodes began; the truth is a plant whose past inputs are known."""

from __future__ import annotations

import numpy as np
import pytest

from mpcoffline import MPC, Model, Parameter, QuadraticCost, TransitionTable
from mpcoffline.estimation.beginnings import applied_before, beginnings

D = 4
GAIN, TAU = 0.75, 90.0


def heater(delay: int | None = D, price: float = 0.0) -> MPC:
    """A heater with its own numbers; nothing says what was applied before."""

    def ode(x, u, p):
        return (23.0 + p["K"] * u[0] - x[0]) / p["tau"]

    parameters = {"K": Parameter(GAIN, low=0.1, high=5.0), "tau": Parameter(TAU, low=10.0, high=900.0)}
    model = Model(ode, nx=1, nu=1, dt=5.0, parameters=parameters, delay=delay)
    change = {"D": [[price]]} if price else {}
    stage = QuadraticCost([[1.0]], [[0.01]], x_ref=[55.0], **change)
    return MPC(model, stage, QuadraticCost([[1.0]], x_ref=[55.0]), 20, 0.97, action_low=[0.0], action_high=[100.0])


def logged(before: float, delay: int = D, price: float = 0.0, episodes: int = 12, noise: float = 0.02):
    """Episodes of 30 steps before which ``before`` was applied, on average."""
    rng, rows = np.random.default_rng(0), []
    for episode in range(episodes):
        temperature, past = rng.uniform(30.0, 60.0), [max(before + rng.normal(), 0.0)] * max(delay, 1)
        seen = temperature + noise * rng.normal()
        for _ in range(30):
            u = rng.uniform(0.0, 100.0)
            cost = (temperature - 55.0) ** 2 + 0.01 * u * u + price * (u - past[-1]) ** 2
            past.append(u)
            acting = past[-1 - delay]
            temperature += (23.0 + GAIN * acting - temperature) * (1.0 - np.exp(-5.0 / TAU))
            reached = temperature + noise * rng.normal()
            rows.append((seen, u, cost, reached, episode))
            seen = reached
    s, a, cost, s_next, ids = map(np.array, zip(*rows, strict=True))
    return TransitionTable.from_arrays(s[:, None], a[:, None], cost, s_next[:, None], np.zeros(len(s)), ids)


@pytest.mark.parametrize("before", [20.0, 60.0])
def test_the_input_before_is_found_from_the_first_transitions(before):
    mpc, table = heater(), logged(before)
    found = applied_before(mpc, beginnings(table, mpc.layout))
    np.testing.assert_allclose(found, [before], atol=1.0)


def test_nothing_is_said_where_episodes_begin_as_is_thought():
    mpc = heater()
    assert applied_before(mpc, beginnings(logged(0.0), mpc.layout)) is None
    told = mpc.replace(applied_before=[60.0])
    assert applied_before(told, beginnings(logged(60.0), told.layout)) is None


def test_few_episodes_say_nothing():
    mpc = heater()
    assert beginnings(logged(60.0, episodes=4), mpc.layout) is None


def test_without_past_inputs_there_is_nothing_to_see():
    assert beginnings(logged(60.0, delay=0), heater(0).layout) is None


def test_a_price_on_changes_tells_it_by_the_first_costs():
    mpc, table = heater(0, price=0.3), logged(60.0, delay=0, price=0.3)
    found = applied_before(mpc, beginnings(table, mpc.layout), lambda rows: rows.values().costs)
    np.testing.assert_allclose(found, [60.0], atol=1.0)
    assert applied_before(mpc, beginnings(table, mpc.layout)) is None  # no state depends on it


def test_rows_after_a_gap_say_nothing():
    mpc, table = heater(), logged(60.0)
    index = np.arange(len(table)) % 30
    found = applied_before(mpc, beginnings(table.take(np.flatnonzero(index != 2)), mpc.layout))
    np.testing.assert_allclose(found, [60.0], atol=1.5)


def test_what_is_known_goes_into_files_and_bounds():
    mpc = heater().replace(applied_before=[130.0])
    np.testing.assert_array_equal(mpc.usual_input, [100.0])
    np.testing.assert_array_equal(MPC.from_json(mpc.to_json()).applied_before, [130.0])
    assert "applied_before" not in heater().to_json()
    assert heater().applied_before is None
