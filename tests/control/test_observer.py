"""Estimates against filters that are written out here, and loops that see outputs alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import gymnasium as gym
import lq_plant
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from mpcoffline import MPC, MPCPolicy, evaluate
from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.estimation.observer import KalmanObserver
from mpcoffline.mpc import Model, QuadraticCost, Signal

Array = NDArray[np.float64]

DT, NOISE, PROCESS, SPREAD = 0.1, 0.02, [1e-3, 2e-2], [0.5, 1.0]


def swing(x: Any, u: Any, p: Any) -> Any:
    return ca.vertcat(x[1], -ca.sin(x[0]) - 0.3 * x[1] + u[0])


def mpc_of(ode: Any = swing, goal: float = 1.0, **options: Any) -> MPC:
    """A damped pendulum that is held at an angle; its weight there is what u_ref bears."""
    cost = {"W": np.diag([5.0, 0.1]), "x_ref": [goal, 0.0]}
    return MPC(
        Model(ode, 2, 1, DT, **options),
        QuadraticCost(R=[[0.1]], u_ref=[np.sin(goal)], **cost),
        QuadraticCost(**cost),
        horizon=20,
        discount=1.0,
        action_low=[-3.0],
        action_high=[3.0],
    )


def observer_of(mpc: MPC, **options: Any) -> KalmanObserver:
    return KalmanObserver(mpc, [0], NOISE, PROCESS, **({"start_spread": SPREAD} | options))


def test_of_a_linear_plant_it_is_the_kalman_filter() -> None:
    """Step by step as the textbook has it, and in the end with the covariance of the Riccati equation."""
    A, B, C = lq_plant.A, lq_plant.B, np.array([[1.0, 0.5]])
    mpc = lq_plant.make_mpc((A, B))
    observer = KalmanObserver(mpc, lambda x: x[0] + 0.5 * x[1], NOISE, PROCESS, start=[0.3, -0.2], start_spread=SPREAD)
    R, Q = np.array([[NOISE**2]]), np.diag(np.square(PROCESS))
    rng, x, P = np.random.default_rng(0), np.array([0.3, -0.2]), np.diag(np.square(SPREAD))
    known = observer.begin(1)
    for k in range(200):
        y, u = rng.normal(size=1), rng.normal(size=1)
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        x, P = x + K @ (y - C @ x), (np.eye(2) - K @ C) @ P
        known = observer.corrected(known, y[None])
        np.testing.assert_allclose(known.x[0], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(known.P[0], P, rtol=1e-8, atol=1e-12)
        x, P = A @ x + B @ u, A @ P @ A.T + Q
        known = observer.ahead(known, u[None])
        assert k < 0 or np.isfinite(known.x).all()
    np.testing.assert_allclose(known.P[0], solve_discrete_are(A.T, C.T, Q, R), rtol=1e-6)


def test_of_a_pendulum_it_is_the_extended_filter() -> None:
    """With slopes by differences, to 1e-6, in a batch of three."""
    mpc = mpc_of()
    observer, theta = observer_of(mpc), mpc.theta
    rng = np.random.default_rng(1)
    xs, Ps = [observer.start.copy()] * 3, [np.diag(np.square(SPREAD))] * 3
    known, C = observer.begin(3), np.array([[1.0, 0.0]])
    Q, R = np.diag(np.square(PROCESS)), np.array([[NOISE**2]])

    def f(x: Array, u: Array) -> Array:
        return np.asarray(mpc.dynamics_function(x, u, theta).full().ravel())

    for _ in range(30):
        y, u = rng.normal(1.0, 0.5, (3, 1)), rng.normal(size=(3, 1))
        known = observer.corrected(known, y)
        for i in range(3):
            K = Ps[i] @ C.T @ np.linalg.inv(C @ Ps[i] @ C.T + R)
            xs[i], Ps[i] = xs[i] + K @ (y[i] - C @ xs[i]), (np.eye(2) - K @ C) @ Ps[i]
        np.testing.assert_allclose(known.x, xs, atol=1e-6)
        known = observer.ahead(known, u)
        for i in range(3):
            F = np.column_stack([(f(xs[i] + e, u[i]) - f(xs[i] - e, u[i])) / 2e-6 for e in 1e-6 * np.eye(2)])
            xs[i], Ps[i] = f(xs[i], u[i]), F @ Ps[i] @ F.T + Q
    np.testing.assert_allclose(known.P, Ps, rtol=1e-4, atol=1e-9)


def loop(policy: OutputFeedbackPolicy, plant: MPC, n: int, *, load: float = 0.0, noise: float = 0.0) -> Array:
    """States ``(n + 1, 2)`` of a plant from rest, whose input is disturbed."""
    x, state, rng, found = np.zeros(2), None, np.random.default_rng(0), [np.zeros(2)]
    for _ in range(n):
        u, state = policy.predict(x[:1] + noise * rng.normal(size=1), state)
        x = plant.dynamics_function(x, u + load, plant.theta).full().ravel()
        found.append(x)
    return np.array(found)


@pytest.mark.parametrize(("load", "gain"), [(0.6, 1.0), (-0.6, 1.0), (0.0, 0.7), (0.6, 1.3)])
def test_there_is_no_offset_under_a_load_or_with_a_wrong_gain(load: float, gain: float) -> None:
    """A tenth of the input's range, a gain 30 % off: below 1 % of the set-point; without disturbances far above."""

    def other(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(x[1], -ca.sin(x[0]) - 0.3 * x[1] + gain * u[0])

    mpc, plant = mpc_of(), mpc_of(other)
    offsets = []
    for disturbance in (None, 0.05):
        policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, disturbance=disturbance, start=[0.0, 0.0]))
        offsets.append(abs(loop(policy, plant, 200, load=load)[-1, 0] - 1.0))
    assert offsets[0] > 0.03
    assert offsets[1] < 0.01


