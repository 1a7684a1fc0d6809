"""Recipes: everything that decides how a shipped data set was made, as one TOML file each."""

from __future__ import annotations

import importlib.resources
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable
from typing import Any

import gymnasium as gym

from mpcoffline.core.checks import check_integers, check_known, checked_seed
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs import PLANTS


def recorded_tasks() -> tuple[str, ...]:
    """Short names of the registered plants that have a recipe."""
    return tuple(name for name, plant in PLANTS.items() if plant.catalog is not None)


def catalog_file(name: str, task: str | None = None) -> Traversable:
    """A file beside a plant's recipe; by default of the resource package ``mpcoffline.datasets.catalog``."""
    package = (task and PLANTS[task].catalog) or "mpcoffline.datasets.catalog"
    return importlib.resources.files(package).joinpath(name)


@dataclass(frozen=True)
class Recipe:
    """How a data set is collected: environment, agent, and how the agent scales what it sees.

    Attributes:
        task: Short name of the plant.
        dataset_id: Minari id.
        description: One sentence.
        env_id: Gymnasium id.
        alpha: Argument of the linear task's plant; None for the other tasks, whose plant has none.
        algorithm: Name of the SB3 algorithm.
        steps: Number of transitions.
        seed: Seed of the agent, its exploration and its environment.
        observation_scale: The agent divides observation coordinate i by this, ``(ny,)``.
        reward_form: ``"linear"`` (-c L) or ``"sqrt"`` (-sqrt(c L)): the reward that the agent is trained on.
        reward_scale: The constant c.
        noise_kind: ``"normal"`` or ``"ornstein-uhlenbeck"``.
        noise_sigma: Its standard deviation, in units of the action normalised to [-1, 1].
        hidden: Widths of the hidden layers of actor and critic.
        hyperparameters: Passed on to the algorithm's constructor.
    """

    task: str
    dataset_id: str
    description: str
    env_id: str
    alpha: float | None
    algorithm: str
    steps: int
    seed: int
    observation_scale: tuple[float, ...]
    reward_form: str
    reward_scale: float
    noise_kind: str
    noise_sigma: float
    hidden: tuple[int, ...]
    hyperparameters: Mapping[str, Any]

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment's constructor."""
        return {} if self.alpha is None else {"alpha": self.alpha}

    def make_env(self) -> gym.Env[Any, Any]:
        """The plain environment, with its time limit."""
        return gym.make(self.env_id, **self.env_kwargs)

    @classmethod
    def load(cls, task: str) -> Recipe:
        """Reads the recipe of a task.

        Args:
            task: One of :func:`recorded_tasks`.

        Raises:
            UnknownIdError: For any other name.
        """
        check_known("task", task, recorded_tasks())
        content = tomllib.loads(catalog_file(f"{task}.toml", task).read_text(encoding="utf-8"))
        environment, training = content["environment"], content["training"]
        hyperparameters = dict(training["hyperparameters"])
        return cls(
            task=task,
            dataset_id=content["dataset"]["id"],
            description=content["dataset"]["description"],
            env_id=environment["id"],
            alpha=environment.get("alpha"),
            algorithm=training["algorithm"],
            steps=training["steps"],
            seed=training["seed"],
            observation_scale=tuple(training["observation_scale"]),
            reward_form=training["reward"]["form"],
            reward_scale=training["reward"]["scale"],
            noise_kind=training["noise"]["kind"],
            noise_sigma=training["noise"]["sigma"],
            hidden=tuple(hyperparameters.pop("hidden")),
            hyperparameters=hyperparameters,
        )

    def vary(
        self,
        *,
        alpha: float | None = None,
        steps: int | None = None,
        seed: int | None = None,
        dataset_id: str | None = None,
    ) -> Recipe:
        """The recipe with other numbers, and with an id that says so.

        A deviating run never takes the id of the shipped data set: the id becomes, for instance,
        ``mpcoffline/linear/ddpg-alpha050-seed3-v0``.

        Args:
            alpha: The plant of the linear task.
            steps: Number of transitions, at least 1.
            seed: Non-negative.
            dataset_id: Overrides the derived id.

        Raises:
            InvalidArgumentError: For an alpha on a task whose plant has none, or that an id cannot express
                (more than two decimals) while no ``dataset_id`` is given; for steps < 1 or a negative seed.
        """
        suffix = ""
        if alpha is not None and self.alpha is None:
            raise InvalidArgumentError(
                "alpha",
                expected=f"no alpha for task {self.task!r}",
                actual=str(alpha),
                hint="There alpha perturbs the MPC's model, not the plant: one data set serves every alpha.",
            )
        if alpha is not None and alpha != self.alpha:
            suffix += self._alpha_suffix(alpha, explicit=dataset_id is not None)
        seed = None if seed is None else checked_seed("seed", seed)
        if seed is not None and seed != self.seed:
            suffix += f"-seed{seed}"
        if steps is not None:
            check_integers(1, steps=steps)
            steps = int(steps)
        if steps is not None and steps != self.steps:
            suffix += f"-steps{steps}"
        name, version = self.dataset_id.rsplit("-v", 1)
        return replace(
            self,
            alpha=self.alpha if alpha is None else float(alpha),
            steps=self.steps if steps is None else steps,
            seed=self.seed if seed is None else seed,
            dataset_id=dataset_id or f"{name}{suffix}-v{version}",
        )

    @staticmethod
    def _alpha_suffix(alpha: float, *, explicit: bool) -> str:
        percent = round(100.0 * alpha)
        if not explicit and abs(100.0 * alpha - percent) > 1e-9:
            raise InvalidArgumentError(
                "alpha",
                expected="two decimals at most, since Minari ids have no dots",
                actual=str(alpha),
                hint="Pass a dataset_id to use any alpha.",
            )
        return f"-alpha{percent:03d}"
