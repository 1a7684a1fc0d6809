"""What the controllers of a study are compared with, and from which starts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from mpcoffline import InvalidArgumentError, UnknownIdError, make_solver
from mpcoffline.envs.linear_tracking import ACTION_WEIGHT, STATE_WEIGHT, plant_matrices
from mpcoffline.studies.setups import setup_of


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_linear_reference_is_the_optimal_feedback(alpha: float) -> None:
    setup = setup_of("linear", alpha, 0)
    A, B = plant_matrices(alpha)
    root = np.sqrt(0.9)
    P = solve_discrete_are(root * A, root * B, STATE_WEIGHT, ACTION_WEIGHT)
    K = np.linalg.solve(ACTION_WEIGHT + 0.9 * B.T @ P @ B, 0.9 * B.T @ P @ A)
    states = np.random.default_rng(0).uniform(-1, 1, (4, 4))
    solution = make_solver(setup.reference).solve(states)
    np.testing.assert_allclose(solution.u0, -states @ K.T, atol=1e-5)
    np.testing.assert_allclose(solution.value, np.einsum("bi,ij,bj->b", states, P, states), rtol=1e-6)


def test_linear_alpha_goes_into_the_plant_and_the_data_set_not_into_the_model() -> None:
    setup = setup_of("linear", 0.5, 3)
    assert setup.dataset_id == "mpcoffline/linear/ddpg-alpha050-v0"
    assert setup.make_env().unwrapped.alpha == 0.5  # type: ignore[attr-defined]
    np.testing.assert_array_equal(setup.nominal.theta, setup_of("linear", 1.0, 0).nominal.theta)
    assert setup_of("linear", 1.0, 0).dataset_id == "mpcoffline/linear/ddpg-v0"


@pytest.mark.parametrize("task", ["pendulum", "cartpole"])
def test_swing_up_alpha_goes_into_the_model_and_the_reference_has_none(task: str) -> None:
    setup = setup_of(task, 1.0, 0)
    assert setup.dataset_id == f"mpcoffline/{task}/ddpg-v0"
    assert setup.env_kwargs == {}
    assert not np.array_equal(setup.nominal.theta, setup.reference.theta)
    np.testing.assert_array_equal(setup.reference.theta, setup_of(task, 0.0, 5).nominal.theta)


@pytest.mark.parametrize(
    ("task", "n", "hanging"), [("linear", 9, 0), ("pendulum", 24, 8), ("cartpole", 12, 4), ("pendulum", 1, 0)]
)
def test_a_third_of_the_swing_ups_start_hanging(task: str, n: int, hanging: int) -> None:
    starts = setup_of(task, 1.0, 0).starts(n)
    assert len(starts) == n
    assert starts.count("hanging") == hanging
    assert starts.count("broad") == n - hanging


def test_unknown_task_and_impossible_alpha_are_refused() -> None:
    with pytest.raises(UnknownIdError, match="Did you mean 'pendulum'"):
        setup_of("pendulom", 1.0, 0)
    with pytest.raises(InvalidArgumentError, match="alpha"):
        setup_of("pendulum", 2.5, 0)
    with pytest.raises(InvalidArgumentError, match="alpha"):
        setup_of("linear", 4.5, 0)
