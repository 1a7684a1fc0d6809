"""Data sets of a policy in an environment, without a learning agent."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from mpcoffline.core.checks import check_integers, checked_seed
from mpcoffline.core.errors import InvalidArgumentError

from .episode_builder import EpisodeBuilder
from .plants import check_spaces, check_unchanged, check_units, in_units, no_end, opened, plain_spec, step_cap
from .policy_origin import policy_origin
from .session import Recording
from .stage_cost import PlantInfo, reward_of
from .watching import plant_of, watched

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer


def record(
    env: gym.Env[Any, Any] | str,
    policy: Any,
    n_episodes: int,
    dataset_id: str,
    *,
    seed: int | None = None,
    deterministic: bool = True,
    overwrite: bool = False,
    algorithm_name: str | None = None,
    description: str | None = None,
    cost_key: str | None = None,
    max_episode_steps: int | None = None,
    resume: bool = True,
) -> MinariDataset:
    """Runs a policy and records what happens, as safely as :class:`mpcoffline.MinariRecorder`.

    A recording that was interrupted goes on, with a warning, with the episode after the last one finished; with a seed
    the result is the same as without the interruption. It goes on only where it is the same one: the policy (its name
    and its code; not the numbers in it), the environment with its arguments, the seed, and the number of episodes.
    Another one is kept elsewhere, which a warning says, and recording starts anew. Of an episode under way, 4096 steps
    at most are lost; going on begins it again, while :func:`repair` keeps it as one that was cut off.

    What is recorded is what the plant sees and pays, in its units: the reward below wrappers that change it, and
    -``info["cost"]`` in its place where the two are the same in float32. Where they are not, that key means something
    else (a violated limit, as in safe RL), and the reward counts, which a warning says once. Wrappers that rescale
    observations or actions are refused; those that add to them, stack or flatten them are recorded as they give them.

    Args:
        env: The environment or its id; not a vector environment.
        policy: Anything with SB3's ``predict``, or a function from an observation ``(ny,)`` to an action ``(nu,)``. An
            agent that learned under ``VecNormalize`` gets its observations normalised where it has the statistics.
        n_episodes: Number of episodes.
        dataset_id: Minari id of the new data set.
        seed: Episode i starts from ``env.reset(seed=seed + i)``.
        deterministic: Passed to ``predict``.
        overwrite: Whether an existing data set of this id may be replaced.
        algorithm_name: Stored as metadata; the name of the policy's class by default.
        description: Stored as metadata.
        cost_key: The key of ``info`` that *is* the stage cost, minus the plant's reward; by default ``"cost"``, where
            it proves to be. A key that is named must be there and equal at each step.
        max_episode_steps: Steps after which an episode is one without end, an error; by default 10,000, or the
            environment's own limit where that is larger.
        resume: False deletes what an interrupted recording of this id has left instead of continuing it: where numbers
            in the policy have changed, a gain or weights.

    Returns:
        The stored data set.

    Raises:
        InvalidArgumentError: For a bad id, spaces that cannot be stored, another recorder at work on it, fewer than one
            episode, a policy of other spaces, or wrappers that rescale. For an action outside the action space, an
            episode without end, or a ``cost_key`` that is not there: the episodes before are kept then.
        InvalidDataError: Where ``cost_key`` is not minus the reward; the episodes before are kept.
        UnknownIdError: For an environment id that is not registered.
        StorageError: Where the disk refuses; the episodes before are kept.
    """
    check_integers(1, n_episodes=n_episodes)
    first_seed = None if seed is None else checked_seed("seed", seed)
    made = opened(env)
    check_spaces(policy, made, narrower=True)
    check_units(made)
    actor = in_units(policy)
    cap, rule = step_cap(made, max_episode_steps), PlantInfo("record", cost_key)
    # Wrappers that change no space add nothing to what is recorded, and not all can be rebuilt.
    plant = plant_of(made)
    wrappers = (made.observation_space, made.action_space) != (plant.observation_space, plant.action_space)
    recording = Recording(
        dataset_id,
        env_spec=plain_spec(made.spec, wrappers=wrappers),
        observation_space=made.observation_space,
        action_space=made.action_space,
        mode="replace" if overwrite else "new",
        algorithm_name=algorithm_name or getattr(policy, "__name__", type(policy).__name__),
        description=description,
        origin=policy_origin(policy, made, int(n_episodes), first_seed, deterministic),
        resume=resume,
        leftover="aside",
        keep_cut=False,
    )
    recording.tell_resumed("record")
    on_piece = partial(recording.append_piece, 0)
    try:
        for number in range(recording.resumed, n_episodes):
            episode_seed = None if first_seed is None else first_seed + number
            episode = run_episode(made, actor, number, episode_seed, deterministic, rule, cap, on_piece)
            recording.append(0, episode, complete=True)
        return recording.seal()
    finally:
        recording.close()
        if isinstance(env, str):
            made.close()


def run_episode(
    env: gym.Env[Any, Any],
    policy: Any,
    number: int,
    seed: int | None,
    deterministic: bool,
    rule: PlantInfo,
    cap: int,
    on_piece: Callable[[EpisodeBuffer], None],
) -> EpisodeBuffer:
    """Runs a policy until the episode ends.

    Args:
        env: The environment.
        policy: Anything with SB3's ``predict``, or a function from an observation ``(ny,)`` to an action ``(nu,)``.
        number: The episode's, for messages.
        seed: Of the reset, of the action space and of the policy.
        deterministic: Passed to ``predict``.
        rule: What counts of the infos.
        cap: Steps after which the episode is one without end.
        on_piece: Takes the pieces of a long episode, but the last.

    Returns:
        The episode, or its last piece.

    Raises:
        InvalidArgumentError: For an action outside the action space, an episode without end, wrappers that rescale, or
            a missing ``cost_key``.
        InvalidDataError: For a reward that is no number, or not minus the cost that ``cost_key`` names.
    """
    with watched(env) as watch:
        observation, info = env.reset(seed=seed)
        if seed is not None:
            env.action_space.seed(seed)  # for policies that sample it
            if hasattr(policy, "set_random_seed"):  # for those that explore
                policy.set_random_seed(seed)
        episode = EpisodeBuilder(observation, info, rule)
        state: Any = None
        first, done = np.ones(1, dtype=bool), False
        while not done:
            if hasattr(policy, "predict"):
                action, state = policy.predict(
                    observation, state=state, episode_start=first, deterministic=deterministic
                )
            else:
                action = policy(observation)
            first = np.zeros(1, dtype=bool)
            action = np.asarray(action, dtype=env.action_space.dtype)
            if not env.action_space.contains(action):
                raise InvalidArgumentError(
                    f"policy, episode {number}, step {len(episode)}: action",
                    expected=f"an element of {env.action_space}",
                    actual=f"{action} of shape {action.shape}",
                )
            observation, given, terminated, truncated, info = env.step(action)
            check_unchanged(env, watch, action, observation)
            given = reward_of(f"episode {number}, step {len(episode)}", given)
            if episode.is_long:
                on_piece(episode.take())
            paid = given if watch.reward is None else watch.reward
            episode.add(
                *(action, paid, observation),
                terminated=bool(terminated),
                truncated=bool(truncated),
                info=info,
                given_reward=given,
            )
            done = terminated or truncated
            if not done and len(episode) >= cap:
                raise no_end(f"env, episode {number}", cap)
        return episode.finish()
