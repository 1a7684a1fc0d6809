"""Collecting a data set: an agent learns a task from scratch, and everything it tries is recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

import mpcoffline.envs  # noqa: F401 -- registers the environments
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.progress import Bars
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.datasets.recording.recorder import MinariRecorder
from mpcoffline.envs import ControlTask
from mpcoffline.envs.episode import DISCOUNT, EPISODE_STEPS

if TYPE_CHECKING:
    from minari import MinariDataset

FIRST_START = 10_000


def collect(
    task: str,
    *,
    alpha: float | None = None,
    steps: int | None = None,
    seed: int | None = None,
    dataset_id: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Trains the task's agent by its recipe and records every transition.

    What is recorded is raw (y, u in its units, reward -L, float64 cost and state), although the agent
    sees scaled observations and a scaled reward. ``return_curve`` gives the return of each episode.

    Args:
        task: Short name of the plant.
        alpha: Size of the model error of the linear task's plant; the recipe's (1.0) by default.
        steps: Number of transitions; the recipe's (500 episodes of 100) by default.
        seed: Seed of the agent and its environment; the recipe's by default.
        dataset_id: Minari id of the result. By default that of the recipe, with what deviates from it
            added to the name (``mpcoffline/linear/ddpg-alpha050-v0``).
        overwrite: Whether an existing data set of that id may be replaced.
        progress: Whether to show a progress bar with the running return.

    Returns:
        The stored data set. The agent always begins anew, and so does the recording: what an interrupted one of the
        same recipe has left is removed, that of any other recording is kept elsewhere, and either is said.

    Raises:
        UnknownIdError: For an unknown task.
        InvalidArgumentError: For a bad number or id, or an id that exists.
    """
    recipe = Recipe.load(task).vary(alpha=alpha, steps=steps, seed=seed, dataset_id=dataset_id)
    return collect_with(recipe, overwrite=overwrite, progress=progress)[0]


def collect_with(recipe: Recipe, *, overwrite: bool = False, progress: bool = True) -> tuple[MinariDataset, DDPG]:
    """Like :func:`collect` for a whole recipe; also returns the agent as it was at the end.

    Raises:
        InvalidArgumentError: For an id that is malformed or exists.
    """
    recorder = _RecipeRecorder(recipe, overwrite)
    # Two small networks: threads only get in each other's way.
    with _torch_threads(1), Bars(progress) as bars, closing(recorder):
        agent = make_agent(recipe)
        agent.learn(recipe.steps, callback=[recorder, _StopAt(recipe.steps), _ShownReturns(bars, recipe, recorder)])
    if recorder.dataset is None:
        raise InvalidArgumentError("training", expected="to run to its end", actual="no recorded data set")
    return recorder.dataset, agent


def make_agent(recipe: Recipe) -> DDPG:
    """The untrained agent of a recipe, with its training environment."""
    if recipe.algorithm != "DDPG":
        raise InvalidArgumentError("recipe algorithm", expected="'DDPG'", actual=repr(recipe.algorithm))
    plain = recipe.make_env()
    env = _TrainingReward(plain, recipe.reward_form, recipe.reward_scale)
    action_shape = cast("spaces.Box", env.action_space).shape
    return DDPG(
        "MlpPolicy",
        env,
        action_noise=_noise(recipe, action_shape),
        policy_kwargs={
            "net_arch": list(recipe.hidden),
            "features_extractor_class": _FixedScale,
            "features_extractor_kwargs": {"scale": recipe.observation_scale},
        },
        seed=recipe.seed,
        device="cpu",
        **recipe.hyperparameters,
    )


def return_curve(dataset: MinariDataset) -> NDArray[np.float64]:
    """The undiscounted return of each episode ``(E,)``, in the order of recording; minus the summed cost."""
    return np.array([np.sum(episode.rewards, dtype=np.float64) for episode in dataset.iterate_episodes()])


@dataclass(frozen=True)
class AgentScore:
    """Closed-loop figures of a deterministic agent over the episodes of one kind of start.

    Attributes:
        start: Name of the distribution of initial states.
        episodes: Number of episodes.
        cost: Mean of J, the summed cost of 100 steps.
        worst_cost: The largest J.
        discounted_cost: Mean of the cost discounted with 0.9.
        success: Share of episodes that end in success.
    """

    start: str
    episodes: int
    cost: float
    worst_cost: float
    discounted_cost: float
    success: float


