"""A learned MPC where Stable-Baselines3 expects an algorithm: models, callbacks, evaluation while learning, the zoo."""

from __future__ import annotations

import importlib
import logging
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Self, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from mpcoffline.control.course import Course
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.checks import check_integers, checked_seed
from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.core.outputs import make_folder
from mpcoffline.datasets.recording.plants import check_spaces, made, opened
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.solvers import Plan

if TYPE_CHECKING:
    from mpcoffline.datasets import TransitionTable

_log = logging.getLogger(__name__)


class MPCModel(BaseAlgorithm):
    """A learned MPC with the face of an SB3 algorithm, for scripts that were written for ``model = DDPG.load(...)``.

    Where the environment is under ``VecNormalize``, the policy un-normalises what it gets
    (:meth:`MPCPolicy.with_normalization`). Everything but learning is there; an MPC is learned by
    :class:`mpcoffline.OfflineMPCLearner`.

    Example:
        >>> model = MPCModel.load("policy.zip", env="mpcoffline/PendulumSwingUp-v0")
        >>> vec_env = model.get_env()
        >>> observations = vec_env.reset()
        >>> actions, state = model.predict(observations)

    Args:
        policy: The learned MPC.
        env: The environment to act in, or its id; wrapped in ``Monitor`` and ``DummyVecEnv`` unless it is a ``VecEnv``.
        verbose: As in SB3; 1 says which wrappers are added.
        seed: Seeds the exploration noise; the policy's own seed by default.

    Raises:
        InvalidArgumentError: If the environment has other spaces than the policy, or is none.
        UnknownIdError: For an environment id that is not registered.
    """

    policy: MPCPolicy

    def __init__(
        self,
        policy: MPCPolicy,
        env: gym.Env[Any, Any] | VecEnv | str | None = None,
        *,
        verbose: int = 0,
        seed: int | None = None,
    ) -> None:
        seed = None if seed is None else checked_seed("seed", seed)
        super().__init__(type(policy), env=None, learning_rate=0.0, verbose=verbose, device="cpu", seed=seed)
        self.policy, self.n_envs = policy, 1
        self.observation_space, self.action_space = policy.observation_space, policy.action_space
        if env is not None:
            self.set_env(_given(env, verbose))
        if seed is not None:
            self.policy.set_random_seed(seed)

    def __repr__(self) -> str:
        """The policy, and how many environments it acts in."""
        return f"{type(self).__name__}({self.policy!r}, {self.n_envs if self.env is not None else 'no'} environments)"

    def _setup_model(self) -> None:
        """There is nothing to set up: the policy is given."""

    def set_policy(self, policy: MPCPolicy) -> None:
        """Replaces the policy by another for the same environment.

        Args:
            policy: The new one.

        Raises:
            InvalidArgumentError: If it has other spaces than the environment.
        """
        if self.env is not None:
            check_spaces(policy, self.env)
            policy = policy.with_normalization(self.env) if self._vec_normalize_env is not None else policy
        self.policy = policy

    def set_env(self, env: gym.Env[Any, Any] | VecEnv, force_reset: bool = True) -> None:
        """Sets the environment to act in, of any number of copies.

        Args:
            env: The environment; wrapped in ``Monitor`` and ``DummyVecEnv`` unless it is a ``VecEnv``.
            force_reset: Accepted for SB3.

        Raises:
            InvalidArgumentError: If it has other spaces than the policy.
        """
        wrapped = self._wrap_env(_given(env, self.verbose), self.verbose)
        check_spaces(self.policy, wrapped)
        self.n_envs: int = wrapped.num_envs
        self.observation_space, self.action_space = wrapped.observation_space, wrapped.action_space
        super().set_env(wrapped, force_reset)
        self.policy = self.policy.with_normalization(wrapped)

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Plan | Course]:
        """Actions and the warm start of the next call, see :meth:`MPCPolicy.predict`."""
        return self.policy.predict(observation, state, episode_start, deterministic)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seeds the exploration noise and the environment, and as in SB3 Python, numpy and torch.

        Args:
            seed: None leaves everything as it is.
        """
        super().set_random_seed(seed)
        if seed is not None:
            self.policy.set_random_seed(seed)

    def learn(self, *args: Any, **kwargs: Any) -> NoReturn:
        """An MPC does not learn by acting.

        Raises:
            MPCOfflineError: Always; it says how an MPC is learned.
        """
        raise MPCOfflineError(
            "MPCModel.learn",
            expected="an MPC that is learned from data",
            actual="a call that would learn by acting",
            hint="Use mpcoffline.OfflineMPCLearner(mpc).fit(dataset), then MPCModel(learner.policy, env).",
        )

    def set_parameters(self, *args: Any, **kwargs: Any) -> NoReturn:
        """An MPC has no networks to load into.

        Raises:
            MPCOfflineError: Always; it says what to do instead.
        """
        raise MPCOfflineError(
            "MPCModel.set_parameters",
            expected="an MPC, which has no networks",
            actual="parameters of networks",
            hint="Use MPCModel.load(path), or MPCPolicy(mpc.with_theta(theta)).",
        )

    def save(  # type: ignore[override]
        self, path: str | PathLike[str], exclude: object = None, include: object = None
    ) -> None:
        """Writes the policy as :meth:`MPCPolicy.save` does, under SB3's rules for names.

        Args:
            path: The file; ``.zip`` is appended to a name without suffix, missing folders are made.
            exclude: Accepted for SB3.
            include: Accepted for SB3.
        """
        target = _with_suffix(Path(path))
        make_folder(target.parent)
        self.policy.save(target)

    @classmethod
    def load(  # type: ignore[override]
        cls,
        path: str | PathLike[str],
        env: gym.Env[Any, Any] | VecEnv | str | None = None,
        device: torch.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        verbose: int = 0,
        seed: int | None = None,
    ) -> Self:
        """Reads what :meth:`save`, :meth:`MPCPolicy.save` or :meth:`OfflineMPCLearner.save` wrote.

        Args:
            path: The file, with or without ``.zip``.
            env: The environment to act in, or its id.
            device: Accepted for SB3; MPCs are solved on the CPU.
            custom_objects: Accepted for SB3; the files hold no Python objects.
            print_system_info: Whether to print versions, as SB3 does.
            force_reset: Accepted for SB3.
            verbose: As in SB3.
            seed: Seeds the exploration noise.

        Raises:
            FileNotFoundError: If there is no such file.
            FileFormatError: If it is damaged, foreign (an SB3 agent, say) or of another version.
            InvalidArgumentError: If the environment has other spaces than the policy.
            MPCOfflineError: For a learner that was saved before ``fit``.
        """
        if print_system_info:
            get_system_info()
        file = Path(path)
        policy = MPCPolicy.load(file if file.exists() else _with_suffix(file))  # SB3 says which file it did not find
        return cls(policy, env, verbose=verbose, seed=seed)


def _with_suffix(path: Path) -> Path:
    return path if path.suffix else path.with_name(f"{path.name}.zip")


def _given(env: gym.Env[Any, Any] | VecEnv | str, verbose: int) -> gym.Env[Any, Any] | VecEnv:
    """The environment, made as SB3 makes it where its id is given; what is none is refused."""
    if isinstance(env, str):
        return made(env, lambda env_id: cast("gym.Env[Any, Any]", maybe_make_env(env_id, verbose)))
    return env if isinstance(env, VecEnv) else opened(env)


class EnvironmentEvaluator:
    """The mean return of a learner's policy in an environment: an evaluator for ``fit``, as d3rlpy's.

    Each epoch meets the same starts.

    Example:
        >>> learner.fit(dataset, evaluators={"return": EnvironmentEvaluator(env, n_episodes=5)})

    Args:
        env: The environment, ``VecEnv`` or id; one of the evaluator's own, since it is reset.
        n_episodes: Episodes an epoch.
        seed: Seed of the first episode's start.

    Raises:
        InvalidArgumentError: For a non-positive number of episodes, a negative seed, or what is no environment.
        UnknownIdError: For an environment id that is not registered.
    """

    def __init__(self, env: gym.Env[Any, Any] | VecEnv | str, n_episodes: int = 10, *, seed: int = 0) -> None:
        check_integers(1, n_episodes=n_episodes)
        self._env = MPCModel._wrap_env(_given(env, verbose=0))
        self._n_episodes, self._seed = int(n_episodes), checked_seed("seed", seed)

    def __call__(self, learner: OfflineMPCLearner, table: TransitionTable) -> float:
        """The mean undiscounted return, -J, in the environment's own reward."""
        statistics = unwrap_vec_normalize(self._env)
        before = None if statistics is None else (statistics.training, statistics.norm_reward)
        if statistics is not None:  # an evaluation neither changes its statistics nor is measured in them
            statistics.training = statistics.norm_reward = False
        try:
            self._env.seed(self._seed)
            mean, _ = evaluate_policy(MPCModel(learner.policy, self._env), self._env, self._n_episodes, warn=False)
        finally:
            if statistics is not None and before is not None:
                statistics.training, statistics.norm_reward = before
        return float(np.mean(mean))


