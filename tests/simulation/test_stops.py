"""Stops of states against a tank that overflows and a state that merely rests."""

from __future__ import annotations

import numpy as np

from mpcoffline.simulation.stops import Stops


def test_a_full_tank_is_a_stop_and_a_state_at_rest_is_none() -> None:
    rng = np.random.default_rng(0)
    level = rng.uniform(0.0, 10.0, 2_000)
    flow = rng.uniform(-2.0, 3.0, 2_000)
    rest = -np.abs(rng.normal(size=2_000)) * (rng.random(2_000) > 0.3)  # at 0 in many rows, where it belongs
    x = np.column_stack([level, rest])
    predicted = np.column_stack([level + flow, 0.9 * rest])
    reached = np.column_stack([np.clip(level + flow, 0.0, 10.0), 0.9 * rest])
    stops = Stops.of(x, reached, predicted)
    np.testing.assert_array_equal(stops.low, [0.0, -np.inf])
    np.testing.assert_array_equal(stops.high, [10.0, np.inf])
    np.testing.assert_array_equal(stops.kept(np.array([[12.0, 3.0], [-1.0, -5.0]])), [[10.0, 3.0], [0.0, -5.0]])
    np.testing.assert_array_equal(stops.hit(reached), (level + flow >= 10.0) | (level + flow <= 0.0))


def test_noise_hides_a_stop_and_units_do_not() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(0.0, 1.0, (500, 1))
    predicted = x + rng.uniform(-0.3, 0.3, x.shape)
    reached = np.minimum(predicted, 1.0)
    for unit, offset in ((1.0, 0.0), (1e6, 1e6), (1e-6, -1.0)):
        found = Stops.of(*(unit * v + offset for v in (x, reached, predicted)))
        assert np.isfinite(found.high).all()
        assert not np.isfinite(found.low).any()
    assert not np.isfinite(Stops.of(x, reached + 1e-3 * rng.normal(size=x.shape), predicted).high).any()
    assert not np.isfinite(Stops.of(x[:0], reached[:0], predicted[:0]).high).any()


def test_a_leaking_tank_is_full_a_little_below_where_it_is_known_to_have_been_cut_off() -> None:
    rng = np.random.default_rng(2)
    level = rng.uniform(0.0, 10.0, (2_000, 1))
    flow = rng.uniform(0.0, 3.0, level.shape)
    room = 10.0 - level
    predicted, reached = 0.998 * level + flow, 0.998 * level + np.minimum(flow, room)
    cut = (flow > room)[:, 0]
    assert not np.isfinite(Stops.of(level, reached, predicted).high).any()
    found = Stops.of(level, reached, predicted, cut)
    np.testing.assert_array_equal(found.high, reached.max(axis=0))
    assert 9.98 <= found.high[0] <= 10.0
    assert not np.isfinite(found.low).any()
