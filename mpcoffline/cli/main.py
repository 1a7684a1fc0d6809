"""The command line ``mpcoffline``. Every command imports what it needs when it runs, so that ``--help`` is quick."""

from __future__ import annotations

from typing import Annotated

import typer

from . import (
    datasets as cli_datasets,
    distilling as cli_distilling,
    evaluate as cli_evaluate,
    figures as cli_figures,
    learn as cli_learn,
    own_plants as cli_own_plants,
    run as cli_run,
    serving as cli_serving,
    tools as cli_tools,
    tuning as cli_tuning,
)
from .common import ErrorGroup, console, progress_to_stderr

app = typer.Typer(
    cls=ErrorGroup,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with:\n\nmpcoffline run pendulum\n\nWith a plant of your own, and a log of it:\n\n"
    "mpcoffline new plant.py\n\nmpcoffline check plant.py log.csv\n\nmpcoffline tune plant.py log.csv\n\n"
    "Something wrong? Run:\n\nmpcoffline doctor",
)


def _version(show: bool) -> None:
    if show:
        from mpcoffline import __version__

        console.print(f"mpcoffline {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Learn a Model Predictive Controller from logged data, without solving one MPC while learning.

    The method: Sawant, Anand, Reinhardt, Gros, arXiv:2301.01667.
    """
    progress_to_stderr()


for commands in (
    *(cli_run, cli_own_plants, cli_tuning, cli_serving, cli_learn, cli_evaluate, cli_figures),
    *(cli_distilling, cli_tools),
):
    app.add_typer(commands.app)
app.add_typer(cli_datasets.app, name="datasets")
