"""Commands and plants that other packages add: one entry point each, in two groups.

A ``pyproject.toml`` says ``[project.entry-points."mpcoffline.commands"]`` and ``hello = "package.module:app"``, where
``app`` is a ``typer.Typer``. Help and completion name the command; the package is imported when it is called. In
``[project.entry-points."mpcoffline.plants"]``, ``tank = "package.tank"`` is the module that registers a plant; it is
imported when the command line starts, as the plant's name is that of a task.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import typer
from typer.core import TyperCommand

from mpcoffline.core.errors import InvalidArgumentError, visible

GROUP = "mpcoffline.commands"


class AddedCommand(TyperCommand):
    """A command of another package, as help shows it: nothing of that package is imported for it.

    Args:
        entries: The entry points of that name; more than one if packages have taken the same.
    """

    def __init__(self, entries: list[EntryPoint]) -> None:
        self._entries = entries
        self._packages = " and ".join(sorted({entry.dist.name for entry in entries if entry.dist is not None}))
        super().__init__(entries[0].name, help=f"Added by {self._packages}.", rich_help_panel="Other packages")

    def loaded(self) -> Any:
        """The command itself.

        Raises:
            InvalidArgumentError: If it is broken or no ``typer.Typer``, or several packages have taken its name.
        """
        what = f"command {self.name!r} of {self._packages}"
        if len(self._entries) > 1:
            raise InvalidArgumentError(what, expected="one package that adds it", actual="several")
        try:
            app = self._entries[0].load()
        except Exception as error:  # whatever goes wrong in that package
            raise InvalidArgumentError(
                what, expected="a package that can be imported", actual=f"{type(error).__name__}: {error}"
            ) from error
        if not isinstance(app, typer.Typer):
            raise InvalidArgumentError(what, expected="a typer.Typer", actual=repr(app)[:200])
        return typer.main.get_command(app)


def added_commands() -> dict[str, AddedCommand]:
    """The commands of the installed packages by name."""
    found = defaultdict(list)
    for entry in entry_points(group=GROUP):
        found[entry.name].append(entry)
    return {name: AddedCommand(entries) for name, entries in sorted(found.items())}


def import_plants() -> None:
    """Imports what registers the plants of installed packages; a broken one is named and breaks nothing else."""
    for entry in entry_points(group="mpcoffline.plants"):
        try:
            entry.load()
        except Exception as error:  # whatever goes wrong in that package
            sys.stderr.write(visible(f"Without the plant of {entry.value!r}: {type(error).__name__}: {error}\n"))
