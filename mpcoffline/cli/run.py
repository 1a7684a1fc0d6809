"""The commands ``mpcoffline run``, ``mpcoffline reproduce`` and ``mpcoffline collect``."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.text import Text

from mpcoffline.core.errors import visible
from mpcoffline.core.tables import Table

from .common import console, examples, say, say_file, say_prose, working
from .options import Alpha, PlantAlpha, Preset, Seed, TaskArgument, Value, beginning, dataset_ids

app = typer.Typer()

_BLOCKS = 10


@app.command(
    epilog=examples(
        "mpcoffline run pendulum",
        "mpcoffline run cartpole --alpha 1.5 --seed 3 --out results/cartpole-15",
        "mpcoffline run pendulum --preset default",
    )
)
def run(
    task: TaskArgument,
    alpha: Alpha = 1.0,
    seed: Seed = 0,
    dataset: Annotated[
        str | None,
        typer.Option(help="Data set id.", show_default="the task's DDPG data", autocompletion=beginning(dataset_ids)),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Closed-loop episodes of each controller.", min=1)] = 24,
    value: Value = None,
    preset: Annotated[Preset, typer.Option(help="How MPC_2 and MPC_3 are learned; paper is the published recipe.")] = (
        Preset.paper
    ),
    out: Annotated[
        Path | None, typer.Option(help="Folder for table and figure.", show_default="results/TASK", file_okay=False)
    ] = None,
) -> None:
    """The main job: learn MPC_2 and MPC_3 from data and compare them with MPC_1.

    MPC_1 has a wrong model and a nominal cost. MPC_2 learns the cost, MPC_3 cost and model, from logged data alone. All
    three then control the task from the same starts. Writes a table (results.md, .csv, .json), a figure (figure.pdf,
    .png) and the controllers (controllers/*.zip).
    """
    with working("Loading"):
        from mpcoffline.studies import run_task

    options: dict[str, Any] = {} if preset is Preset.paper else {"preset": preset.value}
    if value is not None:
        options["value"] = value
    folder = out or Path("results") / task.value
    result = run_task(
        task.value,
        alpha=alpha,
        seed=seed,
        dataset=dataset,
        n_episodes=episodes,
        output=folder,
        **options,
    )
    console.print(result.table())
    for note in result.notes():
        say_prose(Text(f"  {visible(note)}", style="dim"))
    for what, name in (("Table", "results.md"), ("Figure", "figure.png"), ("Controllers", "controllers")):
        say_file(what, folder / name)


@app.command(
    epilog=examples("mpcoffline reproduce", "mpcoffline reproduce --alpha 1.5 --seed 3 --out results/paper-15")
)
def reproduce(
    alpha: Alpha = 1.0,
    seed: Seed = 0,
    episodes: Annotated[int, typer.Option(help="Closed-loop episodes of each controller.", min=1)] = 24,
    out: Annotated[Path, typer.Option(help="Folder for tables and figures.", file_okay=False)] = Path("results/paper"),
) -> None:
    """The paper's study: the main job for all three tasks, by the published recipe, on one page.

    Takes some minutes. What is done is kept: the same command again goes on where it was interrupted.
    """
    with working("Loading"):
        from mpcoffline.studies import reproduce as reproduce_study

    for result in reproduce_study(out, alpha=alpha, seed=seed, n_episodes=episodes):
        console.print(result.table())
        say_file("Figure", out / result.task / "figure.png")
    say_file("All of it", out / "results.md")


@app.command(
    epilog=examples(
        "mpcoffline collect linear --alpha 0.5",
        "mpcoffline collect pendulum --steps 20000 --seed 1 --dataset-id mine/pendulum-v0",
    )
)
def collect(
    task: TaskArgument,
    alpha: PlantAlpha = None,
    steps: Annotated[
        int | None, typer.Option(help="Transitions to record.", show_default="the task's, 50000", min=1)
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of agent and environment.", show_default="the task's, 0", min=0)
    ] = None,
    dataset_id: Annotated[
        str | None, typer.Option(help="Minari id of the new data set.", show_default="the task's, and what differs")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a data set of that id.")] = False,
) -> None:
    """Train a DDPG agent on a task from scratch and record every transition as a Minari data set.

    Takes some minutes on one CPU core.
    """
    with working("Loading"):
        from mpcoffline.gallery.collection import collect as collect_data, return_curve

    dataset = collect_data(
        task, alpha=alpha, steps=steps, seed=seed, dataset_id=dataset_id, overwrite=overwrite, progress=True
    )
    returns = return_curve(dataset)
    blocks = min(_BLOCKS, len(returns))
    edges = [round(i * len(returns) / blocks) for i in range(blocks + 1)]
    means = [float(returns[low:high].mean()) for low, high in itertools.pairwise(edges)]
    rows = []
    worst, best = min(means), max(means)
    for (low, high), mean in zip(itertools.pairwise(edges), means, strict=True):
        share = (mean - worst) / (best - worst) if best > worst else 1.0
        rows.append((f"{low + 1}-{high}", f"{mean:.1f}", "█" * (1 + round(29 * share))))
    console.print(Table(("episodes", "return", ""), rows, "Return curve (mean of the episodes)", "rrl"))
    name = str(dataset.spec.dataset_id)
    say(f"Recorded {dataset.total_steps} transitions as [bold]{escape(name)}[/].")
    say(f"Next: mpcoffline learn --dataset {escape(name)}")
