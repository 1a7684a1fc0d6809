"""Outputs that depend on inputs: a filter written out here, and loops, batches and files of a policy behind one."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPCPolicy
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.core.types import Array
from mpcoffline.estimation import KalmanObserver
from mpcoffline.mpc import MPC, Model, QuadraticCost

NOISE, PROCESS, SPREAD, START, WALK = [0.05, 0.03], [0.01, 0.02], [0.4, 0.6], [0.1, -0.2], [0.02, 0.03]


def acceleration(x: Any, u: Any) -> Any:
    """Of a swing whose second input acts the more the further it is out; then its angle."""
    return [u[0] + u[1] * x[0] - ca.sin(x[0]) - 0.3 * x[1], x[0]]


def mpc_of(delay: list[int] | int = 0) -> MPC:
    model = Model(lambda x, u, p: ca.vertcat(x[1], acceleration(x, u)[0]), 2, 2, 0.1, delay=delay)
    stage = QuadraticCost(np.diag([5.0, 0.1]), 0.1 * np.eye(2), x_ref=[1.0, 0.0])
    return MPC(model, stage, QuadraticCost(np.eye(2), x_ref=[1.0, 0.0]), 15, 1.0, [-3.0, -1.0], [3.0, 1.0])


def observer_of(mpc: MPC, **options: Any) -> KalmanObserver:
    return KalmanObserver(mpc, acceleration, NOISE, PROCESS, start=START, start_spread=SPREAD, **options)


def by_hand(mpc: MPC, us: Array, ys: Array) -> Array:
    """States and loads ``(T, 4)`` of an extended filter for [x, d], with slopes by differences."""

    def f(z: Array, u: Array) -> Array:
        return np.append(mpc.dynamics_function(z[:2], u + z[2:], mpc.theta).full().ravel(), z[2:])

    def h(z: Array, u: Array) -> Array:
        v, x = u + z[2:], z[:2]
        return np.array([v[0] + v[1] * x[0] - np.sin(x[0]) - 0.3 * x[1], x[0]])

    def slopes(g: Any, z: Array, u: Array) -> Array:
        return np.column_stack([(g(z + e, u) - g(z - e, u)) / 2e-6 for e in 1e-6 * np.eye(4)])

    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    z, P, found = np.append(START, [0.0, 0.0]), np.diag(np.square([*SPREAD, *(0.25 * width)])), []
    Q, R = np.diag(np.square([*PROCESS, *WALK])), np.diag(np.square(NOISE))
    for k, y in enumerate(ys):
        some = [1] if k == 0 else [0, 1]  # nobody knows what acted before
        u = us[max(k - 1, 0)]
        H = slopes(h, z, u)[some]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R[np.ix_(some, some)])
        z, P = z + K @ (y - h(z, u))[some], (np.eye(4) - K @ H) @ P
        found.append(z)
        F = slopes(f, z, us[k])
        z, P = f(z, us[k]), F @ P @ F.T + Q
    return np.array(found)


def test_it_is_the_extended_filter_with_feedthrough_of_the_input_before() -> None:
    mpc, rng = mpc_of(), np.random.default_rng(0)
    observer = observer_of(mpc, disturbance=WALK)
    assert observer.feedthrough.tolist() == [True, False]
    us, ys = rng.uniform(-1.0, 1.0, (25, 3, 2)), rng.normal(0.3, 0.5, (25, 3, 2))
    known, acted, found = observer.begin(3), None, []
    for u, y in zip(us, ys, strict=True):
        known = observer.corrected(known, y, acted)
        found.append(known.x)
        acted, known = u, observer.ahead(known, u)
    for i in range(3):
        np.testing.assert_allclose(np.array(found)[:, i], by_hand(mpc, us[:, i], ys[:, i]), atol=1e-6)


def test_one_whose_outputs_do_not_depend_on_inputs_is_what_it_was_to_the_bit() -> None:
    mpc, rng = mpc_of(), np.random.default_rng(1)
    plain = KalmanObserver(mpc, lambda x: x[0] ** 2, 0.1, PROCESS, start_spread=SPREAD)
    other = KalmanObserver(mpc, lambda x, u: x[0] ** 2 + 0.0 * u[0], 0.1, PROCESS, start_spread=SPREAD)
    u, y = rng.normal(size=(4, 2)), rng.normal(size=(4, 1))
    for acted in (None, u):
        for a, b in zip(plain.corrected(plain.begin(4), y), other.corrected(other.begin(4), y, acted), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("delay", [0, [2, 1]])
def test_in_a_loop_it_is_told_what_acted_dead_time_and_loads_included(delay: list[int] | int) -> None:
    """An exact plant without noise under loads: from the accelerometer it finds states and loads."""
    mpc, loads = mpc_of(delay), np.array([0.4, -0.1])
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, disturbance=WALK))
    z, state, acted = mpc.state([0.3, 0.0]), None, np.zeros(2)
    z[2:] += loads[mpc.layout.ages[0]]
    for k in range(120):
        y = np.array([float(v) for v in acceleration(z[:2], acted)])
        u, state = policy.predict(y if k else [1e6, y[1]], state)  # what is measured first is not listened to
        acted = mpc.layout.split(z, u + loads)[1]
        z = mpc.dynamics_function(z, u + loads, mpc.theta).full().ravel()
    assert state is not None
    y = np.array([float(v) for v in acceleration(z[:2], acted)])
    x, d = policy.estimates(policy.predict(y, state)[1])
    np.testing.assert_allclose(x[0], z[:2], atol=2e-3)
    np.testing.assert_allclose(d[0], loads, atol=1e-2)


def test_a_batch_is_its_loops_and_each_begins_without_inputs(tmp_path: Path) -> None:
    mpc, rng = mpc_of([1, 0]), np.random.default_rng(3)
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc))
    policy.save(tmp_path / "policy.zip")
    ys = rng.normal(0.2, 0.3, (6, 2, 2))
    ys[3, 1] = np.nan
    policies = [policy, OutputFeedbackPolicy.load(tmp_path / "policy.zip"), pickle.loads(pickle.dumps(policy))]
    carried: list[Any] = [None] * 3
    states: list[Any] = [None] * 2
    for k, y in enumerate(ys):
        begun = np.array([k == 4, False])
        together = []
        for i, each in enumerate(policies):
            action, carried[i] = each.predict(y, carried[i], begun)
            together.append(action)
        np.testing.assert_array_equal(together[0], together[1])
        np.testing.assert_array_equal(together[0], together[2])
        for i in range(2):
            action, states[i] = policy.predict(y[i], states[i], begun[i : i + 1])
            np.testing.assert_allclose(together[0][i], action, atol=1e-6)
    cold = policy.predict([9.0, ys[4, 0, 1]])[1]
    lost = policy.predict([np.nan, ys[4, 0, 1]])[1]
    np.testing.assert_array_equal(cold[0], lost[0])
