"""What the commands share: errors as one line, exit codes, JSON for machines, and how files are found.

Exit codes: 0 done; 1 an error with a message, or something wrong in what was to be checked; 2 a command line that is
none; 130 interrupted by Ctrl-C. Results go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

import difflib
import io
import json
import sys
from collections.abc import Iterable
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import rich
import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from typer.core import TyperGroup

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, UnknownIdError, visible
from mpcoffline.core.outputs import check_output
from mpcoffline.envs import PLANTS, ControlTask

from .others import AddedCommand, added_commands, import_plants

if TYPE_CHECKING:
    from gymnasium import Env

    from mpcoffline.control.policy import MPCPolicy
    from mpcoffline.learner.learner import OfflineMPCLearner

USER_ERROR = 1
INTERRUPTED = 130


class SafeConsole(Console):
    """A console on which no text steers the terminal, wherever it comes from: only styles do."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """What is shown, escape sequences in it made visible."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else visible(text), style, control)


console = SafeConsole()
messages = SafeConsole(stderr=True, soft_wrap=True, highlight=False)


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


def _checked_value(given: str | None) -> str | None:
    """Refuses what is no method of (VALUE); torch is imported where there is one to look at."""
    if given is not None and given not in (known := _value_methods()):
        raise typer.BadParameter(f"{given!r} is not one of {', '.join(known)}.")
    return given


def _value_methods() -> list[str]:
    from mpcoffline.learning import VALUE_METHODS

    return ["auto", *VALUE_METHODS]


Value = Annotated[
    str | None,
    typer.Option(
        help="Method of (VALUE), e.g. residual, the published one, or auto.",
        metavar="METHOD",
        show_default="the preset's",
        callback=_checked_value,
        autocompletion=_value_methods,
    ),
]
TaskArgument = Annotated[Task, typer.Argument(help="Which task.", show_default=False)]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
Alpha = Annotated[
    float,
    typer.Option(help="Size of the model error: of the plant (linear) or of the MPC's model (swing-ups).", min=0.0),
]
PlantAlpha = Annotated[
    float | None, typer.Option("--alpha", help="Plant of the linear task.", show_default="1.0", min=0.0, max=4.0)
]
Controller = Annotated[
    Path, typer.Argument(help="A saved policy or learner (.zip).", exists=True, dir_okay=False, show_default=False)
]
LearnerFile = Annotated[
    Path, typer.Argument(help="A saved learner (.zip).", exists=True, dir_okay=False, show_default=False)
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document, for machines.")]


class ErrorGroup(TyperGroup):
    """Shows what a user can do something about as one line, without traceback; knows commands of other packages."""

    @cached_property
    def _added(self) -> dict[str, AddedCommand]:
        return {name: command for name, command in added_commands().items() if name not in self.commands}

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of this package's commands, then of others'."""
        return [*super().list_commands(ctx), *self._added]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name; that of another package is not loaded for it."""
        return super().get_command(ctx, cmd_name) or self._added.get(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is called."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, command.loaded() if isinstance(command, AddedCommand) else command, rest

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Prints what the terminal's character set lacks by its number."""
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        return super().main(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """Runs a command; its error becomes a message and an exit code."""
        import gymnasium as gym

        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            messages.print("Interrupted.")
            raise typer.Exit(INTERRUPTED) from error
        except BrokenPipeError:  # the reader has seen enough: no error
            raise
        except (MPCOfflineError, gym.error.Error, OSError) as error:
            messages.print(f"[bold red]Error:[/] {escape(str(error))}")
            raise typer.Exit(USER_ERROR) from error


def examples(*lines: str) -> str:
    """The end of a command's help."""
    return "\n\n".join(["Examples:" if len(lines) > 1 else "Example:", *lines])


def progress_to_stderr() -> None:
    """Sends the progress bars of the library to stderr, so that stdout holds results alone."""
    rich.reconfigure(stderr=True)


def print_json(document: Any) -> None:
    """One JSON document on stdout; numbers that are not finite become null."""
    from mpcoffline.core.archive import plain

    typer.echo(json.dumps(plain(document), indent=2, allow_nan=False))


def say(text: str) -> None:
    """A line on stdout that is never wrapped, so that paths and commands in it can be copied."""
    console.print(text, highlight=False, soft_wrap=True)


def say_file(what: str, path: Path) -> None:
    """A line with a path."""
    say(f"{what}: [bold]{escape(str(path))}[/]")


def loaded_policy(path: Path) -> MPCPolicy:
    """The policy in a policy's or learner's file."""
    from mpcoffline.control.policy import MPCPolicy

    return MPCPolicy.load(path)


def loaded_learner(path: Path) -> OfflineMPCLearner:
    """The learner in a file; a policy's file is told apart from a damaged one."""
    from mpcoffline.core.archive import holds
    from mpcoffline.learner.learner import OfflineMPCLearner

    if holds(path, "policy"):
        raise FileFormatError(
            str(path),
            expected="a learner",
            actual="a policy, which does not know what it was learned from",
            hint="Give the learner's file; `mpcoffline learn` writes it beside the policy.",
        )
    return OfflineMPCLearner.load(path)


def made_environment(env_id: str, alpha: float | None, start: Start | None) -> Env[Any, Any]:
    """The environment; options that it does not know are refused before anything is solved."""
    import gymnasium as gym

    try:
        env: Env[Any, Any] = gym.make(env_id) if alpha is None else gym.make(env_id, alpha=alpha)
    except gym.error.UnregisteredEnv as error:
        nearest = difflib.get_close_matches(env_id, [plant.id for plant in PLANTS.values()], n=1, cutoff=0.3)
        hint = f"Did you mean {nearest[0]!r}?" if nearest else ""
        raise UnknownIdError("--env", expected="a registered environment", actual=repr(env_id), hint=hint) from error
    except TypeError as error:
        raise InvalidArgumentError("--alpha", expected=f"none for {env_id}", actual=str(alpha)) from error
    task = env.unwrapped
    known = task.starts if isinstance(task, ControlTask) else ()
    if start is not None and start.value not in known:
        raise InvalidArgumentError("--start", expected=f"one of {known} for {env_id}", actual=repr(start.value))
    return env


def check_figure(option: str, path: Path) -> None:
    """Refuses a file that Matplotlib cannot write: before the work, not after it."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.lstrip(".").lower() not in known:
        raise InvalidArgumentError(option, expected=f"a file ending in .{', .'.join(sorted(known))}", actual=str(path))


def check_out(option: str, path: Path, *, make: bool = False) -> None:
    """Refuses a file that could not be written: before the work, not after it. ``make`` if its folder will be made."""
    if not make and not path.parent.is_dir():
        raise InvalidArgumentError(option, expected="a file in a folder that exists", actual=str(path))
    check_output(path, make=make)
