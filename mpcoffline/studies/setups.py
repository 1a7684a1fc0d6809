"""What differs between the tasks in a study: environment, data set, reference controller, starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym

from mpcoffline.core.checks import checked_seed
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.envs import PLANTS, ControlTask
from mpcoffline.mpc import MPC
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.plants.optimal import optimal_linear_mpc


@dataclass(frozen=True)
class Setup:
    """One task at one model error.

    Attributes:
        task: Short name of the plant.
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

    Compared is with what the plant names as its reference: MPC_1 at alpha = 0 (true model, nominal cost) in the
    swing-ups, the closed-loop optimum in the linear task.

    Args:
        task: Short name of the plant.
        alpha: Size of the model error. In the linear task it changes the plant and with it the data set.
        seed: Seed of the model error's draws; the linear task has none.

    Raises:
        UnknownIdError: For another task.
        InvalidArgumentError: For an alpha out of the task's range, or a negative seed.
    """
    recipe, seed = Recipe.load(task), checked_seed("seed", seed)
    plant = PLANTS[task]
    arguments: dict[str, Any] = {}
    if plant.max_alpha is not None:
        if not 0.0 <= alpha <= plant.max_alpha:
            expected = f"a number from 0 to {plant.max_alpha:g}"
            raise InvalidArgumentError("alpha", expected=expected, actual=str(alpha))
        recipe, arguments = recipe.vary(alpha=alpha), {"alpha": alpha}
    error: dict[str, Any] = {} if arguments else {"alpha": alpha, "seed": seed}
    reference, description = nominal_mpc(plant.id), "MPC_1 with the true model (alpha = 0)"
    if plant.reference == "riccati":
        unwrapped = cast("ControlTask", gym.make(plant.id, **arguments).unwrapped)
        reference = optimal_linear_mpc(plant, **unwrapped.parameters)
        description = "closed-loop optimum (true plant and cost, discounted Riccati terminal cost)"
    return Setup(
        task,
        alpha,
        seed,
        plant.id,
        arguments,
        recipe.dataset_id,
        nominal=nominal_mpc(plant.id, **error),
        reference=reference,
        reference_description=description,
    )
