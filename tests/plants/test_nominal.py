"""MPC_1 of the tasks: its model against the environments, and what alpha and seed do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.envs import ENV_IDS, PLANTS
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]
SPREADS = {plant.id: [p for p in plant.parameters if p.spread] for plant in PLANTS.values()}
UNCERTAIN = [env_id for env_id, parameters in SPREADS.items() if parameters]


def plant_of(env_id: str, **arguments: Any) -> Any:
    return gym.make(env_id, **arguments).unwrapped


def lifted(states: Array) -> Array:
    """The observation in float64: the environment's own is rounded to float32."""
    *rest, angle, speed = states.T
    return np.stack([*rest, np.cos(angle), np.sin(angle), speed], axis=1)


def model_parameters(env_id: str, alpha: float, seed: int) -> Array:
    mpc = nominal_mpc(env_id, alpha=alpha, seed=seed)
    return np.array([float(mpc.values[f"model.{p.name}"]) for p in SPREADS[env_id]])


def test_linear_model_is_the_plant_of_alpha_zero() -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(200, 4)), rng.uniform(-10, 10, size=(200, 2))
    model = nominal_mpc(LINEAR).model
    reached = plant_of(LINEAR, alpha=0.0).next_state(states, actions)
    np.testing.assert_allclose(model(states, actions), reached, rtol=0, atol=1e-12)
    other = plant_of(LINEAR, alpha=1.0).next_state(states, actions)
    assert np.abs(model(states, actions) - other).max() > 0.1


# The bounds that nominal_mpc's documentation states; they come from measuring 200,000 states.
@pytest.mark.parametrize(
    ("env_id", "speed", "bound"),
    [
        *((PENDULUM, 5.0, 1e-4), (PENDULUM, 10.0, 1e-3), (PENDULUM, 14.0, 3e-3)),
        *((CARTPOLE, 5.0, 5e-4), (CARTPOLE, 10.0, 5e-3), (CARTPOLE, 14.0, 3e-2)),
    ],
)
def test_swing_up_models_agree_with_one_step_of_the_environment(env_id: str, speed: float, bound: float) -> None:
    rng = np.random.default_rng(0)
    others = [] if env_id == PENDULUM else [3.0, 5.0]
    high = np.array([*others, np.pi, speed])
    states = rng.uniform(-high, high, size=(20_000, len(high)))
    states[:2000, -1 if env_id == PENDULUM else 3] = speed
    actions = rng.uniform(-2, 2, size=(20_000, 1))
    reached = lifted(plant_of(env_id).next_state(states, actions))
    deviation = np.abs(nominal_mpc(env_id).model(lifted(states), actions) - reached)
    assert deviation.max() <= bound
    assert deviation.max() >= 0.1 * bound  # the documentation is not needlessly pessimistic
    cosine = -3
    # RK4 of a constant speed truncates exp(i w dt) after the fourth power; the plant's own RK4 error adds.
    assert deviation[:, cosine : cosine + 2].max() <= 2 * (speed * 0.05) ** 5 / 120 + 0.2 * bound


@pytest.mark.parametrize("env_id", [LINEAR, PENDULUM, CARTPOLE])
def test_the_published_setup(env_id: str) -> None:
    mpc = nominal_mpc(env_id)
    assert mpc.horizon == (100 if env_id == LINEAR else 50)
    assert mpc.discount == 0.9
    space = plant_of(env_id).action_space
    np.testing.assert_array_equal(mpc.action_low, space.low)
    np.testing.assert_array_equal(mpc.action_high, space.high)
    x, u = np.full(mpc.nx, 0.5), np.full(mpc.nu, 1.5)
    stage = float(mpc.stage_function(x, u, mpc.theta))
    half = 0.5**2
    expected = {
        LINEAR: 20 * half + 2 * 0.1 * 1.5**2,
        PENDULUM: half + half + 0.1 * half + 0.1 * 1.5**2,
        CARTPOLE: 3 * half + 0.01 * half + 3 * half + half + 0.01 * half + 0.001 * 1.5**2,
    }[env_id]
    assert stage == pytest.approx(expected, rel=1e-13)
    # (TERM) is the norm, smoothed by eps = 0.1.
    norm = np.sqrt(half * mpc.nx)
    assert float(mpc.terminal_function(x, mpc.theta)) == pytest.approx(np.hypot(norm, 0.1) - 0.1, rel=1e-13)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_state_of_the_mpc_is_the_observation(env_id: str) -> None:
    env = gym.make(env_id)
    assert env.observation_space.shape == (nominal_mpc(env_id).nx,)
    assert nominal_mpc(env_id).model.dt == plant_of(env_id).dt


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE])
def test_a_seed_is_one_draw_that_alpha_scales(env_id: str) -> None:
    true = np.array([p.value for p in SPREADS[env_id]])
    spread = np.array([p.spread for p in SPREADS[env_id]])
    for seed in range(20):
        error = model_parameters(env_id, 1.0, seed) - true
        assert (np.abs(error) <= spread).all()
        for alpha in (0.0, 0.3, 1.5):
            np.testing.assert_allclose(
                model_parameters(env_id, alpha, seed) - true, alpha * error, rtol=1e-12, atol=1e-15
            )
    # One uniform per parameter, in the documented order.
    draws = np.random.default_rng(7).uniform(-1.0, 1.0, size=len(true))
    np.testing.assert_allclose(model_parameters(env_id, 0.8, 7), true + 0.8 * spread * draws, rtol=1e-15)
    assert not np.allclose(model_parameters(env_id, 1.0, 0), model_parameters(env_id, 1.0, 1))