class SB3Callback:
    """An SB3 callback (``EvalCallback``, ``CheckpointCallback``, ...) as a callback of ``fit``.

    It steps once at the end of each epoch from the first one of (FIT) on, when there is a policy, and sees an
    :class:`MPCModel` of the MPC that ``fit`` would hand out if it ended there. Frequencies such as ``eval_freq`` count
    epochs, ``num_timesteps`` counts gradient steps.

    Example:
        >>> best = EvalCallback(env, eval_freq=1, best_model_save_path="best")
        >>> learner.fit(dataset, callbacks=[SB3Callback(best)])
        >>> model = MPCModel.load("best/best_model", env=env)

    Args:
        callback: The SB3 callback.
        env: What it sees as ``training_env``; by default its ``eval_env`` where it has one.
        logger: Where it records; nowhere by default.

    A callback that asks to end the training ends ``fit`` after that epoch.
    """

    def __init__(self, callback: BaseCallback, env: VecEnv | None = None, logger: Logger | None = None) -> None:
        self._callback = callback
        self._env: VecEnv | None = getattr(callback, "eval_env", None) if env is None else env
        self._logger = logger or Logger(None, [])
        self._model: MPCModel | None = None

    def __call__(self, learner: OfflineMPCLearner, epoch: int, total_step: int) -> bool:
        """Steps the callback; False asks to end the fit."""
        try:
            policy = learner.policy
        except MPCOfflineError:  # (VALUE) goes before
            return True
        if self._model is None:
            self._model = self._started(learner, policy)
        self._model.set_policy(policy)
        self._model.num_timesteps = total_step
        go_on = bool(self._callback.on_step())
        if not go_on:
            _log.info("%s ends the fit after epoch %d", type(self._callback).__name__, epoch)
        return go_on

    def on_fit_end(self) -> None:
        """Ends the callback, where it has begun; another fit starts it anew."""
        if self._model is not None:
            self._model = None
            self._callback.on_training_end()

    def _started(self, learner: OfflineMPCLearner, policy: MPCPolicy) -> MPCModel:
        model = MPCModel(policy, self._env)
        model.set_logger(self._logger)
        self._callback.init_callback(model)
        self._callback.on_training_start({"learner": learner}, {})
        return model


def register_with_rl_zoo(name: str = "mpc") -> None:
    """Adds :class:`MPCModel` to the algorithms of ``rl_zoo3``, so that its programs take ``--algo mpc``.

    Args:
        name: What it is called there, and the name of its folder of models.

    Raises:
        InvalidArgumentError: If rl_zoo3 is not installed, or has another algorithm of that name.
    """
    try:
        algorithms = importlib.import_module("rl_zoo3").ALGOS
    except ImportError as error:
        raise InvalidArgumentError(
            "register_with_rl_zoo", expected="the package rl_zoo3", actual=str(error), hint="pip install rl_zoo3"
        ) from error
    if algorithms.setdefault(name, MPCModel) is not MPCModel:
        raise InvalidArgumentError("name", expected="one that rl_zoo3 does not use", actual=repr(name))
