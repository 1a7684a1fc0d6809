"""What holds for every registered plant, and the door through which others come in from outside."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import casadi as ca
import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline import nominal_mpc
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.envs import PLANTS, ControlTask, Parameter, Plant, State, find_plant, register
from mpcoffline.envs.page import page
from mpcoffline.envs.pendulum_swing_up import PLANT, PendulumSwingUpEnv

Array = NDArray[np.float64]
HELPERS = Path(__file__).parents[1] / "helpers"

every_plant = pytest.mark.parametrize("plant", PLANTS.values(), ids=list(PLANTS))


def task_of(plant: Plant) -> ControlTask:
    # Where alpha changes the plant, the one of alpha = 0 has the parameters of the description.
    return cast("ControlTask", gym.make(plant.id, **({} if plant.max_alpha is None else {"alpha": 0.0})).unwrapped)


def random_cases(plant: Plant, n: int = 200, speed: float = 2.0) -> tuple[Array, Array]:
    """States, speeds up to ``speed``, and actions within bounds."""
    rng, task = np.random.default_rng(0), task_of(plant)
    high = np.minimum(task.state_space.high, speed)
    if plant.angle is not None:
        high[plant.angle] = np.pi
    actions = rng.uniform(task.action_space.low, task.action_space.high, size=(n, len(plant.inputs)))
    return rng.uniform(-high, high, size=(n, len(high))), actions


def lifted(plant: Plant, states: Array) -> Array:
    """The observation in float64."""
    return np.stack(plant.lift(states.T, np.cos, np.sin), axis=-1)


def test_a_page_comes_from_the_description() -> None:
    written = """Falls.

## Description
Mine.

## Rewards
None.

## State Space
Own words.

## References
None."""
    made = page(replace(PLANT, starts={"mine": lambda rng: np.zeros(2)}), written)
    assert made.startswith("Falls.\n\n## Description\nMine.\n\n## Action Space\n`Box(-2.0, 2.0, (1,), float32)`")
    assert r"| 0   | torque $u$ | $-2$ | $2$ | N m  |" in made
    assert r"| 2   | $\dot\varphi$ | $-200$ | $200$ | rad/s |" in made
    assert "## State Space\nOwn words.\n\n## Rewards" in made
    assert '| `"mine"` (default) | its own   | its own' in made
    assert "| `l`                 | float            | 1.0      | length, 0.05 to 20 m " in made
    assert r'| `"hanging"`         | $\pi + U(-0.2, 0.2)$ | $U(-0.1, 0.1)$ |' in page(PLANT, written)


@every_plant
def test_casadi_and_numpy_run_the_same_equations(plant: Plant) -> None:
    states, actions = random_cases(plant)
    s, u = ca.SX.sym("s", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    entries = ca.vertsplit(s)
    values = {p.name: p.value for p in plant.parameters}
    rates = plant.dynamics(plant.lift(entries, ca.cos, ca.sin), ca.vertsplit(u), values)
    cost = plant.cost(entries, ca.vertsplit(u))
    function = ca.Function("f", [s, u], [ca.vertcat(*rates), cost])
    found = [np.asarray(part.full().T) for part in function(states.T, actions.T)]
    np.testing.assert_allclose(found[0], task_of(plant).derivative(states, actions), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[1].ravel(), task_of(plant).cost(states, actions), rtol=1e-12)


@every_plant
def test_the_model_of_mpc_1_without_error_is_one_step_of_the_environment(plant: Plant) -> None:
    """But for the errors of RK4, since it turns (cos, sin) instead of the angle."""
    states, actions = random_cases(plant)
    reached = lifted(plant, task_of(plant).next_state(states, actions))
    predicted = nominal_mpc(plant.id).model(lifted(plant, states), actions)
    np.testing.assert_allclose(predicted, reached, rtol=0, atol=1e-10 if plant.angle is None else 2e-3)


@every_plant
def test_derivatives_of_the_observation_are_those_of_the_state(plant: Plant) -> None:
    """Against a difference quotient of h(s)."""
    states, actions = random_cases(plant, 20)
    if plant.discrete:
        pytest.skip("a discrete-time map has none")
    y = [column[:, None] for column in lifted(plant, states).T]
    rates = task_of(plant).derivative(states, actions)
    found = np.concatenate(plant.lifted_rates(y, [column[:, None] for column in rates.T]), axis=-1)
    step = 1e-6
    expected = (lifted(plant, states + step * rates) - lifted(plant, states - step * rates)) / (2.0 * step)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@every_plant
def test_the_target_costs_nothing_and_is_a_success(plant: Plant) -> None:
    task, rest = task_of(plant), np.array(plant.nominal.input_target or [0.0] * len(plant.inputs))
    zero, mpc = np.zeros(len(plant.states)), nominal_mpc(plant.id)
    assert task.cost(zero, rest) == 0.0
    assert task.is_success(zero)
    np.testing.assert_allclose(task.next_state(zero, rest), zero, atol=1e-12)
    assert float(mpc.stage_function(lifted(plant, zero[None])[0], rest, mpc.theta)) == pytest.approx(0.0, abs=1e-12)
    states, actions = random_cases(plant)
    assert (task.cost(states, actions) > 0.0).all()


@every_plant
def test_starts_are_accepted_and_differ(plant: Plant) -> None:
    task = task_of(plant)
    for name in plant.starts:
        states = np.array([task.reset(seed=k, options={"start": name})[1]["state"] for k in range(50)])
        assert all(task.state_space.contains(state) for state in states)
        assert (states.std(axis=0) > 0.0).all()


@every_plant
def test_arguments_are_the_parameters(plant: Plant) -> None:
    task = task_of(plant)
    for p in plant.parameters:
        np.testing.assert_array_equal(getattr(task, p.name), p.value)
        if np.ndim(p.value) == 0:
            with pytest.raises(ValueError, match=f"{p.name}: expected a number from"):
                gym.make(plant.id, **{p.name: -1e9})
    with pytest.raises(TypeError, match="unexpected keyword argument 'warp'"):
        gym.make(plant.id, warp=1.0)


@every_plant
def test_the_recipe_is_of_this_plant(plant: Plant) -> None:
    if plant.catalog is None:
        pytest.skip("no data set")
    recipe = Recipe.load(plant.name)
    assert recipe.env_id == plant.id
    assert len(recipe.observation_scale) == len(plant.observations)
    assert (recipe.alpha is None) == (plant.max_alpha is None)


@every_plant
def test_found_by_name_and_by_id(plant: Plant) -> None:
    assert find_plant(plant.name) is find_plant(plant.id) is find_plant(f"mpcoffline:{plant.id}") is plant
    assert find_plant("CartPole-v1") is None


# ---------------------------------------------------------------- the door


OUTSIDER = """
import json, sys
import gymnasium as gym, matplotlib.figure, numpy as np
import own_plant
from gymnasium.envs.registration import EnvSpec
from mpcoffline import MPCPolicy, evaluate, nominal_mpc, plotting
from mpcoffline.cli.options import Task
from mpcoffline.envs import PLANTS
from mpcoffline.studies.references import best_known_costs