def test_from_positions_alone_it_does_nearly_as_well_as_with_the_state() -> None:
    mpc = mpc_of()
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, start=[0.0, 0.0]))
    x = loop(policy, mpc, 60, noise=NOISE)
    full, state, costs = np.zeros(2), None, []
    for _ in range(60):
        costs.append(float(mpc.stage_function(full, 0.0, mpc.theta)))
        u, state = MPCPolicy(mpc).predict(full, state)  # type: ignore[assignment]
        full = mpc.dynamics_function(full, u, mpc.theta).full().ravel()
    ours = sum(float(mpc.stage_function(each, 0.0, mpc.theta)) for each in x[:-1])
    assert ours < 1.1 * sum(costs)


def test_a_batch_is_its_loops_and_starts_anew_one_by_one() -> None:
    mpc = mpc_of()
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, disturbance=0.05))
    rng = np.random.default_rng(3)
    outputs = rng.normal(size=(6, 2, 1))
    outputs[3, 1] = np.nan  # a sensor that says nothing
    together, singly, state, states = [], [], None, [None, None]
    for k, y in enumerate(outputs):
        begun = np.array([k == 4, False])
        actions, state = policy.predict(y, state, begun)
        together.append(actions)
        each = [policy.predict(y[i], states[i], begun[i : i + 1]) for i in range(2)]
        states = [found for _, found in each]  # type: ignore[misc]
        singly.append([found for found, _ in each])
    np.testing.assert_allclose(together, singly, atol=1e-6)
    cold = policy.predict(outputs[4, 0])[0]
    np.testing.assert_allclose(together[4][0], cold, atol=1e-6)
    x, d = policy.estimates(state)  # type: ignore[arg-type]
    assert (x.shape, d.shape) == ((2, 2), (2, 1))


@pytest.mark.parametrize("disturbance", [None, 0.05])
def test_with_dead_time_the_inputs_act_when_they_act(disturbance: float | None) -> None:
    """The estimate follows the states of a plant with the same dead time and load exactly, without noise."""
    mpc, load = mpc_of(delay=2), 0.4 if disturbance else 0.0
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, disturbance=disturbance, start=[0.0, 0.0]))
    z, state = mpc.state([0.0, 0.0]), None
    z[2:] += load
    for _ in range(150):
        u, state = policy.predict(z[:1], state)
        z = mpc.dynamics_function(z, u + load, mpc.theta).full().ravel()
    assert state is not None
    x, d = policy.estimates(policy.predict(z[:1], state)[1])
    np.testing.assert_allclose(x[0], z[:2], atol=1e-3)
    np.testing.assert_allclose(d[0], load, atol=1e-3)
    assert z[0] == pytest.approx(1.0, abs=5e-3)


def test_signals_come_after_the_outputs() -> None:
    def driven(x: Any, u: Any, p: Any, d: Any) -> Any:
        return ca.vertcat(x[1], -ca.sin(x[0]) - 0.3 * x[1] + u[0] + d.wind)

    mpc = mpc_of(driven, signals=[Signal("wind")])
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, start=[0.0, 0.0]))
    assert policy.observation_space.shape == (2,)
    x, state, rng = np.zeros(2), None, np.random.default_rng(0)
    for _ in range(60):
        wind = 0.3 * rng.normal(size=1)
        u, state = policy.predict(np.concatenate([x[:1], wind]), state)
        np.testing.assert_allclose(policy.estimates(state)[0][0], x, atol=0.05)
        x = mpc.dynamics_function(np.concatenate([x, wind]), u, mpc.theta).full().ravel()[:2]


