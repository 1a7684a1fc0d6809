"""Does the environment repeat the data? Episodes simulated again from their recorded states and actions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

import mpcoffline.envs  # noqa: F401 -- registers the environments
from mpcoffline.checks import check_integers
from mpcoffline.core.text import visible
from mpcoffline.envs import ControlTask
from mpcoffline.errors import InvalidArgumentError, InvalidDataError, MPCOfflineError, UnknownIdError

from .minari_store import load_dataset

if TYPE_CHECKING:
    from minari import MinariDataset
    from rich.console import RenderableType

    Env = gym.Env[Any, Any]

QUANTITIES = ("observation", "state", "cost")
# Relative to 1 + size, for one step: another machine's sine differs in the last bit of float64, and rounding to
# float32 can turn that into one unit in its last place.
TOLERANCES: Mapping[str, float] = {"observation": 1e-6, "state": 1e-10, "cost": 1e-10}


@dataclass(frozen=True)
class Deviation:
    """The largest difference between what was recorded and what the environment gives.

    Attributes:
        absolute: In the unit of the quantity; inf where one of the two is not finite.
        relative: The same difference over 1 + size of what was recorded.
        episode: Where; None where there is no difference.
        step: The row of the episode's observations.
    """

    absolute: float = 0.0
    relative: float = 0.0
    episode: int | None = None
    step: int | None = None


@dataclass(frozen=True)
class ReplayReport:
    """What :func:`replay` found.

    Attributes:
        dataset_id: Minari id.
        env_id: Gymnasium id of the environment.
        episodes: Number of episodes simulated.
        steps: Number of steps simulated.
        free_run: Largest deviation of each of ``QUANTITIES`` over whole episodes: errors pile up along it, and a
            chaotic or unstable plant makes much of the last bit.
        one_step: The same, each step from the recorded state; empty for an environment that is no
            :class:`~mpcoffline.envs.ControlTask`.
        wrong_ends: Episodes that terminate where the recording does not, or the other way round.
        skipped: Episodes that could not be simulated, each with the reason.
        tolerances: What :attr:`ok` allows, relative to 1 + size.
    """

    dataset_id: str
    env_id: str
    episodes: int
    steps: int
    free_run: Mapping[str, Deviation]
    one_step: Mapping[str, Deviation]
    wrong_ends: tuple[int, ...]
    skipped: tuple[tuple[int, str], ...]
    tolerances: Mapping[str, float]

    @property
    def bitwise(self) -> bool:
        """Whether every number came out the same: so it does on the machine that recorded."""
        return self.episodes > 0 and not self.wrong_ends and all(d.absolute == 0.0 for d in self.free_run.values())

    @property
    def ok(self) -> bool:
        """Whether the environment is the recorded one up to rounding: one step deviates by no more than the tolerance.

        Where single steps cannot be judged, the whole episode is.
        """
        judged = self.one_step or self.free_run
        close = all(d.relative <= self.tolerances[name] for name, d in judged.items())
        return self.episodes > 0 and not self.wrong_ends and close

    @property
    def headline(self) -> str:
        """One line: id, environment, verdict."""
        verdict = "bitwise equal" if self.bitwise else "equal up to rounding" if self.ok else "DIFFERENT"
        skipped = f", {len(self.skipped)} skipped" if self.skipped else ""
        return f"{self.dataset_id} in {self.env_id}: {verdict} ({self.episodes} episodes, {self.steps} steps{skipped})"

    def __str__(self) -> str:
        rows = [f"{name}: whole episode {a}, one step {b}, tolerance {c}" for name, a, b, c in self._rows()]
        return visible("\n".join([self.headline, *rows, *self._remarks()]))

    def __rich__(self) -> RenderableType:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table("largest deviation", "whole episode", "one step", "tolerance", box=None, pad_edge=False)
        for row in self._rows():
            table.add_row(*row)
        headline = Text(visible(self.headline), style="bold green" if self.ok else "bold red")
        return Group(headline, table, *(Text(visible(line)) for line in self._remarks()))

    def _rows(self) -> list[tuple[str, str, str, str]]:
        def cell(deviations: Mapping[str, Deviation], name: str) -> str:
            found = deviations.get(name)
            if found is None:
                return "-"
            where = f" (episode {found.episode}, step {found.step})" if found.episode is not None else ""
            return f"{found.absolute:.2g}{where}"

        return [
            (name, cell(self.free_run, name), cell(self.one_step, name), f"{self.tolerances[name]:g} (1 + size)")
            for name in self.free_run
        ]

    def _remarks(self) -> list[str]:
        lines = [f"episode {number} skipped: {reason}" for number, reason in self.skipped[:5]]
        if self.wrong_ends:
            lines.append(f"terminations differ in episodes {', '.join(map(str, self.wrong_ends[:10]))}")
        return lines


def replay(
    dataset: MinariDataset | str,
    n_episodes: int | None = None,
    *,
    allow_import: bool = False,
    tolerances: Mapping[str, float] | None = None,
    progress: bool = False,
) -> ReplayReport:
    """Simulates episodes again, from their recorded first state with their recorded actions.

    Our environments are deterministic: on the machine that recorded, every number comes out the same bit for bit. On
    another machine (C library, instruction set) single steps agree to the tolerance, whole episodes of an unstable or
    chaotic plant need not; an angle at the seam of its range may come out on the other side of it.

    Args:
        dataset: The data set or its id; ``infos/state`` must be recorded.
        n_episodes: How many, spread evenly over the data set; None for all.
        allow_import: Whether an environment that is not registered may be imported from where the data set says.
        tolerances: Largest allowed deviation by name in ``QUANTITIES``, in place of ``TOLERANCES``.
        progress: Whether to show a progress bar.

    Raises:
        UnknownIdError: For an unknown data set, or an environment that is neither registered nor may be imported.
        InvalidDataError: Without ``infos/state`` or an environment, or where that takes no state to start from, or has
            noise.
        InvalidArgumentError: For ``n_episodes`` < 1 or an unknown quantity.
    """
    if n_episodes is not None:
        check_integers(1, n_episodes=n_episodes)
    unknown = set(tolerances or {}) - set(QUANTITIES)
    if unknown:
        raise InvalidArgumentError("tolerances", expected=f"names out of {QUANTITIES}", actual=str(sorted(unknown)))
    if isinstance(dataset, str):
        dataset = load_dataset(dataset)
    env = recover_environment(dataset, allow_import=allow_import)
    if isinstance(env.unwrapped, ControlTask) and env.unwrapped.noisy:
        raise InvalidDataError(
            f"data set {dataset.spec.dataset_id!r}",
            expected="an environment without noise, which alone can be simulated again",
            actual=f"{dataset.env_spec.id if dataset.env_spec else env} with process or measurement noise",
        )
    indices = dataset.episode_indices
    if n_episodes is not None and n_episodes < len(indices):
        indices = indices[np.linspace(0, len(indices) - 1, n_episodes).round().astype(int)]
    episodes = dataset.iterate_episodes(indices)
    if progress:
        from rich.progress import track

        episodes = track(episodes, description="Simulating again", total=len(indices))
    simulation = _Simulation(env, f"data set {dataset.spec.dataset_id!r}")
    try:
        for episode in episodes:
            simulation.run(episode)
    finally:
        env.close()
    return ReplayReport(
        dataset_id=dataset.spec.dataset_id,
        env_id=env.spec.id if env.spec is not None else "",
        episodes=simulation.episodes,
        steps=simulation.steps,
        free_run=simulation.free_run,
        one_step=simulation.one_step,
        wrong_ends=tuple(simulation.wrong_ends),
        skipped=tuple(simulation.skipped),
        tolerances={**TOLERANCES, **(tolerances or {})},
    )


def recover_environment(dataset: MinariDataset, *, allow_import: bool = False) -> Env:
    """The environment of a data set, importing nothing that the data set's files name unless allowed.

    ``dataset.recover_environment()`` imports whatever module ``metadata.json`` names: code of somebody else's choice,
    where the data set came from elsewhere. Here the registered environment of that id is made, with the arguments of
    the data set.

    Args:
        dataset: The data set.
        allow_import: Whether the named modules may be imported.

    Raises:
        InvalidDataError: For a data set without an environment, or whose environment cannot be made.
        UnknownIdError: For an environment that is not registered, or registered as something else, or with wrappers.
    """
    name, spec = f"data set {dataset.spec.dataset_id!r}", dataset.env_spec
    if spec is None:
        raise InvalidDataError(name, expected="the environment that it was recorded in", actual="none (env_spec)")
    made = spec if allow_import else _registered(name, spec)
    try:
        return gym.make(made, disable_env_checker=True)
    except (ImportError, AttributeError, TypeError, ValueError, gym.error.Error) as error:
        raise InvalidDataError(
            f"{name}: environment {spec.id!r}",
            expected=f"what {made.entry_point} makes of the arguments {dict(spec.kwargs)}",
            actual=f"{type(error).__name__}: {error}",
            hint="Install the package that it comes from.",
        ) from error


def _registered(name: str, spec: EnvSpec) -> EnvSpec:
    hint = (
        "Import the module that registers it first, or allow the import (allow_import=True) if you trust the source:"
        " importing runs its code."
    )
    known = gym.registry.get(spec.id)
    if known is None:
        raise UnknownIdError(
            f"{name}: environment",
            expected="one that is registered",
            actual=f"{spec.id!r} of {spec.entry_point}",
            hint=hint,
        )
    if known.entry_point != spec.entry_point:
        raise UnknownIdError(
            f"{name}: environment {spec.id!r}",
            expected=f"the registered {known.entry_point}",
            actual=str(spec.entry_point),
            hint=hint,
        )
    if spec.additional_wrappers:
        wrappers = ", ".join(wrapper.entry_point for wrapper in spec.additional_wrappers)
        raise UnknownIdError(
            f"{name}: environment {spec.id!r}", expected="no wrappers to import", actual=wrappers, hint=hint
        )
    return replace(known, kwargs=dict(spec.kwargs), max_episode_steps=spec.max_episode_steps)


class _Simulation:
    """Steps the environment along recorded episodes and keeps the largest deviations."""

    def __init__(self, env: Env, name: str) -> None:
        self.env, self.name = env, name
        self.task = env.unwrapped if isinstance(env.unwrapped, ControlTask) else None
        self.episodes = self.steps = 0
        self.free_run = dict.fromkeys(QUANTITIES, Deviation())
        self.one_step = dict.fromkeys(QUANTITIES, Deviation()) if self.task is not None else {}
        self.wrong_ends: list[int] = []
        self.skipped: list[tuple[int, str]] = []

    def run(self, episode: Any) -> None:
        """Simulates one episode."""
        number = int(episode.id)
        states = (episode.infos or {}).get("state")
        if states is None:
            raise InvalidDataError(
                f"{self.name}, episode {number}: infos/state", expected="the state at every step", actual="none"
            )
        recorded = {
            "observation": np.asarray(episode.observations),
            "state": np.asarray(states),
            "cost": np.concatenate([[0.0], -np.asarray(episode.rewards, dtype=np.float64)]),
        }
        known = np.isfinite(recorded["state"]).all(axis=1)
        if not known.all():
            # Recording began within the episode: from the first known state on.
            first = int(np.argmax(known)) if known.any() else len(known)
            if first >= len(episode.actions):
                self.skipped.append((number, "no finite state to start from"))
                return
        else:
            first = 0
        recorded = {key: value[first:] for key, value in recorded.items()}
        recorded["cost"][0] = 0.0  # that of the step before
        actions = np.asarray(episode.actions)[first:]
        try:
            simulated, terminated = self._simulate(recorded["state"][0], actions)
        except MPCOfflineError:
            raise
        except ValueError as error:  # a state that the environment does not start from
            self.skipped.append((number, str(error)))
            return
        self.episodes, self.steps = self.episodes + 1, self.steps + len(actions)
        self._compare(self.free_run, recorded, simulated, number, first)
        if terminated != list(map(bool, episode.terminations[first:])):
            self.wrong_ends.append(number)
        if self.task is not None:
            self._compare(self.one_step, recorded, self._single_steps(recorded["state"], actions), number, first)

    def _simulate(self, state: NDArray[Any], actions: NDArray[Any]) -> tuple[dict[str, NDArray[Any]], list[bool]]:
        observation, info = self.env.reset(options={"state": state})
        if "state" not in info or not np.array_equal(info["state"], state):
            raise InvalidDataError(
                f"{self.name}: its environment",
                expected="one that starts from reset(options={'state': s}) and says so in info['state']",
                actual=f"info['state'] = {info.get('state')} for s = {state}",
            )
        rows, terminations = [(observation, info["state"], 0.0)], []
        for action in actions:
            observation, reward, terminated, _, info = self.env.step(action)
            rows.append((observation, info["state"], info.get("cost", -float(reward))))
            terminations.append(bool(terminated))
        return dict(zip(QUANTITIES, map(np.array, zip(*rows, strict=True)), strict=True)), terminations

    def _single_steps(self, states: NDArray[Any], actions: NDArray[Any]) -> dict[str, NDArray[Any]]:
        if self.task is None:
            return {}
        space, before = self.task.action_space, states[:-1]
        applied = np.clip(actions.astype(np.float64), space.low, space.high)
        reached = np.concatenate([states[:1], self.task.next_state(before, applied)])
        cost = np.concatenate([[0.0], self.task.cost(before, applied)])
        return {"observation": self.task.observe(reached), "state": reached, "cost": cost}

    @staticmethod
    def _compare(
        worst: dict[str, Deviation],
        recorded: Mapping[str, NDArray[Any]],
        simulated: Mapping[str, NDArray[Any]],
        episode: int,
        first: int,
    ) -> None:
        for key in worst:
            if recorded[key].shape != simulated[key].shape:
                worst[key] = Deviation(math.inf, math.inf, episode, first)
                continue
            a, b = recorded[key].astype(np.float64), simulated[key].astype(np.float64)
            with np.errstate(invalid="ignore"):
                absolute = np.where(a == b, 0.0, np.nan_to_num(np.abs(a - b), nan=np.inf))
                relative = np.nan_to_num(absolute / (1.0 + np.abs(a)), nan=np.inf)
            largest = float(absolute.max())
            if largest > 0.0 and float(relative.max()) >= worst[key].relative:
                place = np.unravel_index(int(relative.argmax()), relative.shape)
                found = Deviation(float(absolute[place]), float(relative[place]), episode, first + int(place[0]))
                worst[key] = found
