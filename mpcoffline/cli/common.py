"""What the commands share: errors as one line, exit codes, JSON for machines, and how files are found.

Exit codes: 0 done; 1 an error with a message, or something wrong in what was to be checked; 2 a command line that is
none, or the value of an option that is none; 130 interrupted by Ctrl-C. Results go to stdout, progress and messages to
stderr.
"""

from __future__ import annotations

import difflib
import io
import json
import logging
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich
import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.containers import Lines
from rich.markup import escape
from rich.segment import Segment
from rich.status import Status
from rich.text import Text
from typer.core import TyperGroup

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, UnknownIdError, visible
from mpcoffline.core.outputs import check_output
from mpcoffline.envs import PLANTS, ControlTask

from .others import AddedCommand, added_commands

if TYPE_CHECKING:
    from gymnasium import Env

    from mpcoffline.control.explicit.policy import DistilledPolicy
    from mpcoffline.control.loading import Acting
    from mpcoffline.learner.learner import OfflineMPCLearner

USER_ERROR = 1
USAGE_ERROR = 2
INTERRUPTED = 130


class SafeConsole(Console):
    """A console on which no text steers the terminal, wherever it comes from: only styles do."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """What is shown, escape sequences in it made visible."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else visible(text), style, control)


console = SafeConsole()
messages = SafeConsole(stderr=True, soft_wrap=True, highlight=False)


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
        found = super().get_command(ctx, cmd_name)
        return self._added.get(cmd_name) if found is None else _plain_flags(found, ctx)

    def get_params(self, ctx: Any) -> list[Any]:
        """The program's own options."""
        return _without_types(super().get_params(ctx))

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
            message(Text.assemble(("Error:", "bold red"), " ", visible(str(error))))
            raise typer.Exit(
                USAGE_ERROR if _of_an_option(error, ctx.invoked_subcommand, self) else USER_ERROR
            ) from error


def _plain_flags(command: Any, ctx: Any) -> Any:
    """A command whose help does not call its flags ``<bool>``, as if they took a value."""
    _without_types(command.params)
    if (helps := command.get_help_option(ctx)) is not None:  # kept by the command, once made
        _without_types([helps])
    for inner in getattr(command, "commands", {}).values():
        _plain_flags(inner, ctx)
    return command


def _without_types(params: list[Any]) -> list[Any]:
    for each in params:
        if getattr(each, "is_flag", False) and each.metavar is None:
            each.metavar = ""
    return params


def _of_an_option(error: Exception, called: str | None, group: ErrorGroup) -> bool:
    """Whether an error is of an argument that is an option of the command."""
    if not isinstance(error, InvalidArgumentError):
        return False
    command = group.commands.get(called or "")
    known = {option for each in getattr(command, "params", ()) for option in each.opts}
    return error.name in known or f"--{error.name.replace('_', '-')}" in known


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


def working(what: str) -> Status:
    """A sign of life on a terminal while something loads or is computed; to be entered before what it is a sign of."""
    return messages.status(what)


@contextmanager
def without(logger: logging.Logger) -> Iterator[None]:
    """Without what a logger tells, since the command says it in its result."""
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def message(text: str | Text) -> None:
    """A message on stderr: on a terminal broken between words, elsewhere one line."""
    _print_prose(messages, Text(visible(text)) if isinstance(text, str) else text)


def say(text: str) -> None:
    """A line on stdout that is never wrapped, so that paths and commands in it can be copied."""
    console.print(text, highlight=False, soft_wrap=True)


def say_prose(text: str | Text) -> None:
    """Sentences on stdout: on a terminal broken between words, elsewhere as they are."""
    _print_prose(console, Text(visible(text)) if isinstance(text, str) else text)


def _print_prose(where: Console, text: Text) -> None:
    lines = text.split("\n", allow_blank=True)
    if where.is_terminal:
        lines = Lines(part for line in lines for part in line.divide(_breaks(line.plain, where.width)))
    for line in lines:
        line.rstrip()
        where.print(line, highlight=False, soft_wrap=True)


