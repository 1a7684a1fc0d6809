"""Plant parameters against the laws of mechanics, starting states, and the refusal of what makes no sense."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from scipy import stats
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.envs import ENV_IDS, CartPoleSwingUpEnv, ControlTask, LinearTrackingEnv, PendulumSwingUpEnv
from mpcoffline.envs.base import wrap_angle

Array = NDArray[np.float64]


def make(env_id: str, **kwargs: Any) -> ControlTask:
    task = gym.make(env_id, **kwargs).unwrapped
    assert isinstance(task, ControlTask)
    return task


# ---------------------------------------------------------------- plants


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high)


@settings(max_examples=50, deadline=None)
@given(between(0.1, 5), between(0.1, 3), between(0, 20), between(-3, 3), between(-5, 5), between(-2, 2))
def test_pendulum_turns_as_its_moment_of_inertia_says(m: float, l: float, g: float, phi: float, phid: float, u: float):  # noqa: E741
    """(m l^2 / 3) phi'' = m g (l / 2) sin(phi) + u, a uniform rod about its end."""
    _, phidd = PendulumSwingUpEnv(m=m, l=l, g=g).derivative(np.array([phi, phid]), np.array([u]))
    torque = m * g * l / 2 * np.sin(phi) + u
    assert m * l**2 / 3 * phidd == pytest.approx(torque, rel=1e-9, abs=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(between(0.1, 3), between(0.1, 3), between(0.1, 2), between(0, 1), between(0, 20)),
    st.tuples(between(-3, 3), between(-3, 3), between(-3, 3), between(-5, 5)),
    between(-2, 2),
)
def test_cartpole_obeys_momentum_and_energy(plant: tuple[float, ...], state: tuple[float, ...], u: float) -> None:
    """Force changes the momentum along the track, its power the energy; friction takes from both."""
    m_c, m_p, l, mu, g = plant  # noqa: E741
    _, xd, phi, phid = state
    _, xdd, _, phidd = CartPoleSwingUpEnv(m_c=m_c, m_p=m_p, l=l, mu=mu, g=g).derivative(np.array(state), np.array([u]))
    sin, cos = np.sin(phi), np.cos(phi)
    momentum_rate = (m_c + m_p) * xdd + m_p * l * (phidd * cos - phid**2 * sin)
    assert momentum_rate == pytest.approx(u - mu * xd, rel=1e-9, abs=1e-8)
    # Speed and acceleration of the pole's centre, l from the hinge; it turns with m_p l^2 / 3 about it.
    speed = np.array([xd + l * phid * cos, -l * phid * sin])
    acceleration = np.array([xdd + l * (phidd * cos - phid**2 * sin), -l * (phidd * sin + phid**2 * cos)])
    energy_rate = m_c * xd * xdd + m_p * speed @ acceleration + m_p * l**2 / 3 * phid * phidd - m_p * g * l * sin * phid
    assert energy_rate == pytest.approx((u - mu * xd) * xd, rel=1e-9, abs=1e-7)


def test_linear_plant_of_given_matrices() -> None:
    rng = np.random.default_rng(0)
    A, B = 0.3 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    s, a = rng.normal(size=4), rng.uniform(-10, 10, size=2)
    np.testing.assert_allclose(LinearTrackingEnv(A=A, B=B).next_state(s, a), A @ s + B @ a, rtol=1e-13, atol=1e-13)
    mixed = LinearTrackingEnv(0.5, B=B.tolist())
    np.testing.assert_array_equal(mixed.A, LinearTrackingEnv(0.5).A)
    np.testing.assert_array_equal(mixed.B, B)


def test_the_spaces_do_not_depend_on_the_parameters() -> None:
    """What was learned on one plant can be tried on another."""
    for env_id, kwargs in ((PENDULUM, {"m": 2.0}), (CARTPOLE, {"l": 1.0}), (LINEAR, {"alpha": 2.0})):
        one, other = make(env_id), make(env_id, **kwargs)
        assert one.observation_space == other.observation_space
        assert one.action_space == other.action_space


@pytest.mark.parametrize(
    ("env_id", "name", "value", "accepted"),
    [
        (PENDULUM, "m", 0.0, "from 0.01 to 100 kg"),
        (PENDULUM, "m", np.nan, "from 0.01 to 100 kg"),
        (PENDULUM, "l", -1.0, "from 0.05 to 20 m"),
        (PENDULUM, "l", "long", "from 0.05 to 20 m"),
        (PENDULUM, "g", np.inf, r"from 0 to 30 m/s\^2"),
        (CARTPOLE, "m_c", 1e9, "from 0.01 to 100 kg"),
        (CARTPOLE, "m_p", [0.2], "from 0.01 to 100 kg"),
        (CARTPOLE, "l", None, "from 0.05 to 20 m"),
        (CARTPOLE, "mu", -0.1, "from 0 to 10 N s/m"),
        (CARTPOLE, "mu", 10.1, "from 0 to 10 N s/m"),
        (CARTPOLE, "g", -9.8, r"from 0 to 30 m/s\^2"),
        (LINEAR, "alpha", True, "from 0 to 4"),
    ],
)
def test_parameters_out_of_range(env_id: str, name: str, value: Any, accepted: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected a number {accepted}, got "):
        make(env_id, **{name: value})


def test_friction_up_to_its_bound_is_simulated_stably() -> None:
    """Without force and gravity friction takes energy from cart and pole, in each sampling time."""
    m_c, m_p, l = 0.02, 0.08, 0.5  # noqa: E741
    task = CartPoleSwingUpEnv(m_c=m_c, m_p=m_p, l=l, mu=40.0 * (m_c + m_p / 4.0), g=0.0)

    def energy(s: Array) -> float:
        rotation = 2.0 / 3.0 * m_p * l**2 * s[3] ** 2
        return float((m_c + m_p) / 2 * s[1] ** 2 + m_p * l * s[1] * s[3] * np.cos(s[2]) + rotation)

    state = np.array([0.0, 1.0, 0.0, 0.0])
    for _ in range(100):
        reached = task.next_state(state, np.zeros(1))
        assert energy(reached) <= energy(state) * (1.0 + 1e-6)
        state = reached


@pytest.mark.parametrize("A", [np.eye(3), [[1.0, 2.0], [3.0]], np.full((4, 4), np.nan), "A"])
def test_bad_matrices(A: Any) -> None:
    with pytest.raises(ValueError, match=r"A: expected finite numbers of shape \(4, 4\)"):
        LinearTrackingEnv(A=A)
    with pytest.raises(ValueError, match=r"B: expected finite numbers of shape \(4, 2\)"):
        LinearTrackingEnv(B=A)


def test_a_plant_that_leaves_the_bounds_at_once_is_refused() -> None:
    with pytest.raises(ValueError, match=r"A, B: expected a plant that stays within 10000 for 100 steps"):
        LinearTrackingEnv(A=1.2 * np.eye(4))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_unknown_arguments_and_render_modes(env_id: str) -> None:
    with pytest.raises(TypeError, match="mass"):
        make(env_id, mass=1.0)
    with pytest.raises(ValueError, match=r"render_mode: expected None or one of \('human', 'rgb_array'\), got 'ansi'"):
        type(make(env_id))(render_mode="ansi")
    with pytest.warns(UserWarning, match="render_mode='ansi'"), pytest.raises(ValueError, match="render_mode"):
        gym.make(env_id, render_mode="ansi")


# ---------------------------------------------------------------- starting states


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_starts_between_given_states(env_id: str) -> None:
    """Uniform, by option and by argument alike; Kolmogorov-Smirnov test with a fixed seed."""
    nx = make(env_id).state_space.shape[0]
    low, high = -0.1 * np.arange(1, nx + 1), 0.3 * np.arange(1, nx + 1)
    by_argument = make(env_id, start=(low.tolist(), high.tolist()))
    by_option = make(env_id)
    states = []
    for k in range(400):
        seed = 0 if k == 0 else None
        _, info = by_argument.reset(seed=seed)
        np.testing.assert_array_equal(
            by_option.reset(seed=seed, options={"low": low, "high": high})[1]["state"], info["state"]
        )
        states.append(info["state"])
    for column, a, b in zip(np.array(states).T, low, high, strict=True):
        assert stats.kstest(column, "uniform", args=(a, b - a)).pvalue > 1e-3


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE])
def test_bounds_of_an_angle_may_reach_across_the_seam(env_id: str) -> None:
    task = make(env_id)
    low, high = np.zeros(task.state_space.shape), np.zeros(task.state_space.shape)
    low[task.angle], high[task.angle] = np.pi - 0.2, np.pi + 0.3
    task.reset(seed=0)
    angles = np.array([task.reset(options={"low": low, "high": high})[1]["state"][task.angle] for _ in range(300)])
    assert (np.abs(angles) <= np.pi).all()
    around = wrap_angle(angles - np.pi)
    assert around.min() == pytest.approx(-0.2, abs=0.02)
    assert around.max() == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_scalars_bound_every_coordinate(env_id: str) -> None:
    task = make(env_id)
    np.testing.assert_array_equal(task.reset(options={"low": 0.25, "high": 0.25})[1]["state"], 0.25)


def test_the_start_given_as_argument_is_the_default() -> None:
    by_name, by_option = make(PENDULUM, start="hanging"), make(PENDULUM)
    expected = by_option.reset(seed=2, options={"start": "hanging"})[1]["state"]
    np.testing.assert_array_equal(by_name.reset(seed=2)[1]["state"], expected)
    # An option wins over it.
    expected = by_option.reset(seed=2)[1]["state"]
    np.testing.assert_array_equal(by_name.reset(seed=2, options={"start": "broad"})[1]["state"], expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"low": -1.0}, "'low' with 'high'.*got .'low'"),
        ({"low": -1.0, "high": 1.0, "start": "broad"}, "at most one of"),
        ({"low": -1.0, "high": 1.0, "state": [0.0, 0.0]}, "at most one of"),
        ({3: 1.0}, "at most one of .*got .'3'"),
        ({"low": 1.0, "high": -1.0}, "'low', 'high': expected low <= high in every coordinate"),
        ({"low": [0.0], "high": 1.0}, r"'low', 'high', low: expected shape \(2,\), got \(1,\)"),
        ({"low": -1.0, "high": np.nan}, "'low', 'high', high: expected finite values"),
        ({"low": -1.0, "high": [6.3, 91.0]}, r"high: expected finite values from \[ *-6.28.* -90.*got"),
        ({"low": "a", "high": 1.0}, "'low', 'high', low: expected numbers"),
        ({"state": "upright"}, "'state': expected numbers of shape"),
        ({"state": [[0.0], [1.0, 2.0]]}, "'state': expected numbers of shape"),
        ({"state": [3.2, 0.0]}, r"'state': expected finite values from .* got \[3.2 0. \]"),
        ({"start": 7}, "'start': expected one of .*'broad', 'hanging'.*got 7"),
        ({"start": None}, "'start': expected one of .*got None"),
    ],
)
def test_bad_options_are_refused_and_change_nothing(options: dict[Any, Any], message: str) -> None:
    task = make(PENDULUM)
    _, info = task.reset(seed=0)
    with pytest.raises(ValueError, match=f"reset option.*{message}"):
        task.reset(options=options)
    expected = task.next_state(info["state"], np.ones(1))
    np.testing.assert_array_equal(task.step(np.ones(1))[4]["state"], expected)


@pytest.mark.parametrize("start", ["sideways", 3, (1.0,), (1.0, -1.0), ("a", "b"), ([0.0], [1.0])])
def test_bad_start_arguments(start: Any) -> None:
    with pytest.raises(ValueError, match=r"^start"):
        make(PENDULUM, start=start)
