"""The three tasks: Gymnasium's contract, ours on top of it, and their physics against independent derivations."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.utils.env_checker import check_env as gymnasium_check
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from stable_baselines3.common.env_checker import check_env as sb3_check

from mpcoffline.envs import ENV_IDS, CartPoleSwingUpEnv, ControlTask, LinearTrackingEnv, PendulumSwingUpEnv
from mpcoffline.envs.base import rk4, wrap_angle

Array = NDArray[np.float64]
SWING_UPS = ENV_IDS[1:3]


@pytest.fixture(params=ENV_IDS)
def env(request: pytest.FixtureRequest) -> gym.Env[Any, Any]:
    return gym.make(request.param)


def task(env: gym.Env[Any, Any]) -> ControlTask:
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, ControlTask)
    return unwrapped


def random_actions(env: gym.Env[Any, Any], n: int, seed: int = 0) -> Array:
    space = task(env).action_space
    return np.random.default_rng(seed).uniform(space.low, space.high, size=(n, *space.shape)).astype(np.float32)


# ---------------------------------------------------------------- the contract


def test_checkers_are_silent(env: gym.Env[Any, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions keep their physical units.
        warnings.filterwarnings("ignore", message=".*[Ww]e recommend .*(symmetric and )?normalized.*")
        gymnasium_check(env.unwrapped, skip_render_check=True)
        sb3_check(env)


def test_an_episode_is_truncated_after_100_steps(env: gym.Env[Any, Any]) -> None:
    env.reset(seed=0)
    for k, action in enumerate(random_actions(env, 100)):
        _, _, terminated, truncated, _ = env.step(action)
        assert not terminated
        assert truncated == (k == 99)


def test_info_and_reward(env: gym.Env[Any, Any]) -> None:
    observation, info = env.reset(seed=1)
    plant = task(env)
    assert info["cost"] == 0.0
    for action in random_actions(env, 20):
        state = info["state"]
        np.testing.assert_array_equal(observation, plant.observe(state))
        observation, reward, _, _, info = env.step(action)
        expected = float(plant.cost(state, action.astype(np.float64)))
        assert reward == -info["cost"] == -expected
        assert type(reward) is type(info["cost"]) is float
        assert type(info["is_success"]) is bool
        assert info["state"].dtype == np.float64
        assert observation.dtype == np.float32
        np.testing.assert_array_equal(info["state"], plant.next_state(state, action.astype(np.float64)))


def test_info_does_not_hand_out_the_state_itself(env: gym.Env[Any, Any]) -> None:
    _, info = env.reset(seed=1)
    before = info["state"].copy()
    info["state"][:] = 1e6
    _, _, _, _, info = env.step(np.zeros(task(env).action_space.shape, np.float32))
    np.testing.assert_array_equal(info["state"], task(env).next_state(before, np.zeros(task(env).action_space.shape)))


def test_same_seed_same_episode(env: gym.Env[Any, Any]) -> None:
    def episode(seed: int) -> Array:
        _, info = env.reset(seed=seed)
        return np.array([info["state"], *(env.step(action)[4]["state"] for action in random_actions(env, 10))])

    np.testing.assert_array_equal(episode(3), episode(3))
    assert not np.array_equal(episode(3), episode(4))


@pytest.mark.parametrize("env_id", ENV_IDS[:3])
def test_starts_are_drawn_from_their_published_distributions(env_id: str) -> None:
    env = gym.make(env_id)

    def starts(name: str) -> Array:
        return np.array([env.reset(seed=seed, options={"start": name})[1]["state"] for seed in range(300)])

    # The limits of the uniform distributions, which 300 draws come close to.
    limits = {
        LinearTrackingEnv: {"broad": [1.0, 1.0, 1.0, 1.0]},
        PendulumSwingUpEnv: {"broad": [np.pi, 1.0], "hanging": [0.2, 0.1]},
        CartPoleSwingUpEnv: {"broad": [1.0, 0.5, np.pi, 1.0], "hanging": [0.1, 0.1, 0.2, 0.1]},
    }[type(task(env))]
    assert set(limits) == set(task(env).starts)
    for name, limit in limits.items():
        states = starts(name)
        if name == "hanging":
            angle = states.shape[1] - 2
            states[:, angle] = wrap_angle(states[:, angle] - np.pi)
        assert (np.abs(states) <= limit).all()
        assert (np.abs(states).max(axis=0) > 0.95 * np.array(limit)).all()
        assert (np.abs(states.mean(axis=0)) < 0.2 * np.array(limit)).all()  # > 5 standard deviations of a mean of 300


def test_the_default_start_is_the_first(env: gym.Env[Any, Any]) -> None:
    default = env.reset(seed=5)[1]["state"]
    np.testing.assert_array_equal(default, env.reset(seed=5, options={"start": task(env).starts[0]})[1]["state"])


def test_start_from_a_given_state(env: gym.Env[Any, Any]) -> None:
    state = 0.5 * np.ones(task(env).state_space.shape)
    observation, info = env.reset(options={"state": state})
    np.testing.assert_array_equal(info["state"], state)
    np.testing.assert_array_equal(observation, task(env).observe(state))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": 1.0}, "'state' and 'start', got .'speed'"),
        ({"state": [0.0], "start": "broad"}, "at most one of"),
        ({"start": "sideways"}, "expected one of .*'broad'.*got 'sideways'"),
        ({"state": [0.1]}, r"expected shape \(\d,\), got \(1,\)"),
        ({"state": "nan"}, "expected finite values"),
        ({"state": "huge"}, "expected finite values from"),
    ],
)
def test_bad_reset_options(env: gym.Env[Any, Any], options: dict[str, Any], message: str) -> None:
    if options.get("state") in ("nan", "huge"):
        options = {"state": np.full(task(env).state_space.shape, {"nan": np.nan, "huge": 1e5}[options["state"]])}
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)


def test_bad_actions(env: gym.Env[Any, Any]) -> None:
    raw = task(env)
    raw.reset(seed=0)
    n = raw.action_space.shape[0]
    with pytest.raises(ValueError, match=rf"action: expected shape \({n},\), got \({n + 1},\)"):
        raw.step(np.zeros(n + 1))
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="action: expected finite numbers"):
            raw.step(np.full(n, bad))


def test_step_before_reset(env: gym.Env[Any, Any]) -> None:
    with pytest.raises(gym.error.ResetNeeded):
        task(env).step(np.zeros(task(env).action_space.shape))


def test_actions_beyond_the_bounds_are_clipped(env: gym.Env[Any, Any]) -> None:
    raw = task(env)
    results = []
    for action in (raw.action_space.high, 7.0 * raw.action_space.high):
        raw.reset(seed=2)
        results.append(raw.step(action))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]


@pytest.mark.parametrize("alpha", [-0.1, 4.1, np.nan])
def test_linear_alpha_out_of_range(alpha: float) -> None:
    with pytest.raises(ValueError, match="alpha: expected a number from 0 to 4"):
        LinearTrackingEnv(alpha)


def in_subprocess(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_gym_make_needs_no_import() -> None:
    code = (
        "import gymnasium as gym\n"
        "env = gym.make('mpcoffline:mpcoffline/PendulumSwingUp-v0')\n"
        "print(env.spec.id, env.reset(seed=0)[0].shape)"
    )
    assert in_subprocess(code).strip() == "mpcoffline/PendulumSwingUp-v0 (3,)"


def test_import_is_light() -> None:
    code = "import sys, mpcoffline; print({'torch', 'casadi', 'stable_baselines3', 'minari'} & set(sys.modules))"
    assert in_subprocess(code).strip() == "set()"


def test_environments_load_nothing_else_of_the_package() -> None:
    code = "import sys, mpcoffline.envs; print(*[m for m in sys.modules if m.startswith('mpcoffline.')])"
    loaded = in_subprocess(code).split()
    assert loaded
    assert all(module.startswith("mpcoffline.envs") for module in loaded)


# ---------------------------------------------------------------- physics


def states_of(plant: ControlTask, n: int, seed: int = 0) -> Array:
    """Random states with speeds up to 5: inside what swing-ups meet."""
    rng = np.random.default_rng(seed)
    high = np.minimum(plant.state_space.high, 5.0)
    return rng.uniform(-high, high, size=(n, len(high)))


def test_vectorised_functions_equal_one_by_one(env: gym.Env[Any, Any]) -> None:
    plant = task(env)
    states, actions = states_of(plant, 50), random_actions(env, 50).astype(np.float64)
    # Matrix products may sum in another order, hence the last digits.
    for function in (plant.next_state, plant.cost):
        one_by_one = np.array([function(s, a) for s, a in zip(states, actions, strict=True)])
        np.testing.assert_allclose(function(states, actions), one_by_one, rtol=1e-14, atol=1e-14)
    for unary in (plant.observe, plant.is_success):
        np.testing.assert_array_equal(unary(states), np.array([unary(s) for s in states]))
    stacked = plant.next_state(states.reshape(5, 10, -1), actions.reshape(5, 10, -1))
    np.testing.assert_allclose(stacked.reshape(50, -1), plant.next_state(states, actions), rtol=1e-14, atol=1e-14)


def test_next_state_leaves_its_arguments_alone(env: gym.Env[Any, Any]) -> None:
    plant = task(env)
    states, actions = states_of(plant, 5), random_actions(env, 5).astype(np.float64)
    before = states.copy(), actions.copy()
    plant.next_state(states, actions)
    np.testing.assert_array_equal(states, before[0])
    np.testing.assert_array_equal(actions, before[1])


def test_linear_plant_is_the_published_one() -> None:
    """Typed from arXiv:2301.01667 once more."""
    dt, friction = 0.1, 0.9
    A = np.eye(4) + dt * np.diag([1.0, 1.0], 2)
    A[2, 2] = A[3, 3] = friction
    B = np.vstack([np.zeros((2, 2)), dt * np.eye(2)])
    delta_a = """ .0068 -.0115 -.0229 -.0242
                  .0157  .0206  .0053  .0115
                  .0022  .0217  .0158 -.0249
                  .0179 -.0233  .0115 -.0162 """
    delta_b = ".0182 .0021  -.0100 -.0039  -.0236 -.0188  .0085 .0074"
    dA, dB = np.array(delta_a.split(), float).reshape(4, 4), np.array(delta_b.split(), float).reshape(4, 2)
    rng = np.random.default_rng(0)
    for alpha in (0.0, 0.5, 1.0, 2.0):
        plant = LinearTrackingEnv(alpha)
        s, a = rng.normal(size=(20, 4)), rng.uniform(-10, 10, size=(20, 2))
        expected = np.array([(A + alpha * dA) @ x + (B + alpha * dB) @ u for x, u in zip(s, a, strict=True)])
        np.testing.assert_allclose(plant.next_state(s, a), expected, rtol=0, atol=1e-13)
        cost = [9 * (x[0] ** 2 + x[1] ** 2) + x[2] ** 2 + x[3] ** 2 + 0.1 * (u @ u) for x, u in zip(s, a, strict=True)]
        np.testing.assert_allclose(plant.cost(s, a), cost, rtol=1e-14)


def test_linear_default_is_alpha_one() -> None:
    assert task(gym.make(ENV_IDS[0])).alpha == 1.0  # type: ignore[attr-defined]


def test_swing_up_costs_are_the_published_ones() -> None:
    phi, phid, x, xd, u = 0.3, -2.0, 0.7, 1.1, 1.5
    pendulum = 0.3**2 + 0.1 * 2.0**2 + 0.1 * 1.5**2
    assert PendulumSwingUpEnv().cost(np.array([phi, phid]), np.array([u])) == pytest.approx(pendulum, rel=1e-15)
    cart = 2 * 0.7**2 + 0.3**2 + 0.1 * 1.1**2 + 0.1 * 2.0**2 + 0.1 * 1.5**2
    assert CartPoleSwingUpEnv().cost(np.array([x, xd, phi, phid]), np.array([u])) == pytest.approx(cart, rel=1e-15)


def lagrangian_accelerations(
    lagrangian: sp.Expr, coordinates: list[Any], forces: list[Any], symbols: dict[Any, Any]
) -> Any:
    """Solves d/dt dL/dq' - dL/dq = Q for q'' and returns it as a numpy function of the symbols' values."""
    time = next(iter(coordinates[0].free_symbols))
    accelerations = [sp.Symbol(f"a{i}") for i in range(len(coordinates))]
    equations = [
        sp.diff(sp.diff(lagrangian, q.diff(time)), time) - sp.diff(lagrangian, q) - force
        for q, force in zip(coordinates, forces, strict=True)
    ]
    second = {q.diff(time, 2): a for q, a in zip(coordinates, accelerations, strict=True)}
    equations = [equation.subs(second).subs(symbols) for equation in equations]
    mass, rhs = sp.linear_eq_to_matrix(equations, accelerations)
    return sp.lambdify([*symbols.values(), sp.Symbol("u")], mass.LUsolve(rhs), "numpy")


def test_cartpole_accelerations_against_a_lagrangian_derivation() -> None:
    """A uniform rod of half-length l on a cart, angle from upright.

    With phi'' = (g sin + ...)/..., x'' = (u - mu x' + m_p l (phid^2 sin - phi'' cos))/M, the rod's centre of mass is at
    x + l sin(phi), l cos(phi), and its moment of inertia about it m_p l^2 / 3.
    """
    t, g, mc, mp, length, mu = sp.symbols("t g m_c m_p l mu", positive=True)
    x, phi = sp.Function("x")(t), sp.Function("phi")(t)
    xs, vs, ps, ws, u_symbol = sp.symbols("xs vs ps ws u")
    px, py = x + length * sp.sin(phi), length * sp.cos(phi)
    kinetic = mc * x.diff(t) ** 2 / 2 + mp * (px.diff(t) ** 2 + py.diff(t) ** 2) / 2
    kinetic += sp.Rational(1, 2) * (mp * length**2 / 3) * phi.diff(t) ** 2
    numbers = {g: 9.8, mc: 0.2, mp: 0.2, length: 0.5, mu: 0.5}
    lagrangian = (kinetic - mp * g * py).subs(numbers)
    substitutions = {x.diff(t): vs, phi.diff(t): ws, x: xs, phi: ps}
    force = u_symbol - numbers[mu] * x.diff(t)
    solve = lagrangian_accelerations(lagrangian, [x, phi], [force, sp.Integer(0)], substitutions)
    plant = CartPoleSwingUpEnv()
    rng = np.random.default_rng(0)
    for state in rng.uniform([-1, -3, -np.pi, -8], [1, 3, np.pi, 8], size=(100, 4)):
        u = rng.uniform(-2, 2)
        position, speed, angle, rate = state
        expected = np.asarray(solve(speed, rate, position, angle, u), float).ravel()
        derivative = plant.derivative(state, np.array([u]))
        # Rounding of about ten operations on terms of size 100.
        np.testing.assert_allclose(derivative[[1, 3]], expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(derivative[[0, 2]], state[[1, 3]])


def test_pendulum_acceleration_against_energy() -> None:
    """I phi'' = m g (l/2) sin(phi) + u about the hinge, I = m l^2 / 3."""
    plant = PendulumSwingUpEnv()
    for phi, phid, u in np.random.default_rng(0).uniform([-np.pi, -8, -2], [np.pi, 8, 2], size=(50, 3)):
        expected = (1.0 * 9.8 * 0.5 * np.sin(phi) + u) / (1.0 / 3.0)
        np.testing.assert_allclose(plant.derivative(np.array([phi, phid]), np.array([u])), [phid, expected], rtol=1e-14)


@pytest.mark.parametrize("env_id", SWING_UPS)
def test_one_step_against_an_adaptive_integrator(env_id: str) -> None:
    """RK4's local error is c dt^5: below 2e-4 at the speeds of a swing-up, and 32 times smaller at half the step."""
    plant = task(gym.make(env_id))
    angle = len(plant.state_space.high) - 2
    errors = {1: [], 2: []}
    actions = random_actions(gym.make(env_id), 40).astype(np.float64)
    for state, action in zip(states_of(plant, 40), actions, strict=True):
        exact = solve_ivp(
            lambda _, s, a=action: plant.derivative(s, a),
            (0.0, plant.dt),
            state,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        ).y[:, -1]
        one = plant.next_state(state, action)
        difference = one - exact
        difference[angle] = wrap_angle(difference[angle])
        errors[1].append(np.abs(difference).max())
        halves = rk4(plant.derivative, rk4(plant.derivative, state, action, plant.dt / 2), action, plant.dt / 2)
        errors[2].append(np.abs(halves - exact).max())
    assert max(errors[1]) < 2e-4
    # Two half steps: 2 (1/2)^5 = 1/16 of the error, up to terms of higher order.
    ratio = np.median(np.array(errors[1]) / np.array(errors[2]))
    assert 12 < ratio < 22


def test_rk4_is_of_fourth_order() -> None:
    """On s' = a s it gives exactly the Taylor polynomial of degree four of exp."""
    z = 0.3
    step = rk4(lambda s, a: a * s, np.array([1.0]), np.array([z]), 1.0)
    assert step[0] == pytest.approx(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24, rel=1e-15)


def test_wrap_angle() -> None:
    angles = np.array(
        [0.0, np.pi, -np.pi, 3 * np.pi, np.pi + 1e-9, -np.pi - 1e-9, 100.0, -1e-300, np.nextafter(np.pi, 4)]
    )
    wrapped = wrap_angle(angles)
    assert (wrapped > -np.pi).all()
    assert (wrapped <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), rtol=0, atol=1e-13)
    assert wrap_angle(np.array(-np.pi)) == np.pi