def test_published_spreads() -> None:
    assert [(p.name, p.value, p.spread) for p in SPREADS[PENDULUM]] == [("m", 1.0, 0.5), ("l", 1.0, 0.5)]
    assert [(p.name, p.value, p.spread) for p in SPREADS[CARTPOLE]] == [
        *(("m_c", 0.2, 0.1), ("mu", 0.5, 0.25), ("m_p", 0.2, 0.1), ("l", 0.5, 0.25))
    ]


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE])
@pytest.mark.parametrize("alpha", [2.0, -0.1, 5.0, np.nan, np.inf])
def test_alphas_that_can_make_a_mass_vanish_are_refused(env_id: str, alpha: float) -> None:
    with pytest.raises(InvalidArgumentError, match="alpha: expected a number from 0 to below 2"):
        nominal_mpc(env_id, alpha=alpha, seed=0)


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE])
def test_alphas_just_below_the_limit_are_taken(env_id: str) -> None:
    for seed in range(200):
        assert (model_parameters(env_id, 1.99, seed) > 0).all()


@pytest.mark.parametrize("seed", [-1, 0.5])
def test_seeds_that_are_none_are_refused(seed: Any) -> None:
    with pytest.raises(InvalidArgumentError, match="seed: expected an integer >= 0"):
        nominal_mpc(PENDULUM, seed=seed)


def test_the_linear_task_takes_no_alpha() -> None:
    with pytest.raises(InvalidArgumentError, match=r"alpha: expected none.*gym\.make"):
        nominal_mpc(LINEAR, alpha=0.5)


def test_unknown_environments_name_the_nearest() -> None:
    with pytest.raises(UnknownIdError, match="Did you mean 'mpcoffline/PendulumSwingUp-v0'"):
        nominal_mpc("mpcoffline/PendulumSwingup-v0")
    with pytest.raises(UnknownIdError, match="mpcoffline/LinearTracking-v0"):
        nominal_mpc("CartPole-v1")


def test_the_id_with_a_module_prefix_is_known() -> None:
    assert nominal_mpc("mpcoffline:mpcoffline/PendulumSwingUp-v0").nx == 3


def test_errors_of_parameters_of_either_sign_and_of_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = PLANTS["pendulum"]
    mass, length, gravity = plant.parameters
    own = (replace(mass, value=-2.0, spread=0.5), replace(length, value=0.0, spread=0.1), gravity)
    monkeypatch.setitem(PLANTS, "pendulum", replace(plant, parameters=own))
    blocks = {block.name: block for block in nominal_mpc(PENDULUM, alpha=1.0, seed=0).space}
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, size=2)
    assert float(blocks["model.m"].value) == -2.0 + 0.5 * draws[0]
    assert (float(blocks["model.m"].low[0]), float(blocks["model.m"].high[0])) == (-200.0, -0.02)
    assert float(blocks["model.l"].value) == 0.1 * draws[1]
    assert (float(blocks["model.l"].low[0]), float(blocks["model.l"].high[0])) == (-np.inf, np.inf)
    with pytest.raises(InvalidArgumentError, match="from 0 to below 4, so that no parameter can vanish"):
        nominal_mpc(PENDULUM, alpha=4.0)


def test_it_carries_the_names_of_the_task() -> None:
    """In the order of the observation, which is a float32 of x, xd, the angle's cosine and sine, and its speed."""
    layout = nominal_mpc(CARTPOLE, alpha=0.0).layout
    assert [str(label) for label in layout.y_labels] == ["x [m]", "xd [m/s]", "cos phi", "sin phi", "phid [rad/s]"]
    assert [str(label) for label in layout.u_labels] == ["u [N]"]
    state = np.array([0.1, 0.2, 0.3, 0.4])
    observation, _ = gym.make(CARTPOLE).reset(options={"state": state})
    assert observation == pytest.approx([0.1, 0.2, np.cos(0.3), np.sin(0.3), 0.4])
