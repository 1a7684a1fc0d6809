"""Arguments and options that several commands have: one spelling, one meaning and one default each."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mpcoffline.envs import PLANTS

from .others import import_plants

import_plants()
Task = StrEnum("Task", {plant.name: plant.name for plant in PLANTS.values()})  # type: ignore[misc]


class Preset(StrEnum):
    """The presets of a learner, ``mpcoffline.learner.presets.PRESETS``."""

    paper = "paper"
    default = "default"
    fast = "fast"
    best = "best"


class Start(StrEnum):
    """The kinds of start."""

    broad = "broad"
    hanging = "hanging"


def beginning(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """What completes a word: those of some names that begin with it."""

    def completed(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return completed


def dataset_ids() -> list[str]:
    """The data sets that can be learned from."""
    from mpcoffline.datasets import list_datasets

    return [row.id for row in list_datasets()]


def plant_files() -> list[str]:
    """The Python files here, any of which may describe a plant."""
    return sorted(name for name in os.listdir() if name.endswith(".py"))


def environments() -> list[str]:
    """Ids of the environments that come with the package, then files."""
    return [*(plant.id for plant in PLANTS.values()), *plant_files()]


def tasks_and_files() -> list[str]:
    """Short names of the tasks, then files."""
    return [*map(str, Task), *plant_files()]


def _checked_value(given: str | None) -> str | None:
    """Refuses what is no method of (VALUE); torch is imported where there is one to look at."""
    if given is not None and given not in (known := _value_methods()):
        raise typer.BadParameter(f"{given!r} is not one of {', '.join(known)}.")
    return given


def _value_methods() -> list[str]:
    from mpcoffline.learning import VALUE_METHODS

    return ["auto", *VALUE_METHODS]


def checked_share(given: float | None) -> float | None:
    """Refuses what is no share, before anything heavy is imported."""
    if given is not None and not 0.0 < given <= 1.0:
        raise typer.BadParameter(f"{given:g} is not in (0, 1].")
    return given


Value = Annotated[
    str | None,
    typer.Option(
        help="Method of (VALUE), e.g. residual, the published one, or auto.",
        metavar="METHOD",
        show_default="the preset's",
        callback=_checked_value,
        autocompletion=beginning(_value_methods),
    ),
]
TaskArgument = Annotated[Task, typer.Argument(metavar="TASK", help="Which task.", show_default=False)]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
Alpha = Annotated[
    float,
    typer.Option(help="Size of the model error: of the plant (linear) or of the MPC's model (swing-ups).", min=0.0),
]
PlantAlpha = Annotated[
    float | None, typer.Option("--alpha", help="Plant of the linear task.", show_default="the environment's", min=0.0)
]
Controller = Annotated[
    Path,
    typer.Argument(
        metavar="POLICY.zip", help="A saved policy, or a learner.", exists=True, dir_okay=False, show_default=False
    ),
]
LearnerFile = Annotated[
    Path,
    typer.Argument(metavar="LEARNER.zip", help="A saved learner.", exists=True, dir_okay=False, show_default=False),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document, for machines.")]
