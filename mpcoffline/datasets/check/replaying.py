"""Does the environment repeat the data? Episodes simulated again from their recorded states and actions."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

import mpcoffline.envs  # noqa: F401 -- registers the environments
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, UnknownIdError
from mpcoffline.core.progress import Bars
from mpcoffline.core.tables import Table, verdict
from mpcoffline.core.text import visible
from mpcoffline.datasets.hub.loading import load_dataset

from .rebuilding import without_window
from .simulation import QUANTITIES, TOLERANCES, Deviation, Simulation

if TYPE_CHECKING:
    from minari import MinariDataset
    from rich.console import RenderableType

    Env = gym.Env[Any, Any]


@dataclass(frozen=True)
class ReplayReport:
    """What :func:`replay` found.

    Attributes:
        dataset_id: Minari id.
        env_id: Gymnasium id of the environment.
        episodes: Number of episodes simulated.
        steps: Number of steps simulated.
        free_run: Largest deviation of each of ``QUANTITIES`` that is recorded, over whole episodes: errors pile up
            along it, and a chaotic or unstable plant makes much of the last bit.
        one_step: The same, each step from the recorded state; empty for an environment that is no
            :class:`~mpcoffline.envs.ControlTask`, and without recorded states.
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
        table = Table(("largest deviation", "whole episode", "one step", "tolerance"), self._rows())
        return verdict(self.headline, self.ok, table, self._remarks())

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
    """Simulates episodes again, from their recorded first state, or else their seed, with their recorded actions.

    The environment is made without a window. Data sets of other tools often have no states but the seed (and the
    options) of each reset: these are simulated from it, and judged by whole episodes.

    Our environments are deterministic: on the machine that recorded, every number comes out the same bit for bit. On
    another machine (C library, instruction set) single steps agree to the tolerance, whole episodes of an unstable or
    chaotic plant need not; an angle at the seam of its range may come out on the other side of it.

    Args:
        dataset: The data set or its id; ``infos/state`` or the seeds of the resets must be recorded.
        n_episodes: How many, spread evenly over the data set; None for all.
        allow_import: Whether an environment that is not registered may be imported from where the data set says.
        tolerances: Largest allowed deviation by name in ``QUANTITIES``, in place of ``TOLERANCES``.
        progress: Whether to show a progress bar.

    Raises:
        UnknownIdError: For an unknown data set, or an environment that is neither registered nor may be imported.
        InvalidDataError: Without an environment; without ``infos/state`` and seeds; where the environment takes no
            state to start from, or has noise, and there is no seed; or for observations that are no arrays.
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
    indices = dataset.episode_indices
    if n_episodes is not None and n_episodes < len(indices):
        indices = indices[np.linspace(0, len(indices) - 1, n_episodes).round().astype(int)]
    simulation = Simulation(env, dataset)
    with closing(env), Bars(progress) as bars:
        for done, episode in enumerate(dataset.iterate_episodes(indices), start=1):
            simulation.run(episode)
            bars.show("Simulating again", done, len(indices))
    return ReplayReport(
        dataset_id=dataset.spec.dataset_id,
        env_id=env.spec.id if env.spec is not None else "",
        episodes=simulation.episodes,
        steps=simulation.steps,
        free_run=simulation.compared(simulation.free_run),
        one_step=simulation.compared(simulation.one_step),
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
        return gym.make(without_window(made), disable_env_checker=True)
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
