"""Recording what an off-policy agent does while it learns, as a Minari data set."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.store.writing import check_new_dataset
from mpcoffline.datasets.table.numbers import check_storable

from .episode_builder import EpisodeBuilder
from .plants import common_spec
from .session import Recording
from .stage_cost import PlantInfo
from .vec_watching import VecWatch

if TYPE_CHECKING:
    from minari import MinariDataset

_SAME_SEED = (
    " The agent begins anew: where its seed ({0}) is that of the interrupted one, it records the same episodes again."
)


class MinariRecorder(BaseCallback):
    """An SB3 callback that writes every transition of an off-policy run into a Minari data set.

    Works with any number of environments and any off-policy algorithm (DDPG, TD3, SAC, ...), and costs the
    training no random number. A transition is recorded as the environment saw it:

    * observations before any normalisation by ``VecNormalize``, s+ of a finished episode from
      ``infos[i]["terminal_observation"]`` (a ``VecEnv`` has already reset by then);
    * actions in the environment's units, after exploration noise and clipping;
    * the reward that the plant paid, below wrappers that change it (``VecNormalize``, ``TransformReward``, ...;
      environments in other processes cannot be looked into: there it is what the ``VecEnv`` gives);
    * reward = ``-info["cost"]`` in float64 where that equals the plant's reward in float32, since a ``VecEnv`` rounds
      rewards. Where it does not, the key means something else (a violated limit, as in safe RL): the reward counts,
      which a warning says once;
    * ``infos/cost (T+1, 1)`` where it counts, and ``infos/state (T+1, nx)`` where each step gives one, in float64.
      Row 0 is the reset's; it is NaN for an episode that was already under way when recording began.

    Termination and truncation stay apart. An episode that is unfinished when training ends is kept, its last
    step marked as truncated. The data set stores the spec of the environment without training wrappers, so
    that ``dataset.recover_environment()`` rebuilds it.

    Every finished episode goes to a log at once, and of a longer one every 4096 steps, so that a training that is
    killed loses no finished episode and at most 4096 steps of one under way (which counts as cut off there). The end
    of training makes the data set of the logs. After an interruption, recording under the same id again
    goes on with the same logs, and ``mpcoffline.datasets.repair(dataset_id)`` makes the data set of what there is.

    Args:
        dataset_id: Minari id of the new data set, ``(namespace/)*name-vN``.
        overwrite: Whether an existing data set of this id may be replaced (at the end of training).
        algorithm_name: Stored as metadata; the name of the algorithm's class by default.
        description: Stored as metadata.
        cost_key: The key of ``info`` that *is* the stage cost, minus the plant's reward; by default ``"cost"``, where
            it proves to be. A key that is named must be there and equal at each step.
        resume: False deletes what an interrupted recording of this id has left instead of continuing it.
        sync_episodes: Finished episodes of an environment after which the log is forced to the disk; between
            that, a lost power supply (not a killed process) can take them.
        sync_seconds: The longest a finished episode waits for that.
        verbose: SB3's verbosity.

    Attributes:
        dataset: The stored data set; None before the end of training.
        returns: The undiscounted return of each episode finished so far, in the order in which they ended.

    Raises:
        InvalidArgumentError: At construction for an id against Minari's grammar, or one that exists; at the
            start of training for an on-policy algorithm, observations or actions that are not one array of numbers,
            copies of an environment with different arguments, another recorder at work on this id, an interrupted
            recording of another plant or algorithm, or another plant than that of the data set that this recorder made
            before; during training for a ``cost_key`` that is not there.
        InvalidDataError: During training where ``cost_key`` is not minus the reward.
        StorageError: During training where the disk is full or fails; the episodes before are safe.

    Example:
        ``agent.learn(50_000, callback=MinariRecorder("mpcoffline/pendulum/mine-v0"))``
    """

    sync_episodes: int
    sync_seconds: float

    leftover: ClassVar[str] = "refuse"
    origin: Mapping[str, Any] | None = None

    def __init__(
        self,
        dataset_id: str,
        *,
        overwrite: bool = False,
        algorithm_name: str | None = None,
        description: str | None = None,
        cost_key: str | None = None,
        resume: bool = True,
        sync_episodes: int = 10,
        sync_seconds: float = 5.0,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check_new_dataset(dataset_id, overwrite=overwrite)
        check_integers(1, sync_episodes=sync_episodes)
        self.dataset_id = dataset_id
        self.overwrite = overwrite
        self.algorithm_name = algorithm_name
        self.description = description
        self.cost_key = cost_key
        self.resume = resume
        self.sync_episodes, self.sync_seconds = sync_episodes, sync_seconds
        self.dataset: MinariDataset | None = None
        self.returns: list[float] = []
        self._running: list[EpisodeBuilder] = []
        self._recording: Recording | None = None
        self._plants: VecWatch | None = None
        self._rule = PlantInfo("MinariRecorder", cost_key)
        self._env: VecEnv | None = None
        self._plant: str | None = None

    def close(self) -> None:
        """Lets go of the logs of a training that was interrupted, so that another recorder can continue them."""
        if self._plants is not None:
            self._plants.remove()
            self._plants = None
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    def _on_training_start(self) -> None:
        agent = self._agent()
        self.close()
        check_storable("observation space", agent.observation_space)
        env_spec = common_spec("MinariRecorder", self.training_env.get_attr("spec"))
        plant = _class_of(self.training_env)
        if self.dataset is not None and self._plant != plant and None not in (plant, self._plant):
            raise InvalidArgumentError(
                f"environment of what extends data set {self.dataset_id!r}",
                expected=f"that of the data set: {self._plant}",
                actual=str(plant),
                hint="One data set holds one plant: record another one under another id, with a recorder of its own.",
            )
        plants = self._plants = VecWatch(self.training_env, "MinariRecorder")
        self._rule = PlantInfo("MinariRecorder", self.cost_key)
        _warn_of_changed_spaces(plants, self.training_env)
        self._recording = Recording(
            self.dataset_id,
            env_spec=env_spec,
            observation_space=plants.observation_space,
            action_space=plants.action_space,
            # A second `learn` with this recorder extends the data set that it wrote itself.
            mode="extend" if self.dataset is not None else "replace" if self.overwrite else "new",
            algorithm_name=self.algorithm_name or type(self.model).__name__,
            description=self.description,
            origin=self.origin or ({"plant": plant} if plant else None),
            resume=self.resume,
            leftover=self.leftover,
            sync_episodes=self.sync_episodes,
            sync_seconds=self.sync_seconds,
        )
        again = "" if agent.num_timesteps or agent.seed is None else _SAME_SEED.format(agent.seed)
        self._recording.tell_resumed("MinariRecorder", again)
        observations = plants.first_observations(self._before(agent))
        infos = self._first_infos(observations, plants.reset_infos)
        self._running = [EpisodeBuilder(s, info, self._rule) for s, info in zip(observations, infos, strict=True)]
        self._env, self._plant = self.training_env, plant

    def _first_infos(
        self, observations: np.ndarray[Any, Any], reset_infos: Sequence[Mapping[str, Any]]
    ) -> list[Mapping[str, Any]]:
        """What is known of the states from which this `learn` starts: nothing where an episode is joined halfway."""
        env, count = self.training_env, len(observations)
        fresh = [True] * count if self.locals["reset_num_timesteps"] else _fresh(env)
        before = self._running if env is self._env else []
        infos: list[Mapping[str, Any]] = (
            [
                b.last_info if np.array_equal(b.last_observation, s) else {}
                for b, s in zip(before, observations, strict=True)
            ]
            if before
            else [{}] * count
        )
        return [reset if new else info for new, reset, info in zip(fresh, reset_infos, infos, strict=True)]

    def _on_step(self) -> bool:
        recording, plants = self._started()
        for i, (info, done) in enumerate(zip(plants.infos, plants.dones, strict=True)):
            truncated = bool(done) and bool(info.get("TimeLimit.truncated", False))
            if self._running[i].is_long:
                recording.append_piece(i, self._running[i].take())
            self._running[i].add(
                plants.actions[i],
                plants.rewards[i],
                plants.terminal[i] if done else plants.observations[i],
                terminated=bool(done) and not truncated,
                truncated=truncated,
                info=info,
                given_reward=plants.given[i],
            )
            if done:
                episode = self._running[i].finish()
                self.returns.append(self._running[i].returned + float(np.sum(episode.rewards)))
                recording.append(i, episode, complete=True)
                # Now, not at the next step: an episode of one step would overwrite the reset info.
                self._running[i] = EpisodeBuilder(plants.observations[i], plants.reset_infos[i], self._rule)
        recording.poll()
        return True

    def _on_training_end(self) -> None:
        recording, plants = self._started()
        plants.remove()
        self._plants = None
        for i, builder in enumerate(self._running):
            if len(builder) > 0:
                episode = builder.finish(truncate=True)
                self.returns.append(builder.returned + float(np.sum(episode.rewards)))
                recording.append(i, episode, complete=False)
        self.dataset = recording.seal()
        self._recording = None

    def _started(self) -> tuple[Recording, VecWatch]:
        if self._recording is None or self._plants is None:
            raise InvalidArgumentError("MinariRecorder", expected="a training that has started", actual="none")
        return self._recording, self._plants

    def _agent(self) -> OffPolicyAlgorithm:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise InvalidArgumentError(
                "MinariRecorder's agent",
                expected="an off-policy SB3 algorithm (DDPG, TD3, SAC, ...)",
                actual=type(self.model).__name__,
            )
        return self.model

    @staticmethod
    def _before(agent: OffPolicyAlgorithm) -> np.ndarray[Any, Any]:
        """The observations s ``(n_envs, ny)`` from which the next step starts, not normalised."""
        before = agent._last_obs if agent.get_vec_normalize_env() is None else agent._last_original_obs
        return np.array(before)


def _fresh(env: VecEnv) -> list[bool]:
    """Which environments have been reset and not stepped since: all where SB3 goes on after `set_env` or `load`."""
    # Monitor keeps the rewards since the reset, TimeLimit counts; asked for first: without them a worker would die.
    if all(env.env_is_wrapped(Monitor)):
        return [len(rewards) == 0 for rewards in env.get_attr("rewards")]
    if all(env.env_is_wrapped(gym.wrappers.TimeLimit)):
        return [steps == 0 for steps in env.get_attr("_elapsed_steps")]
    return [False] * env.num_envs


def _warn_of_changed_spaces(plants: VecWatch, env: VecEnv) -> None:
    """Warns where a training wrapper changes what is recorded, so that the spec does not rebuild it."""
    inner = _without_wrappers(env)
    for kind in ("observation_space", "action_space"):
        recorded, original = getattr(plants, kind), getattr(inner, kind, None)
        if original is not None and recorded != original:
            warnings.warn(
                f"MinariRecorder: a wrapper changes the {kind} to {recorded}, and that is what gets recorded;"
                f" dataset.recover_environment() gives {original}. Scale inside the agent instead.",
                stacklevel=3,
            )


def _class_of(env: VecEnv) -> str | None:
    """The class of the plant, which tells plants without a spec apart; None where it is in another process."""
    if not isinstance(env.unwrapped, DummyVecEnv):
        return None
    return type(env.unwrapped.envs[0].unwrapped).__qualname__


def _without_wrappers(env: VecEnv) -> gym.Env[Any, Any] | None:
    """The first environment as its plain spec rebuilds it; None where it is in another process.

    No second one is made of the spec: a plant that is a machine exists once.
    """
    inner = env.unwrapped
    if not isinstance(inner, DummyVecEnv) or inner.envs[0].spec is None:
        return None
    plain: gym.Env[Any, Any] = inner.envs[0]
    while isinstance(plain, gym.Wrapper) and plain.spec is not None and plain.spec.additional_wrappers:
        plain = plain.env
    return plain