def score_agent(agent: Any, env: gym.Env[Any, Any], *, episodes: int = 20, seed: int = FIRST_START) -> list[AgentScore]:
    """Runs a deterministic agent from fresh starts of every kind that the task knows, all episodes at once.

    Args:
        agent: Anything with SB3's ``predict`` on batches.
        env: One of this package's tasks.
        episodes: Episodes for each kind of start.
        seed: Seed of the starts, different from that of the training.

    Returns:
        One score for each kind of start.
    """
    task = cast("ControlTask", env.unwrapped)
    scores = []
    for start in task.starts:
        state = starting_states(env, [start] * episodes, seed)
        costs = np.empty((EPISODE_STEPS, episodes))
        for k in range(EPISODE_STEPS):
            action = np.asarray(agent.predict(task.observe(state), deterministic=True)[0], dtype=np.float64)
            costs[k] = task.cost(state, action)
            state = task.next_state(state, action)
        total = costs.sum(axis=0)
        discounted = DISCOUNT ** np.arange(EPISODE_STEPS) @ costs
        success = float(np.mean(task.is_success(state)))
        scores.append(
            AgentScore(start, episodes, float(total.mean()), float(total.max()), float(discounted.mean()), success)
        )
    return scores


def starting_states(env: gym.Env[Any, Any], starts: Sequence[str], seed: int) -> NDArray[np.float64]:
    """The states ``(n, ns)`` that ``evaluate`` starts from with these kinds of start, a seed each from ``seed`` on."""
    resets = (env.reset(seed=seed + i, options={"start": start}) for i, start in enumerate(starts))
    return np.stack([info["state"] for _, info in resets])


class _FixedScale(BaseFeaturesExtractor):
    """Divides observations by constants inside the agent, so that a recorder sees them unscaled."""

    def __init__(self, observation_space: spaces.Box, scale: tuple[float, ...]) -> None:
        super().__init__(observation_space, features_dim=len(scale))
        self.scale: torch.Tensor
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return observations / self.scale


class _TrainingReward(gym.Wrapper[Any, Any, Any, Any]):
    """The agent's reward, -c L or -sqrt(c L) instead of -L; the recorder takes the plant's."""

    def __init__(self, env: gym.Env[Any, Any], form: str, scale: float) -> None:
        super().__init__(env)
        if form not in ("linear", "sqrt"):
            raise InvalidArgumentError("recipe reward form", expected="'linear' or 'sqrt'", actual=repr(form))
        self._form, self._scale = form, scale

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = self.env.step(action)
        scaled = self._scale * float(info["cost"])
        return observation, -(scaled**0.5 if self._form == "sqrt" else scaled), terminated, truncated, info


def _noise(recipe: Recipe, shape: tuple[int, ...]) -> ActionNoise:
    mean, sigma = np.zeros(shape), np.full(shape, recipe.noise_sigma)
    if recipe.noise_kind == "normal":
        return NormalActionNoise(mean, sigma)
    if recipe.noise_kind == "ornstein-uhlenbeck":
        return OrnsteinUhlenbeckActionNoise(mean, sigma)
    raise InvalidArgumentError(
        "recipe noise kind", expected="'normal' or 'ornstein-uhlenbeck'", actual=repr(recipe.noise_kind)
    )


class _RecipeRecorder(MinariRecorder):
    """Starts anew where an interrupted one of the same recipe has left something, as the agent does."""

    leftover = "restart"

    def __init__(self, recipe: Recipe, overwrite: bool) -> None:
        super().__init__(
            recipe.dataset_id,
            overwrite=overwrite,
            algorithm_name=f"stable_baselines3.{recipe.algorithm}",
            description=recipe.description,
            cost_key="cost",  # the agent's reward is another
        )
        self.origin = asdict(recipe)


class _StopAt(BaseCallback):
    """Ends training after exactly this many steps; SB3 itself finishes its ``train_freq`` steps first."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self._steps = steps

    def _on_step(self) -> bool:
        return self.num_timesteps < self._steps


class _ShownReturns(BaseCallback):
    """Moves a bar, with the mean return of the last episodes."""

    def __init__(self, bars: Bars, recipe: Recipe, recorder: MinariRecorder, window: int = 20) -> None:
        super().__init__()
        self._bars, self._recorder, self._window = bars, recorder, window
        self._title, self._steps = f"{recipe.algorithm} learns {recipe.task}", recipe.steps

    def _on_step(self) -> bool:
        returns = self._recorder.returns[-self._window :]
        text = f"return {np.mean(returns):.1f}" if len(returns) else ""
        self._bars.show(self._title, min(self.num_timesteps, self._steps), self._steps, text)
        return True


@contextmanager
def _torch_threads(number: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