env = gym.make("own/Spring-v0", m=1.3)
again = gym.make(EnvSpec.from_json(env.spec.to_json()))
twins = gym.make_vec("own/Spring-v0", num_envs=3, vectorization_mode="vector_entry_point")
_, infos = twins.reset(seed=4)
env.reset(seed=4)
mpc = nominal_mpc("own/Spring-v0", alpha=1.0, seed=0)
loop = evaluate(MPCPolicy(nominal_mpc("own/Spring-v0")), "own/Spring-v0", 3, 0)
figure = plotting.loop_figure({"MPC_1": loop}, "own/Spring-v0")
states = np.array([one[0] for one in loop.states])
print(json.dumps({
    "plants": list(PLANTS),
    "m": [again.unwrapped.m, float(mpc.values["model.m"])],
    "parameters": list(mpc.model.space.names),
    "twin": type(twins).__name__,
    "success": loop.success.tolist(),
    "labels": [axes.get_ylabel() for axes in figure.axes],
    "command line": [task.value for task in Task],
    "best": (best_known_costs("spring", states, loop.actions and [np.array(loop.actions)]) <= loop.cost).tolist(),
}))
"""


def test_a_plant_of_another_package_is_one_file() -> None:
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", OUTSIDER], cwd=HELPERS, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["plants"] == [*PLANTS, "spring"]
    assert found["command line"] == found["plants"]
    assert found["m"][0] == 1.3
    assert found["m"][1] == pytest.approx(1.0 + 0.4 * np.random.default_rng(0).uniform(-1, 1, 1)[0])
    assert found["parameters"] == ["m"]
    assert found["twin"] == "SpringVectorEnv"
    assert found["success"] == [True] * 3
    assert found["best"] == [True] * 3
    assert found["labels"] == ["position $x$ (m)", "force $u$ (N)"]


def declared(task: str = "MineEnv", **changes: Any) -> type[ControlTask]:
    plant = replace(PLANT, **({"id": "mine/Mine-v0", "name": "mine"} | changes))
    return cast("type[ControlTask]", type(task, (PendulumSwingUpEnv,), {"plant": plant}))


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (lambda: declared(name="pendulum"), "a name and an id that are free"),
        (lambda: declared(id=PLANT.id), "a name and an id that are free"),
        (lambda: declared(id="CartPole-v1"), "an id 'namespace/Name-v0'"),
        (lambda: declared(name="Two Words"), "a name of small letters"),
        (lambda: declared("Mine"), "a class 'NameEnv'"),
        (lambda: type("MineEnv", (ControlTask,), {"plant": declared().plant}), "a method draw"),
        (lambda: type("MineEnv", (ControlTask,), {}), "a subclass of ControlTask with a plant"),
        (lambda: "MineEnv", "a subclass of ControlTask with a plant"),
    ],
)
def test_registration_refuses(task: Any, message: str) -> None:
    before = dict(PLANTS), set(gym.registry)
    with pytest.raises(ValueError, match=f"expected.*{re.escape(message)}"):
        register(task())
    assert (dict(PLANTS), set(gym.registry)) == before


def test_registering_the_same_again_changes_nothing() -> None:
    twin = register(PendulumSwingUpEnv)
    assert PLANTS["pendulum"] is PLANT
    assert twin.__name__ == "PendulumSwingUpVectorEnv"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": (Parameter("phi", 1.0),)}, "names: expected different ones, got phi"),
        ({"shown": ("phi", "height")}, "got height"),
        ({"states": (State("phi", "a", "rad", angle=True), State("phid", "b", "rad", angle=True))}, "angles: .*phid"),
        ({"nominal": replace(PLANT.nominal, weights=(1.0, 1.0))}, r"nominal weights: expected \[3, 1\] of them"),
        ({"dt": 0.0}, "dt: expected a positive number, got 0.0"),
        ({"starts": {}}, "starts: expected at least one"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"plant 'pendulum', {message}|plant 'pendulum'.*{message}"):
        replace(PLANT, **changes)


def test_what_reset_accepts_is_by_default_what_the_simulation_does() -> None:
    """Whatever the unit of a state is."""
    assert State("p", "p", "Pa", limit=1e7).largest_start == 1e7
    assert State("phi", "\\varphi", "rad", angle=True).largest_start == np.pi
    assert State("p", "p", "Pa", limit=1e7, start=2e5).largest_start == 2e5
