"""The commands ``mpcoffline export`` and ``mpcoffline doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from mpcoffline.cli_common import Controller, Json, examples, loaded_policy, print_json, say, say_file

app = typer.Typer()

_MARKS = {"ok": "[green]ok[/]  ", "warn": "[yellow]warn[/]", "fail": "[bold red]fail[/]"}


@app.command(epilog=examples("mpcoffline export learner_policy.zip --out controller/"))
def export(
    policy: Controller,
    out: Annotated[Path, typer.Option(help="Folder for the C files.", file_okay=False)] = Path("controller"),
) -> None:
    """Write a policy as self-contained C99: no allocation, no dependency, a fixed budget of iterations.

    The folder receives the controller, a header with names and units of the parameters, a CMake file, and a test that
    compares it with this package's solutions.
    """
    from mpcoffline.export import export_c

    for path in export_c(loaded_policy(policy), out):
        say_file("C", path)


@app.command(epilog=examples("mpcoffline doctor", "mpcoffline doctor --json > doctor.json"))
def doctor(as_json: Json = False) -> None:
    """Check this installation: versions, C compiler, solvers, data sets, GPU, threads. Put it into bug reports.

    Exit code 1 if something that is needed is broken.
    """
    from mpcoffline.doctor import diagnosis

    found = diagnosis()
    if as_json:
        print_json(found)
    else:
        for check in found["checks"]:
            advice = f" -> {check['advice']}" if check["advice"] else ""
            say(f"{_MARKS[check['status']]}  {check['name']}: {escape(check['found'] + advice)}")
    raise typer.Exit(0 if found["ok"] else 1)
