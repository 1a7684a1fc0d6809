"""Where an MPC rests before there are data, beside signals and past inputs."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mpcoffline import MPC, Model, QuadraticCost, Signal
from mpcoffline.mpc.rest import at_rest
from mpcoffline.mpc.seen import sees_memory
from mpcoffline.plotting import stage_weights
from mpcoffline.solvers.scaling import input_units


def followed(usual: float = 0.0, x_ref: float = 0.0, bound: float = 1.0) -> MPC:
    """A quick state, x' = -rate(x) x + u, and a tank after it whose level follows a set-point."""

    def rates(x: ca.SX, u: ca.SX, p: Any, d: Any) -> ca.SX:
        return ca.vertcat(u[0] - x[0] * x[1] ** 2, d.inflow + x[0] - x[1])

    signals = [Signal("set_point", preview=1, usual=usual), Signal("inflow", usual=0.5)]
    model = Model(rates, 2, 1, 1.0, signals=signals, delay=2)
    cost = QuadraticCost(np.diag([0.1, 1.0]), [[0.25]], x_ref=[0.0, x_ref], u_ref=[0.7], tracks={1: "set_point"})
    return MPC(model, cost, QuadraticCost(np.eye(2)), 10, 0.95, [-bound], [bound])


def test_what_tracks_a_signal_rests_at_its_usual_value() -> None:
    np.testing.assert_array_equal(at_rest(followed(5.0, 0.1)), [0.0, 5.1, 5.0, 5.0, 0.5, 0.7, 0.7])


def test_substeps_are_chosen_where_the_plant_is_not_where_the_distance_would_be() -> None:
    """At a level of 5 the quick state's rate is 25 per step, which one RK4 step does not follow; at 0 it is none."""
    assert followed(5.0).model.scheme == followed(0.0, 5.0).model.scheme
    assert followed(5.0).model.scheme.substeps > 2 * followed(0.0).model.scheme.substeps  # type: ignore[union-attr]


def test_inputs_without_bounds_are_measured_by_their_price_beside_signals_and_dead_time() -> None:
    np.testing.assert_allclose(input_units(followed(bound=np.inf)), [1.0 / np.sqrt(0.5)])


def test_weights_are_those_of_states_signals_and_inputs() -> None:
    """(x_1 - set_point)^2 is a form in both."""
    expected = np.zeros((6, 6))
    expected[0, 0], expected[5, 5] = 0.1, 0.25
    expected[np.ix_([1, 2], [1, 2])] = [[1.0, -1.0], [-1.0, 1.0]]
    np.testing.assert_allclose(stage_weights(followed(5.0)), expected, atol=1e-12)


def test_a_stage_cost_sees_past_inputs_where_changes_have_a_price_whatever_the_delay() -> None:
    for delay in (0, 2):
        model = Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True, delay=delay)
        plain, priced = QuadraticCost([[1.0]], [[0.1]]), QuadraticCost([[1.0]], [[0.1]], D=[[0.2]])
        for cost, seen in ((plain, False), (priced, True)):
            mpc = MPC(model, cost, QuadraticCost([[1.0]]), 5, 0.9, [-1.0], [1.0])
            assert sees_memory(mpc.layout, mpc.stage_cost) is seen
