"""What differs between the tasks in a study: environment, data set, reference controller, starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.linalg import solve_discrete_are

from mpcoffline.core.checks import checked_seed
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.envs import ControlTask
from mpcoffline.envs.linear_tracking import ACTION_WEIGHT, MAX_ALPHA, STATE_WEIGHT, plant_matrices
from mpcoffline.mpc import MPC, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc


@dataclass(frozen=True)
class Setup:
    """One task at one model error.

    Attributes:
        task: ``"linear"``, ``"pendulum"`` or ``"cartpole"``.
        alpha: Size of the model error.
        seed: Seed of the model error's draws.
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        dataset_id: The data set that the task is learned from by default.
        nominal: MPC_1: inaccurate model, nominal cost.
        reference: The controller whose cost is the unit of the comparison.
        reference_description: What it is, for people.
    """

    task: str
    alpha: float
    seed: int
    env_id: str
    env_kwargs: dict[str, Any]
    dataset_id: str
    nominal: MPC = field(repr=False)
    reference: MPC = field(repr=False)
    reference_description: str

    def make_env(self) -> gym.Env[Any, Any]:
        """The environment."""
        return gym.make(self.env_id, **self.env_kwargs)

    def starts(self, n_episodes: int) -> list[str]:
        """The kind of start of each episode: two thirds broad, one third hanging where the task knows that."""
        env = self.make_env().unwrapped
        hanging = n_episodes // 3 if isinstance(env, ControlTask) and "hanging" in env.starts else 0
        return ["broad"] * (n_episodes - hanging) + ["hanging"] * hanging


def setup_of(task: str, alpha: float, seed: int) -> Setup:
    """The setup of a task as in arXiv:2301.01667.

    The swing-ups are compared with MPC_1 at alpha = 0 (true model, nominal cost), the linear task with the closed-loop
    optimum.

    Args:
        task: ``"linear"``, ``"pendulum"`` or ``"cartpole"``.
        alpha: Size of the model error. In the linear task it changes the plant and with it the data set.
        seed: Seed of the model error's draws; the linear task has none.

    Raises:
        UnknownIdError: For another task.
        InvalidArgumentError: For an alpha out of the task's range, or a negative seed.
    """
    recipe, seed = Recipe.load(task), checked_seed("seed", seed)
    if recipe.alpha is None:
        return Setup(
            task,
            alpha,
            seed,
            recipe.env_id,
            {},
            recipe.dataset_id,
            nominal=nominal_mpc(recipe.env_id, alpha=alpha, seed=seed),
            reference=nominal_mpc(recipe.env_id),
            reference_description="MPC_1 with the true model (alpha = 0)",
        )
    if not 0.0 <= alpha <= MAX_ALPHA:
        raise InvalidArgumentError("alpha", expected=f"a number from 0 to {MAX_ALPHA:g}", actual=str(alpha))
    recipe = recipe.vary(alpha=alpha)
    nominal = nominal_mpc(recipe.env_id)
    return Setup(
        task,
        alpha,
        seed,
        recipe.env_id,
        {"alpha": alpha},
        recipe.dataset_id,
        nominal=nominal,
        reference=optimal_linear_mpc(nominal, alpha),
        reference_description="closed-loop optimum (true plant and cost, discounted Riccati terminal cost)",
    )


def optimal_linear_mpc(nominal: MPC, alpha: float) -> MPC:
    """The optimal controller of the linear task: the MPC with the true plant, the true cost and terminal cost V*.

    While no input bound is active it equals the linear feedback of the Riccati equation
    P = W + gamma A'PA - gamma^2 A'PB (R + gamma B'PB)^-1 B'PA; where bounds are active it respects them.

    Args:
        nominal: MPC_1 of the task.
        alpha: The plant.
    """
    A, B = plant_matrices(alpha)
    root = np.sqrt(nominal.discount)
    P = solve_discrete_are(root * A, root * B, STATE_WEIGHT, ACTION_WEIGHT)
    true_model = nominal.with_theta(nominal.space.pack({"model.A": A, "model.B": B}))
    return true_model.replace(terminal_cost=QuadraticCost((P + P.T) / 2.0))