class Angle(gym.ObservationWrapper[Any, Any, Any]):
    """Shows the first output alone."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def observation(self, observation: Array) -> Array:
        return observation[:1]


class Swing(gym.Env[Any, Any]):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-3.0, 3.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.k = self.np_random.normal(0.0, 0.2, 2), 0
        return self.x.astype(np.float32), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        mpc = mpc_of()
        cost = float(mpc.stage_function(self.x, action, mpc.theta))
        self.x, self.k = mpc.dynamics_function(self.x, action, mpc.theta).full().ravel(), self.k + 1
        return self.x.astype(np.float32), -cost, False, self.k == 40, {}


def test_evaluate_takes_it_and_so_does_its_file(tmp_path: Path) -> None:
    mpc = mpc_of()
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc, disturbance=0.02, start=[0.0, 0.0]))
    policy.save(tmp_path / "policy.zip")
    again = OutputFeedbackPolicy.load(tmp_path / "policy")
    found = [evaluate(each, Angle(Swing()), n_episodes=3, seed=0) for each in (policy, again)]
    np.testing.assert_array_equal(found[0].cost, found[1].cost)
    full = evaluate(MPCPolicy(mpc), Swing(), n_episodes=3, seed=0)
    assert found[0].cost.mean() < 1.3 * full.cost.mean()
    with pytest.raises(FileFormatError, match="policy"):
        MPCPolicy.load(tmp_path / "policy.zip")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise": 0.0}, "noise: expected standard deviations, positive"),
        ({"noise": [0.1, 0.1]}, "noise: expected a number, or 1"),
        ({"process": [-1.0, 0.0]}, "process: expected standard deviations, none below zero"),
        ({"process": np.nan}, "process: expected standard deviations"),
        ({"outputs": [2]}, "outputs: expected places of states, 0 to 1"),
        ({"outputs": []}, "outputs: expected places of states"),
        ({"start": [0.0]}, "start: expected a number, or 2"),
        ({"start_spread": "much"}, "start_spread: expected a number or numbers"),
    ],
)
def test_what_cannot_be_is_named(options: dict[str, Any], words: str) -> None:
    given = {"outputs": [0], "noise": NOISE, "process": PROCESS, "start_spread": SPREAD} | options
    with pytest.raises(InvalidArgumentError, match=words):
        KalmanObserver(mpc_of(), **given)


def test_states_and_observations_of_another_size_are_named() -> None:
    mpc = mpc_of()
    policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc))
    _, state = policy.predict(np.zeros((2, 1)))
    with pytest.raises(InvalidArgumentError, match="state: expected what predict returned for 3 loops"):
        policy.predict(np.zeros((3, 1)), state)
    with pytest.raises(InvalidArgumentError, match="state: expected what predict returned"):
        policy.predict(np.zeros((2, 1)), MPCPolicy(mpc).predict(np.zeros((2, 2)))[1])
    with pytest.raises(InvalidArgumentError, match="observation"):
        policy.predict(np.zeros(2))
    with pytest.raises(InvalidArgumentError, match="observation"):
        policy.predict([np.inf])
    with pytest.raises(InvalidArgumentError, match="observer: expected one of the policy's MPC"):
        OutputFeedbackPolicy(MPCPolicy(mpc), observer_of(mpc_of()))
    two = MPC(
        Model(lambda x, u, p: ca.vertcat(u[0], u[1]), 2, 2, DT),
        QuadraticCost(np.eye(2), np.eye(2)),
        QuadraticCost(np.eye(2)),
        horizon=5,
        discount=1.0,
        action_low=[-1.0, -1.0],
        action_high=[1.0, 1.0],
    )
    with pytest.raises(InvalidArgumentError, match="at most as many inputs as outputs"):
        KalmanObserver(two, [0], NOISE, PROCESS, start_spread=SPREAD, disturbance=0.1)


def test_a_model_that_runs_away_leaves_an_estimate_of_numbers() -> None:
    """A slope of 10^200 leaves no covariance that is a number: what was known before stays."""
    model = Model(lambda x, u, p: ca.vertcat(1e200 * x[0] + u[0], 0.5 * x[1]), 2, 1, 0.1, discrete=True)
    cost = QuadraticCost(np.eye(2), [[1.0]])
    mpc = MPC(model, cost, QuadraticCost(np.eye(2)), 3, 0.9, [-1.0], [1.0])
    observer = KalmanObserver(mpc, [1], noise=0.1, process=0.1, start=[1.0, 1.0], start_spread=1.0)
    known = observer.begin(2)
    for _ in range(3):
        known = observer.ahead(observer.corrected(known, np.array([[1.0], [np.nan]])), np.zeros((2, 1)))
    assert np.isfinite(known.x).all()
    assert np.isfinite(known.P).all()