def bang_bang(plant: ControlTask, states: Array, rng: np.random.Generator) -> Array:
    """Inputs at their bounds: half random, half in the direction that feeds energy to the last speed."""
    low, high = (bound.astype(np.float64) for bound in (plant.action_space.low, plant.action_space.high))
    actions = np.where(rng.random((len(states), len(high))) < 0.5, low, high)
    half = len(states) // 2
    if isinstance(plant, CartPoleSwingUpEnv):
        actions[:half, 0] = -high * np.sign(states[:half, 3] * np.cos(states[:half, 2]))
    elif isinstance(plant, PendulumSwingUpEnv):
        actions[:half, 0] = high * np.sign(states[:half, 1])
    return actions


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("start", ["sampled", "extreme"])
def test_observation_bounds_hold(env_id: str, start: str) -> None:
    plant = task(gym.make(env_id))
    rng = np.random.default_rng(0)
    n = 400
    if start == "sampled":
        states = np.array([plant.reset(seed=k)[1]["state"] for k in range(n)])
    else:  # corners of what reset accepts
        states = rng.choice([-1.0, 1.0], size=(n, *plant.state_space.shape)) * plant.state_space.high
        if plant.angle is not None:
            states[:, plant.angle] = rng.uniform(-np.pi, np.pi, size=n)
    for _ in range(100):
        observations = plant.observe(states)
        assert np.isfinite(observations).all()
        assert ((observations >= plant.observation_space.low) & (observations <= plant.observation_space.high)).all()
        states = plant.next_state(states, bang_bang(plant, states, rng))


@pytest.mark.parametrize("alpha", [0.0, 1.0, 2.0, 4.0])
def test_linear_observation_bounds_hold_for_the_worst_input(alpha: float) -> None:
    """The input that maximises one coordinate of s_k is bang-bang with the signs of that row of A^j B."""
    plant = LinearTrackingEnv(alpha)
    powers = [np.eye(4)]
    for _ in range(100):
        powers.append(powers[-1] @ plant.A)
    reach = 10.0 * sum(np.abs(power @ plant.B).sum(axis=1) for power in powers[:-1])
    assert (np.abs(powers[-1]).sum(axis=1) + reach <= plant.observation_space.high).all()
    start = plant.state_space.high
    assert (np.abs(powers[-1]) @ start + reach <= plant.observation_space.high * (1 + 1e-12)).all()
    assert (start > 1.0).all()
