"""The directive ``command-help``: a section for each command of the program, with what its ``--help`` prints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx
from typer.testing import CliRunner

from mpcoffline.cli.main import app as program


class CommandHelp(Directive):
    """``{command-help}``, without arguments."""

    def run(self) -> list[nodes.Node]:
        """The sections, and one before them for the program itself."""
        runner = CliRunner(env={"COLUMNS": "86", "NO_COLOR": "1", "TERM": "dumb", "TERMINAL_WIDTH": "86"})
        sections: list[nodes.Node] = []
        for path in _commands(typer.main.get_command(program)):
            text = runner.invoke(program, [*path, "--help"], prog_name="mpcoffline", catch_exceptions=False).output
            name = " ".join(("mpcoffline", *path))
            section = nodes.section(ids=[name.replace(" ", "-")], names=[name])
            section += nodes.title("", "", nodes.literal("", name))
            lines = "\n".join(line.rstrip() for line in text.strip("\n").splitlines())
            section += nodes.literal_block(lines, lines, language="text", classes=["command-help"])
            sections.append(section)
        return sections


def _commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    for name, inner in getattr(command, "commands", {}).items():
        if not inner.hidden:
            yield from _commands(inner, (*path, name))


def setup(app: Sphinx) -> dict[str, bool]:
    """Adds the directive."""
    app.add_directive("command-help", CommandHelp)
    return {"parallel_read_safe": True}
