"""The commands for plants of one's own: ``mpcoffline new`` and ``mpcoffline check``."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from mpcoffline.core.errors import StorageError, visible
from mpcoffline.core.outputs import write_file

from .common import check_out, console, examples, print_json, say, say_file, say_prose, working
from .options import Json, Seed

if TYPE_CHECKING:
    from mpcoffline.datasets.logs.reading import LoggedTable
    from mpcoffline.plants import BlackBoxPlant, Plant
    from mpcoffline.tune import LogCheck

app = typer.Typer()

PlantFile = Annotated[
    Path,
    typer.Argument(
        metavar="PLANT.py",
        help="Your plant file (Python); it is run.",
        exists=True,
        dir_okay=False,
        show_default=False,
    ),
]
Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG",
        help="Logs of the plant: CSV, Parquet or Arrow.",
        exists=True,
        dir_okay=False,
        show_default=False,
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        metavar="NAME=HEADER",
        help="Which column a quantity of the plant is, where the header is not its name: h1=LI-101, the header or its"
        " first words; repeatable. In a plant file: columns={...}.",
    ),
]
Units = Annotated[
    list[str] | None,
    typer.Option(
        "--unit",
        metavar="NAME=UNIT",
        help="The log's unit of a quantity, where its header says none or a wrong one; repeatable.",
    ),
]
Where = Annotated[
    list[str] | None,
    typer.Option(
        "--where",
        metavar="HEADER=VALUE",
        help="Read only rows that have this value, as mode=AUTO; given again for the same header, rows with any of its"
        " values.",
    ),
]
Time = Annotated[
    list[str] | None,
    typer.Option(
        "--time",
        metavar="HEADER",
        help="Header of the time column; twice, where date and time have a column each.",
        show_default="looked for",
    ),
]
TimeFormat = Annotated[
    str | None,
    typer.Option(metavar="FORM", help="How time stamps are written, as '%d.%m.%Y %H:%M'.", show_default="found out"),
]
Timezone = Annotated[
    str | None,
    typer.Option(
        metavar="ZONE", help="Time zone of stamps that do not say theirs, as Europe/Berlin.", show_default="none"
    ),
]
Episode = Annotated[
    str | None,
    typer.Option(
        metavar="HEADER",
        help="Header of a column whose changes begin new episodes, as a batch number.",
        show_default="gaps alone",
    ),
]
MaxGap = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="A longer pause between two rows begins a new episode.",
        min=0.0,
        show_default="1.5 control intervals",
    ),
]


@app.command(epilog=examples("mpcoffline new two_tank.py"))
def new(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.py", help="Where to write it, a name ending in .py.", show_default=False)
    ],
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


@app.command(
    epilog=examples(
        "mpcoffline check two_tank.py log.csv",
        "mpcoffline check two_tank.py a.csv b.csv --column h1=LI-101.PV --unit h1=mm --where mode=AUTO",
        "mpcoffline check two_tank.py log.csv --timezone Europe/Berlin --json > check.json",
    )
)
def check(
    file: PlantFile,
    logs: Logs,
    column: Columns = None,
    unit: Units = None,
    where: Where = None,
    time: Time = None,
    time_format: TimeFormat = None,
    timezone: Timezone = None,
    episode: Episode = None,
    max_gap: MaxGap = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Say what a log and a plant file say of each other, before anything is fitted.

    Reads the log (units, time stamps, gaps, broken sensors), then compares: units, signs, exchanged columns, dead time,
    inputs that act or move slowly, noise, sampling, which parameters the log determines and which experiment would
    determine the others, how far off predictions are, whether the goal was ever visited. The first line says whether
    tuning is worth it. Nothing is written.

    Exits with 1 where something is to be mended first.
    """
    options = read_options(column, unit, where, time, time_format, timezone, episode, max_gap)
    with working("Reading log and description"):
        from mpcoffline.plants import load_description
        from mpcoffline.tune import check_log

        plant = load_description(file)
        table = plant.read(logs, **options)
    with working("Comparing them") as status:
        found = check_log(plant, table, seed=seed, tell=lambda what: status.update(f"Comparing them: {what}"))
    if as_json:
        print_json(_document(plant, table, found))
    else:
        _show(found)
    if found.problems:
        raise typer.Exit(1)


def read_options(
    column: list[str] | None,
    unit: list[str] | None,
    where: list[str] | None,
    time: list[str] | None,
    time_format: str | None,
    timezone: str | None,
    episode: str | None,
    max_gap: float | None,
) -> dict[str, Any]:
    """The options of :meth:`mpcoffline.Plant.read` from those of a command."""
    return {
        "columns": pairs("--column", column),
        "units": pairs("--unit", unit),
        "where": _values(where),
        "time": None if not time else time if len(time) > 1 else time[0],
        "time_format": time_format,
        "timezone": timezone,
        "episode": episode,
        "max_gap": max_gap,
    }


def pairs(option: str, given: list[str] | None) -> dict[str, str]:
    """NAME=VALUE, several of them, each name once."""
    found: dict[str, str] = {}
    for name, value in _split(option, given):
        if name in found:
            raise typer.BadParameter(f"{name!r} is given twice, {found[name]!r} and {value!r}.", param_hint=option)
        found[name] = value
    return found


def _values(given: list[str] | None) -> dict[str, str | list[str]]:
    """HEADER=VALUE, several of them; of a header that comes again, rows with any of its values count."""
    found: dict[str, list[str]] = {}
    for name, value in _split("--where", given):
        found.setdefault(name, []).append(value)
    return {name: values[0] if len(values) == 1 else values for name, values in found.items()}


def _split(option: str, given: list[str] | None) -> Iterator[tuple[str, str]]:
    for each in given or []:
        name, sign, value = each.partition("=")
        if not (name.strip() and sign):
            raise typer.BadParameter(f"expected NAME=VALUE, got {each!r}.", param_hint=option)
        yield name.strip(), value.strip()


def _show(found: LogCheck) -> None:
    """The page, in colours where the terminal has some."""
    from rich.text import Text

    style = "bold red" if found.problems else "bold green"
    say_prose(Text(visible(found.verdict), style=style))
    say_prose(f"\n{found.head}\n")
    for kind, title in (("problem", "To be mended first"), ("advice", "Advice"), ("good", "Good")):
        chosen = [each for each in found.remarks if each.kind == kind and each.about != "gain"]
        if chosen:
            console.print(Text(title, style="bold"))
            for each in chosen:
                say_prose(Text.assemble("* ", (f"{visible(each.about)}: ", "bold"), visible(each.text)))
            console.print()
    for table in found.tables:
        console.print(table)
        console.print()


def _document(plant: Plant | BlackBoxPlant, table: LoggedTable, found: LogCheck) -> dict[str, Any]:
    report = table.report
    return {
        "plant": plant.name,
        "verdict": found.verdict,
        "worth_tuning": not found.problems,
        "remarks": [{"kind": each.kind, "about": each.about, "text": each.text} for each in found.remarks],
        "log": {
            "rows": report.rows,
            "steps": report.steps,
            "episodes": report.episodes,
            "seconds": report.seconds,
            "notes": report.notes,
            "left_out": [vars(each) for each in report.left_out],
        },
        "tables": {
            each.title: [dict(zip(each.header, row, strict=True)) for row in each.rows] for each in found.tables
        },
    }
