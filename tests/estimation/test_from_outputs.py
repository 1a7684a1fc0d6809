"""Logs of outputs against the plants that made them, and filters against one large normal distribution."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from mpcoffline import MPC, MPCPolicy, OfflineMPCLearner, TransitionTable, diagnose
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.estimation import KalmanObserver, OutputIdentification, identify_from_outputs
from mpcoffline.estimation.from_outputs import _Search
from mpcoffline.estimation.observer import OutputModel
from mpcoffline.estimation.output_episodes import (
    OutputEpisodes,
    OutputPoint,
    filtered_outputs,
    output_episodes,
    smoothed_states,
    with_states,
)
from mpcoffline.mpc import Model, Parameter, QuadraticCost, Signal

Array = NDArray[np.float64]

NOISE, PROCESS = 0.02, 0.005
GOAL = 1.0


def mpc_of(gain: float = 1.0, weight: float = 1.0, friction: float = 0.3, **options: Any) -> MPC:
    """A pendulum under a torque, held at an angle."""

    def ode(x: Any, u: Any, p: Any, *d: Any) -> Any:
        wind = d[0].wind if d else 0.0
        return ca.vertcat(x[1], p["gain"] * u[0] - p["weight"] * ca.sin(x[0]) - p["friction"] * x[1] + wind)

    values = {"gain": gain, "weight": weight, "friction": friction}
    cost = {"W": np.diag([5.0, 0.1]), "x_ref": [GOAL, 0.0]}
    rough = {name: Parameter(v, low=v / 10.0, high=10.0 * v) for name, v in values.items()}
    return MPC(
        Model(ode, 2, 1, 0.1, parameters=rough, **options),
        QuadraticCost(R=[[0.1]], u_ref=[np.sin(GOAL)], **cost),
        QuadraticCost(**cost),
        horizon=20,
        discount=0.97,
        action_low=[-3.0],
        action_high=[3.0],
    )


def log_of(
    mpc: MPC, n: int = 40, steps: int = 60, *, hidden: bool = True, seed: int = 0
) -> tuple[TransitionTable, Array]:
    """Angles that are measured, with the wind where there is some, and the states, ``(n, steps, 2)``."""
    rng, layout = np.random.default_rng(seed), mpc.layout
    z = np.tile(mpc.state(np.zeros(2)), (n, 1))
    z[:, :2] += rng.normal(0.0, 0.4, (n, 2))
    xs, us, winds = [], [], []
    for _ in range(steps + 1):
        wind = 0.5 * rng.normal(size=(n, layout.ny - 2))
        z[:, 2 : layout.ny] = wind
        u = np.clip(1.5 * (GOAL - z[:, :1]) - 0.5 * z[:, 1:2] + 0.8 + rng.normal(size=(n, 1)), -3.0, 3.0)
        xs.append(z[:, :2].copy())
        us.append(u)
        winds.append(wind)
        z = mpc.dynamics_function(z.T, u.T, mpc.theta).full().T
        z[:, 1] += PROCESS * rng.normal(size=n)
    x, u, wind = (np.stack(parts, axis=1) for parts in (xs, us, winds))
    y = np.concatenate([x[:, :, :1] + NOISE * rng.normal(size=(n, steps + 1, 1)), wind], axis=2)
    shown = y if hidden else np.concatenate([x, wind], axis=2)
    costs = (
        np.einsum("eti,i->et", (x[:, :-1] - [GOAL, 0.0]) ** 2, [5.0, 0.1]) + 0.1 * (u[:, :-1, 0] - np.sin(GOAL)) ** 2
    )
    flat = shown[:, :-1].reshape(n * steps, -1), u[:, :-1].reshape(-1, 1), costs.ravel()
    after = shown[:, 1:].reshape(n * steps, -1)
    episodes = np.repeat(np.arange(n), steps)
    return TransitionTable.from_arrays(*flat, after, np.zeros(n * steps), episodes), x[:, :-1]


def linear(A: Array, B: Array) -> MPC:
    return MPC(
        Model(lambda x, u, p: ca.DM(A) @ x + ca.DM(B) @ u, 2, 1, 0.1, discrete=True),
        QuadraticCost(np.eye(2), np.eye(1)),
        QuadraticCost(np.eye(2)),
        horizon=5,
        discount=1.0,
        action_low=[-9.0],
        action_high=[9.0],
    )


def loss_of(model: OutputModel, data: OutputEpisodes, point: OutputPoint, spread: Array) -> float:
    """Minus the log likelihood but for a constant, of all points together."""
    return float(sum(step.evidence.sum() for step in filtered_outputs(model, data, point, spread)))


def test_fishers_information_is_the_curvature_where_the_model_is_true() -> None:
    """On average: near the likeliest point of a log that the model made, to a tenth; its slope is that of the loss."""
    mpc = mpc_of()
    log, _ = log_of(mpc, n=30)
    data, spread = output_episodes(mpc, log, 1), np.array([0.4, 0.4])
    search = _Search(mpc, OutputModel(mpc, [0]), data.some(1_800, 100, 0), np.zeros(2), spread, log)
    v = search.settled(np.zeros(search.size))
    slope, information = search._slopes(v)
    curvature = search.curvature(v)
    size = np.sqrt(np.diag(curvature))
    assert (np.abs(slope) < 0.3 * size).all()  # of standard deviations: what is left to go
    np.testing.assert_allclose(np.diag(information)[:3], np.diag(curvature)[:3], rtol=0.15)
    away = v + 0.1 * np.random.default_rng(0).normal(size=len(v))
    h = 1e-4 * np.eye(len(v))
    expected = (search.loss(away + h) - search.loss(away - h)) / 2e-4
    np.testing.assert_allclose(search._slopes(away)[0], expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("D", [0.0, 0.7])
def test_of_a_linear_plant_likelihood_and_states_are_those_of_one_normal_distribution(D: float) -> None:
    """All outputs together are normal; given them, the mean of the states is their regression on these.

    With D an output is of the input of the step before, too, and the first one, before which there is none, not there.
    """
    A, B, C = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.1]]), np.array([[1.0, 0.5]])
    mpc, rng, T = linear(A, B), np.random.default_rng(0), 6
    u, y = rng.normal(size=(T, 1)), rng.normal(size=(T + 1, 1))
    start, spread = np.array([0.2, -0.1]), np.array([0.5, 0.3])
    point = OutputPoint(mpc.theta, np.array([0.3]), np.array([0.1, 0.2]), start)
    # x = M [x_0, w_0 ... w_T-1] + c
    M, c = np.zeros((T + 1, 2, 2 * (T + 1))), np.zeros((T + 1, 2))
    M[0, :, :2], c[0] = np.eye(2), start
    for k in range(T):
        M[k + 1], c[k + 1] = A @ M[k], A @ c[k] + B @ u[k]
        M[k + 1, :, 2 * k + 2 : 2 * k + 4] += np.eye(2)
    W = np.diag(np.concatenate([spread**2, np.tile(point.process**2, T)]))
    H = (C @ M).reshape(T + 1, -1)
    S = H @ W @ H.T + 0.3**2 * np.eye(T + 1)
    missed = y[:, 0] - (c @ C.T)[:, 0] - np.append(0.0, D * u[:, 0])
    there = np.arange(T + 1)[int(D > 0.0) :]
    W_H, S_there = W @ H[there].T, S[np.ix_(there, there)]
    mean = c + (M @ W_H @ np.linalg.solve(S_there, missed[there]))

    table = TransitionTable.from_arrays(y[:-1], u, np.zeros(T), y[1:], np.zeros(T), np.zeros(T, int))
    data = output_episodes(mpc, table, 1)
    data = data._replace(y=y[:, None])  # tables are float32
    data = data._replace(acting=u[:, None])
    model = OutputModel(mpc, lambda x, u: x[0] + 0.5 * x[1] + D * u[0])
    likelihood = loss_of(model, data, point, spread)
    expected = -scipy.stats.multivariate_normal(np.zeros(len(there)), S_there).logpdf(missed[there])
    assert likelihood + 0.5 * len(there) * np.log(2.0 * np.pi) == pytest.approx(expected, rel=1e-9)
    several = OutputPoint(*(np.tile(each, (2, 1, 1)) for each in point))
    np.testing.assert_allclose(loss_of(model, data, several, spread), 2.0 * likelihood)
    states, _ = smoothed_states(model, data, point, spread)
    np.testing.assert_allclose(states[0], mean, atol=1e-8)
    gap = y.copy()
    gap[3] = np.nan  # an output that is not there: the distribution of the others
    some = there[there != 3]
    likelihood = loss_of(model, data._replace(y=gap[:, None]), point, spread)
    expected = -scipy.stats.multivariate_normal(np.zeros(len(some)), S[np.ix_(some, some)]).logpdf(missed[some])
    assert likelihood + 0.5 * len(some) * np.log(2.0 * np.pi) == pytest.approx(expected, rel=1e-9)


class FromAngles(NamedTuple):
    """What angles say of a pendulum of which the model is wrong, and its true states."""

    rough: MPC
    states: Array
    found: OutputIdentification

    @classmethod
    def of(cls, delay: int | None = None) -> FromAngles:
        rough = mpc_of(1.6, 0.6, 0.5, delay=delay)
        log, states = log_of(mpc_of(delay=delay), n=30)
        return cls(rough, states, identify_from_outputs(rough, log, [0], start_spread=[0.5, 0.5]))


@pytest.fixture(scope="module")
def from_angles() -> FromAngles:
    return FromAngles.of()


@pytest.mark.parametrize("delay", [None, 2])
def test_model_noise_and_speeds_are_found_from_angles(delay: int | None, from_angles: FromAngles) -> None:
    """Parameters that were off by a half to within four of the stated deviations, which are below 3 %."""
    _, x, found = from_angles if delay is None else FromAngles.of(delay)
    learned = found.mpc.theta[found.mpc.space.mask(("model",))]
    truth = dict(zip(("gain", "weight", "friction"), (1.0, 1.0, 0.3), strict=True))
    for name, value, deviation in zip(found.names, learned, found.deviations, strict=True):
        assert abs(value - truth[name.removeprefix("model.")]) < 4.0 * deviation
        assert deviation < 0.03 * value
    sensors = found.sensors
    assert sensors.noise[0] == pytest.approx(NOISE, rel=0.05)
    assert sensors.process[1] == pytest.approx(PROCESS, rel=0.5)
    assert (sensors.undetermined, (found.seen > 0.9).all()) == ((), True)
    missed = found.table.values().observations.reshape(x.shape) - x
    assert np.sqrt(np.mean(missed**2, axis=(0, 1)))[0] < 0.5 * NOISE
    assert np.sqrt(np.mean(missed**2, axis=(0, 1)))[1] < 0.03
    assert "1 output with a noise of 0.0" in str(found)
    assert found.missed[0] < 0.25
    assert "15 steps ahead, outputs are missed by " in str(found)
    assert "hardly better" not in str(found)


def test_signals_stay_in_the_table() -> None:
    signals = [Signal("wind")]
    log, _ = log_of(mpc_of(signals=signals), n=40, steps=30)  # steps cost time, episodes do not
    found = identify_from_outputs(mpc_of(1.2, 0.9, signals=signals), log, [0], start_spread=[0.5, 0.5])
    assert found.table.ny == 3
    np.testing.assert_array_equal(found.table.values().observations[:, 2], log.values().observations[:, 1])
    np.testing.assert_allclose(found.mpc.theta[found.mpc.space.mask(("model",))], [1.0, 1.0, 0.3], rtol=0.05)


def test_what_outputs_do_not_show_is_named(caplog: pytest.LogCaptureFixture) -> None:
    """A state that nothing else depends on, and a parameter of that alone."""

    def ode(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(x[1], u[0] - ca.sin(x[0]) - 0.3 * x[1], -p["rate"] * x[2])

    mpc = MPC(
        Model(ode, 3, 1, 0.1, parameters={"rate": Parameter(0.2, low=0.02, high=2.0)}),
        QuadraticCost(np.eye(3), np.eye(1)),
        QuadraticCost(np.eye(3)),
        horizon=5,
        discount=0.9,
        action_low=[-3.0],
        action_high=[3.0],
    )
    log, _ = log_of(mpc_of(), n=20, steps=30)
    with caplog.at_level(logging.WARNING):
        found = identify_from_outputs(mpc, log, [0], start_spread=[0.5, 0.5, 1.0])
    assert found.sensors.undetermined == ("model.rate", "observation 2 (a state)")
    assert (found.seen[:2] > 0.9).all()
    assert found.seen[2] < 0.5
    assert "hardly says anything of model.rate, observation 2 (a state)" in caplog.text


def test_a_model_that_predicts_nothing_says_so(caplog: pytest.LogCaptureFixture) -> None:
    """Angles under another input than is logged."""
    log, _ = log_of(mpc_of(), n=20, steps=40)
    columns, rng = log.values(), np.random.default_rng(0)
    other = rng.uniform(-3.0, 3.0, columns.actions.shape)
    parts = columns.observations, other, columns.costs, columns.next_observations, columns.terminations
    with caplog.at_level(logging.WARNING):
        found = identify_from_outputs(
            mpc_of(), TransitionTable.from_arrays(*parts, log.episode_ids), [0], start_spread=[0.5, 0.5]
        )
    assert found.missed[0] > 0.75
    assert "hardly better than to say that they stay" in caplog.text


def test_the_same_seed_gives_the_same_numbers() -> None:
    log, _ = log_of(mpc_of(), n=6, steps=20)
    first, again = (identify_from_outputs(mpc_of(1.3), log, [0], start_spread=0.5, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.mpc.theta, again.mpc.theta)
    np.testing.assert_array_equal(first.table.rows, again.table.rows)


def test_logs_that_cannot_be_are_named() -> None:
    log, _ = log_of(mpc_of(), n=3, steps=4)
    with pytest.raises(InvalidArgumentError, match="log: expected 2 outputs, 0 columns of signals and 1 inputs"):
        identify_from_outputs(mpc_of(), log, [0, 1], start_spread=1.0)
    short, _ = log_of(mpc_of(), n=3, steps=1)
    with pytest.raises(InvalidDataError, match="episodes of 2 steps at least"):
        identify_from_outputs(mpc_of(), short, [0], start_spread=1.0)
    with pytest.raises(InvalidDataError, match="24 rows at least, to find 8 numbers in, got 12"):
        identify_from_outputs(mpc_of(), log, [0], start_spread=1.0)
    columns = log.values()
    still = np.zeros_like(columns.observations)
    table = TransitionTable.from_arrays(
        still, columns.actions, columns.costs, still, columns.terminations, log.episode_ids
    )
    with pytest.raises(InvalidDataError, match="output 0 is one number throughout"):
        identify_from_outputs(mpc_of(), table, [0], start_spread=1.0)
    with pytest.raises(InvalidArgumentError, match="start_spread"):
        identify_from_outputs(mpc_of(), log, [0], start_spread=[1.0, 1.0, 1.0])


@pytest.mark.slow
def test_what_is_learned_from_angles_acts_on_angles_nearly_as_well_as_the_true_model(
    tmp_path: Path, from_angles: FromAngles
) -> None:
    """Behind the same observer and noise: within 10 % of it, better than the rough MPC; and the verdict knows."""
    true, (rough, states, found) = mpc_of(), from_angles
    learner = OfflineMPCLearner(rough, seed=0, value_n_steps=1_000, polyak=0.06)
    learner.fit(found)
    known = {"noise": NOISE, "process": [1e-4, PROCESS], "start": [0.0, 0.0], "start_spread": [0.5, 0.5]}

    def cost(policy: OutputFeedbackPolicy, x: Array) -> float:
        rng, state, total = np.random.default_rng(7), None, 0.0
        for _ in range(60):
            u, state = policy.predict(x[:, :1] + NOISE * rng.normal(size=(len(x), 1)), state)
            total += true.stage_function(x.T, u.T, true.theta).full().mean()
            x = true.dynamics_function(x.T, u.T, true.theta).full().T
            x[:, 1] += PROCESS * rng.normal(size=len(x))
        return total

    begun = np.random.default_rng(6).normal(0.0, 0.4, (20, 2))
    best, learned = true.replace(horizon=40, discount=1.0), cost(learner.output_policy, begun)
    yardstick, given = (
        cost(OutputFeedbackPolicy(MPCPolicy(mpc), KalmanObserver(mpc, [0], **known)), begun) for mpc in (best, rough)
    )
    assert learned < 1.1 * yardstick
    assert learned < given
    report = diagnose(learner, found)
    assert report.verdict == "recommend"
    from_log = cost(learner.output_policy, states[:, 0])
    assert report.judgement.expected[1] == pytest.approx(from_log, rel=0.05)
    assert str(found.sensors) in report.findings
    learner.save(tmp_path / "learner.zip")
    again, y = OfflineMPCLearner.load(tmp_path / "learner.zip"), np.array([0.3])
    np.testing.assert_array_equal(again.output_policy.predict(y)[0], learner.output_policy.predict(y)[0])
    assert str(again.sensors) == str(learner.sensors)


def test_episodes_that_run_away_in_the_model_are_left_out(caplog: pytest.LogCaptureFixture) -> None:
    log, _ = log_of(mpc_of(), n=3, steps=4)
    data = output_episodes(mpc_of(), log, 1)
    states = [np.full((5, 2), float(k)) for k in range(3)]
    states[1][2:] = np.nan
    with caplog.at_level(logging.WARNING):
        table = with_states(log, states, data, 1)
    assert "1 of 3 episodes are left out" in caplog.text
    np.testing.assert_array_equal(table.values().observations[:, 0], [0.0] * 4 + [2.0] * 4)
    np.testing.assert_array_equal(table.episode_ids, [0] * 4 + [2] * 4)
    with pytest.raises(InvalidDataError, match="an episode that the model can follow"):
        with_states(log, [np.full((5, 2), np.nan)] * 3, data, 1)
