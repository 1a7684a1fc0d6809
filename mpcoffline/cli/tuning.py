"""The commands that end with a controller of one's own: ``mpcoffline tune`` and ``mpcoffline retune``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from mpcoffline.core.errors import visible
from mpcoffline.core.progress import Stages

from .common import console, examples, message, print_json, say_prose, working
from .options import Json, Preset, Seed, checked_share
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

Trial = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG",
        help="Logs of the trial: CSV, Parquet or Arrow.",
        exists=True,
        dir_okay=False,
        show_default=False,
    ),
]


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
    keep_limits: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Tighten the limits inside the controller until simulated closed loops keep the given ones in this"
            " share of their steps, as 0.95: disturbances push a plan that just keeps a limit over it.",
            show_default="as far as that pays",
            callback=checked_share,
        ),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Tune a controller from a log of your plant: check, fit, verdict, report and C code, in one folder.

    The folder receives report.html, policy.zip, learner.zip, controller/ (C99), log.zip, run.json. Ctrl-C loses nothing
    that was finished: the same command goes on from there. A changed log, plant file or option starts anew; a result
    that was in the folder stays in a numbered one inside.

    Where the verdict is "keep MPC_1", policy.zip is MPC_1, the controller of the plant file as it is.
    """
    options, stages = read_options(column, unit, where, time, time_format, timezone, episode, max_gap), Stages(_tell)
    stages(f"Reading {', '.join(log.name for log in logs)}")
    with working("Reading"):
        from mpcoffline.plants import load_description
        from mpcoffline.tune import tune as tuned

        plant = load_description(file)
        table = plant.read(logs, **options)
    stages(f"{len(table):,} control intervals of {plant.dt:g} s, {table.n_episodes} without a gap")
    try:
        more: dict[str, Any] = {} if keep_limits is None else {"keep_limits": keep_limits}
        result = tuned(plant, table, out, preset=preset.value, polish=polish, seed=seed, tell=stages, **more)
    except KeyboardInterrupt:
        _tell("What was finished is kept: the same command goes on from there.")
        raise
    stages.end()
    _show(result, as_json)


@app.command(epilog=examples("mpcoffline retune tuned/ trial.csv", "mpcoffline retune tuned/ a.csv b.csv --json"))
def retune(
    folder: Annotated[
        Path, typer.Argument(metavar="TUNED", help="The folder that tune made.", exists=True, file_okay=False)
    ],
    trial: Trial,
    column: Columns = None,
    unit: Units = None,
    where: Where = None,
    time: Time = None,
    time_format: TimeFormat = None,
    timezone: Timezone = None,
    episode: Episode = None,
    max_gap: MaxGap = None,
    as_json: Json = False,
) -> None:
    """Learn from a trial, too, and say whether it cost what was predicted.

    Reads the log of a trial with the tuned controller: that of `mpcoffline serve`, or one with the header of the log
    that tune was given, which is read with the same options unless others are given here. Simulates the trial on the
    models of the log before it, and compares; then fits again with both logs. The folder is replaced as a whole; what
    it held is kept in a numbered one inside.
    """
    options, stages = read_options(column, unit, where, time, time_format, timezone, episode, max_gap), Stages(_tell)
    stages(f"Reading {', '.join(log.name for log in trial)}")
    from mpcoffline.tune import retune as retuned
    from mpcoffline.tune.retuning import trial_lines

    try:
        result = retuned(folder, trial, read=options, tell=stages)
    except KeyboardInterrupt:
        _tell("What was finished is kept: the same command goes on from there.")
        raise
    stages.end()
    if not as_json:
        far = result.calibration is not None and result.calibration.far
        head, *rest = trial_lines(result.tuned.document)
        say_prose(Text(visible(head), style="bold red" if far else "bold"))
        say_prose("\n".join(rest) + "\n")
    _show(result.tuned, as_json)


def _tell(text: str) -> None:
    message(Text(visible(text), style="dim" if text.startswith("Reading") else ""))


def _show(result: Tuned, as_json: bool) -> None:
    """Verdict, files and what to do next; the verdict stands out."""
    if as_json:
        print_json({"folder": result.folder, "again": result.again, "former": result.former} | dict(result.document))
        return
    colours = {"recommend": "bold green", "try with care": "bold yellow"}
    head, *rest = visible(str(result)).split("\n")
    console.print(Text(head, style=colours.get(result.verdict, "bold red")))
    console.print(Text("\n".join(rest)), soft_wrap=True)
