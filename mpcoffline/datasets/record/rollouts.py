"""One episode of a policy in an environment, as it is recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError

from .episodes import EpisodeBuilder
from .plants import check_unchanged, no_end
from .stage_cost import PlantInfo, reward_of
from .watching import watched

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer


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