def _breaks(line: str, width: int) -> list[int]:
    """Where a line is to go on in the next one: in front of a word that does not fit; a longer word than that stays."""
    found, begin = [], 0
    for word in re.finditer(r"\S+", line):
        if word.end() - begin > width and line[begin : word.start()].strip():
            begin = word.start()
            found.append(begin)
    return found


def say_file(what: str, path: Path) -> None:
    """A line with a path."""
    say(f"{what}: [bold]{escape(str(path))}[/]")


def loaded_policy(path: Path) -> Acting:
    """The policy in a policy's or learner's file."""
    with working("Loading"):
        from mpcoffline.control.loading import load_policy

        return load_policy(path)


def loaded_actor(path: Path) -> Acting | DistilledPolicy:
    """The policy in a file: an MPC's, a learner's, or an explicit one."""
    with working("Loading"):
        from mpcoffline.core.archive import holds, with_ending

        if holds(with_ending(path), "distilled"):
            from mpcoffline.control.explicit.policy import DistilledPolicy

            return DistilledPolicy.load(path)
    return loaded_policy(path)


def loaded_learner(path: Path) -> OfflineMPCLearner:
    """The learner in a file; a policy's file is told apart from a damaged one, and the learner beside it named."""
    with working("Loading"):
        from mpcoffline.core.archive import holds

        if holds(path, "policy"):
            stem = path.stem.removesuffix("_policy")
            beside = [each for each in (f"{stem}_learner.zip", f"{stem}.zip", "learner.zip") if each != path.name]
            found = [path.with_name(each) for each in beside if path.with_name(each).is_file()]
            hint = f"Its learner may be {found[0]}." if found else "`mpcoffline learn` writes one beside the policy."
            raise FileFormatError(
                str(path),
                expected="a learner",
                actual="a policy, which does not know what it was learned from",
                hint=hint,
            )
        from mpcoffline.learner.learner import OfflineMPCLearner

        return OfflineMPCLearner.load(path)


def made_environment(env: str, alpha: float | None, start: str | None) -> Env[Any, Any]:
    """The environment of an id or a plant file; options that it does not know are refused before anything is solved."""
    import gymnasium as gym

    if env.endswith(".py"):
        with working("Loading"):
            from mpcoffline.plants import load_plant

            if alpha is not None:
                raise InvalidArgumentError("--alpha", expected="none for a plant file", actual=str(alpha))
            made = load_plant(env).env()
    else:
        try:
            made = gym.make(env) if alpha is None else gym.make(env, alpha=alpha)
        except gym.error.UnregisteredEnv as error:
            nearest = difflib.get_close_matches(env, [plant.id for plant in PLANTS.values()], n=1, cutoff=0.3)
            hint = f"Did you mean {nearest[0]!r}?" if nearest else ""
            expected = "a registered environment, or a plant file (.py)"
            raise UnknownIdError("--env", expected=expected, actual=repr(env), hint=hint) from error
        except TypeError as error:
            raise InvalidArgumentError("--alpha", expected=f"none for {env}", actual=str(alpha)) from error
    task = made.unwrapped
    known = task.starts if isinstance(task, ControlTask) else ()
    if start is not None and start not in known:
        raise InvalidArgumentError("--start", expected=f"one of {known} for {env}", actual=repr(start))
    return made


def check_figure(option: str, path: Path) -> None:
    """Refuses a file that Matplotlib cannot write: before the work, not after it."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.lstrip(".").lower() not in known:
        raise InvalidArgumentError(option, expected=f"a file ending in .{', .'.join(sorted(known))}", actual=str(path))


def check_out(option: str, path: Path, *, make: bool = True) -> None:
    """Refuses a file that could not be written: before the work, not after it. ``make`` if its folder will be made."""
    if not make and not path.parent.is_dir():
        raise InvalidArgumentError(option, expected="a file in a folder that exists", actual=str(path))
    check_output(path, make=make)
