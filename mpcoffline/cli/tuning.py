"""The commands that end with a controller of one's own: ``mpcoffline tune``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from mpcoffline.core.errors import visible

from .common import Json, Preset, Seed, console, examples, messages, print_json
from .own_plants import (
    Columns,
    Episode,
    Logs,
    MaxGap,
    PlantFile,
    Time,
    TimeFormat,
    Timezone,
    Units,
    Where,
    read_options,
)

if TYPE_CHECKING:
    from mpcoffline.tune import Tuned

app = typer.Typer()


@app.command(
    epilog=examples(
        "mpcoffline tune two_tank.py log.csv --out tuned/",
        "mpcoffline tune two_tank.py log.csv --column h1=LI-101.PV --where mode=AUTO --preset best",
    )
)
def tune(
    file: PlantFile,
    logs: Logs,
    out: Annotated[Path, typer.Option(help="Folder for all that is made.", file_okay=False)] = Path("tuned"),
    column: Columns = None,
    unit: Units = None,
    where: Where = None,
    time: Time = None,
    time_format: TimeFormat = None,
    timezone: Timezone = None,
    episode: Episode = None,
    max_gap: MaxGap = None,
    preset: Annotated[
        Preset,
        typer.Option(
            help="default: what most users should get; fast: the shortest horizon; best: the longest; paper: the "
            "published recipe."
        ),
    ] = Preset.default,
    polish: Annotated[
        bool,
        typer.Option(
            "--polish",
            help="Move the best candidate's weights, too, by what closed loops cost; needs mpcoffline[polish].",
        ),
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Tune a controller from a log of your plant: check, fit, verdict, report and C code, in one folder.

    The folder receives report.html, policy.zip, learner.zip, controller/ (C99), log.zip, run.json. Ctrl-C loses nothing
    that was finished: the same command goes on from there. A changed log, plant file or option starts anew; a result
    that was in the folder stays in a numbered one inside.

    Where the verdict is "keep MPC_1", policy.zip is MPC_1, the controller of the plant file as it is.
    """
    options = read_options(column, unit, where, time, time_format, timezone, episode, max_gap)
    _tell(f"Reading {', '.join(log.name for log in logs)}")
    from mpcoffline.plants import load_plant
    from mpcoffline.tune import tune as tuned

    plant = load_plant(file)
    table = plant.read(logs, **options)
    _tell(f"{len(table):,} control intervals of {plant.dt:g} s, {table.n_episodes} without a gap")
    try:
        result = tuned(plant, table, out, preset=preset.value, polish=polish, seed=seed, tell=_tell)
    except KeyboardInterrupt:
        _tell("What was finished is kept: the same command goes on from there.")
        raise
    _show(result, as_json)


def _tell(text: str) -> None:
    messages.print(Text(visible(text), style="dim" if text.startswith("Reading") else ""))


def _show(result: Tuned, as_json: bool) -> None:
    """Verdict, files and what to do next; the verdict stands out."""
    if as_json:
        print_json({"folder": result.folder, "again": result.again, "former": result.former} | dict(result.document))
        return
    colours = {"recommend": "bold green", "try with care": "bold yellow"}
    head, *rest = visible(str(result)).split("\n")
    console.print(Text(head, style=colours.get(result.verdict, "bold red")))
    console.print(Text("\n".join(rest)), soft_wrap=True)
