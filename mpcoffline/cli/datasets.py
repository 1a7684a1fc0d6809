"""The commands ``mpcoffline datasets ...``: thin wrappers of :mod:`mpcoffline.datasets`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from mpcoffline.core.tables import Table

from .common import check_figure, check_out, console, examples, print_json, say_prose, working
from .options import Json, beginning, dataset_ids

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="The data sets on this machine.")

FOUND_WRONG = 1

Id = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help="Data set id, e.g. mpcoffline/pendulum/ddpg-v0.",
        show_default=False,
        autocompletion=beginning(dataset_ids),
    ),
]
Remote = Annotated[
    str | None,
    typer.Option(help="hf://ORGANISATION or gcp://BUCKET.", show_default="the catalogue's, or MINARI_REMOTE"),
]


@app.command("list", epilog=examples("mpcoffline datasets list", "mpcoffline datasets list --json"))
def list_(as_json: Json = False) -> None:
    """The data sets that can be learned from: shipped with the package, or in the local Minari store."""
    with working("Loading"):
        from mpcoffline.datasets import list_datasets

    rows = list_datasets()
    if as_json:
        print_json([asdict(row) for row in rows])
        return
    cells = [(row.id, row.where, str(row.episodes), str(row.steps)) for row in rows]
    console.print(Table(("id", "where", "episodes", "transitions"), cells, align="llr"))


@app.command(
    epilog=examples(
        "mpcoffline datasets show mpcoffline/pendulum/ddpg-v0 --figure coverage.png",
        "mpcoffline datasets show mpcoffline/linear/ddpg-v0 --json",
    )
)
def show(
    dataset_id: Id,
    figure: Annotated[Path | None, typer.Option(help="File for a plot of what the data cover.", dir_okay=False)] = None,
    as_json: Json = False,
) -> None:
    """The card and the statistics of a data set."""
    with working("Loading"):
        from mpcoffline.datasets import show as summarise

    if figure is not None:
        check_figure("--figure", figure)
        check_out("--figure", figure, make=True)
    summary = summarise(dataset_id, figure)
    if as_json:
        print_json(asdict(summary))
    else:
        console.print(summary)


@app.command(
    epilog=examples(
        "mpcoffline datasets verify mpcoffline/pendulum/ddpg-v0",
        "mpcoffline datasets verify mine/plant/log-v0 --accept",
    )
)
def verify(
    dataset_id: Id,
    accept: Annotated[
        bool,
        typer.Option(
            "--accept",
            help="Take files that were changed on purpose for good, where nothing else is wrong: new hashes.",
        ),
    ] = False,
) -> None:
    """Check a data set: structure, hashes, NaN, bounds, alignment, reward = -cost.

    Exit code 1 if something is wrong.
    """
    with working("Loading"):
        from mpcoffline.datasets import verify as check

    report = check(dataset_id, accept=accept)
    console.print(report)
    raise typer.Exit(0 if report.ok else FOUND_WRONG)


@app.command(epilog=examples("mpcoffline datasets replay mpcoffline/pendulum/ddpg-v0 --episodes 10"))
def replay(
    dataset_id: Id,
    episodes: Annotated[int | None, typer.Option(help="How many, spread evenly.", show_default="all", min=1)] = None,
    allow_import: Annotated[
        bool, typer.Option("--allow-import", help="Import the environment from where the data set says.")
    ] = False,
) -> None:
    """Simulate the episodes again from their first states, and report the largest deviation.

    Exit code 1 if it is more than rounding.
    """
    with working("Loading"):
        from mpcoffline.datasets import replay as simulate

    report = simulate(dataset_id, episodes, allow_import=allow_import, progress=True)
    console.print(report)
    raise typer.Exit(0 if report.ok else FOUND_WRONG)


@app.command(epilog=examples("mpcoffline datasets repair mine/pendulum/first-v0"))
def repair(
    dataset_id: Id,
    salvage: Annotated[
        bool, typer.Option("--salvage", help="Take what is intact of a recording's damaged log, and keep the log.")
    ] = False,
) -> None:
    """Finish or rebuild what a killed recording left; what is found is kept as a backup."""
    with working("Loading"):
        from mpcoffline.datasets import repair as mend

    say_prose(str(mend(dataset_id, salvage=salvage)))


@app.command(epilog=examples("mpcoffline datasets download mine/plant/log-v0 --remote hf://my-organisation"))
def download(
    dataset_id: Id,
    remote: Remote = None,
    revision: Annotated[
        str | None, typer.Option(help="Commit, tag or branch.", show_default="the catalogue's, or the newest")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the local data set of that id.")] = False,
    unchecked: Annotated[
        bool, typer.Option("--unchecked", help="Accept a data set that comes without a manifest of hashes.")
    ] = False,
) -> None:
    """Bring a data set from a Minari remote into the local store; goes on where an earlier attempt broke off."""
    with working("Loading"):
        from mpcoffline.datasets import download_dataset

    dataset = download_dataset(
        dataset_id, remote=remote, revision=revision, overwrite=overwrite, unchecked=unchecked, progress=True
    )
    console.print(f"{escape(dataset_id)}: {dataset.total_episodes} episodes, {dataset.total_steps} steps.")


@app.command(epilog=examples("mpcoffline datasets upload mine/pendulum/first-v0 --remote hf://my-organisation"))
def upload(dataset_id: Id, remote: Remote = None) -> None:
    """Put a data set on a Minari remote, with the hashes that a download is checked against."""
    with working("Loading"):
        from mpcoffline.datasets import upload_dataset

    say_prose(str(upload_dataset(dataset_id, remote=remote)))
