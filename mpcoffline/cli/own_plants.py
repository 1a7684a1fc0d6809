"""The commands for plants of one's own: ``mpcoffline new``."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from mpcoffline.core.errors import StorageError
from mpcoffline.core.outputs import write_file

from .common import check_out, examples, say, say_file

app = typer.Typer()

PlantFile = Annotated[
    Path, typer.Argument(help="Your plant file (Python); it is run.", exists=True, dir_okay=False, show_default=False)
]


@app.command(epilog=examples("mpcoffline new two_tank.py"))
def new(
    file: Annotated[Path, typer.Argument(help="Where to write it, a name ending in .py.", show_default=False)],
) -> None:
    """Write a plant file to fill in: what is measured, what can be set, the equations, and what is to be achieved.

    It describes two tanks, with a comment at each line that you replace, and runs as it is. An existing file is never
    replaced.
    """
    if file.suffix != ".py":
        raise typer.BadParameter(f"expected a name ending in .py, got {file.name!r}.", param_hint="FILE")
    check_out("FILE", file)
    if file.exists():
        hint = "Choose another name, or move that file away."
        raise StorageError(str(file), expected="a name that is free", actual="a file", hint=hint)
    text = files("mpcoffline.plants").joinpath("new_plant.txt").read_text(encoding="utf-8")
    write_file(file, text.replace("FILE.py", file.name))
    say_file("Plant file", file)
    name = escape(str(file))
    say(f"Try it:    python {name}\nCheck it:  mpcoffline check {name} log.csv")
