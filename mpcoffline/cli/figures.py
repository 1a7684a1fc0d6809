"""The commands ``mpcoffline plot`` and ``mpcoffline diagnose``: what a fit looks like, and whether to trust it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.outputs import check_output_folder

from .common import (
    check_out,
    examples,
    loaded_learner,
    made_environment,
    print_json,
    say,
    say_file,
    working,
)
from .options import Json, LearnerFile, PlantAlpha, beginning, dataset_ids, environments

if TYPE_CHECKING:
    from gymnasium import Env

    from mpcoffline.control.policy import MPCPolicy
    from mpcoffline.learner.learner import OfflineMPCLearner

app = typer.Typer()

_BROAD_STARTS = 3
_FILM_SECONDS = 5.0
_FIGURES = ("training", "cost", "closed_loop", "phase_portrait")


@app.command(
    epilog=examples(
        "mpcoffline diagnose learner.zip --dataset mpcoffline/pendulum/ddpg-v0",
        "mpcoffline diagnose learner.zip --dataset mpcoffline/pendulum/ddpg-v0 --html report.html",
        "mpcoffline diagnose learner.zip --dataset mpcoffline/pendulum/ddpg-v0 --out report.png --json",
    )
)
def diagnose(
    learner: LearnerFile,
    dataset: Annotated[
        str,
        typer.Option(
            help="The data set that it was learned from.",
            show_default=False,
            autocompletion=beginning(dataset_ids),
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Draw the report here (PDF and PNG).", show_default="none", dir_okay=False)
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(help="Write the report here, as one page for a browser.", show_default="none", dir_okay=False),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated starts.", min=0)] = 0,
    as_json: Json = False,
) -> None:
    """May this fit be trusted? A verdict from the log alone, with its reasons.

    Simulates MPC_1 and the learned MPC on models identified from the log; takes from seconds to minutes.
    """
    from mpcoffline.plotting.style import figure_files

    for file in figure_files(out) if out is not None else ():
        check_out("--out", file)
    if html is not None:
        check_out("--html", html)
    fitted = loaded_learner(learner)
    with working("Loading"):
        from mpcoffline.datasets import load_dataset
        from mpcoffline.diagnostics import diagnose as examined

        data = load_dataset(dataset)
    with working("Simulating both controllers on models of the log"):
        report = examined(fitted, data, seed=seed)
    files = [] if out is None else report.figure(out)
    pages = [] if html is None else [report.html(html)]
    if as_json:
        print_json(json.loads(report.to_json()) | {"files": [*files, *pages]})
        return
    say(escape(str(report)))
    for kind, written in (("Figure", files), ("Page", pages)):
        for file in written:
            say_file(kind, file)


@app.command(
    epilog=examples(
        "mpcoffline plot learner.zip --out figures/",
        "mpcoffline plot learner.zip --out figures/ --animate figures/swing_up.gif",
        "mpcoffline plot learner.zip --env mpcoffline/LinearTracking-v0 --alpha 0.5",
        "mpcoffline plot tuned/learner.zip --env two_tank.py",
    )
)
def plot(
    learner: LearnerFile,
    out: Annotated[Path, typer.Option(help="Folder for the figures.", file_okay=False)] = Path("figures"),
    env: Annotated[
        str | None,
        typer.Option(
            metavar="ID|PLANT.py",
            help="Gymnasium id of the environment, or a plant file, which is run and simulated.",
            show_default="the task of the learner's size",
            autocompletion=beginning(environments),
        ),
    ] = None,
    alpha: PlantAlpha = None,
    seed: Annotated[int, typer.Option(help="Seed of the first start.", min=0)] = 0,
    film: Annotated[
        Path | None,
        typer.Option("--animate", help="Film of both controllers side by side (.gif or .mp4).", dir_okay=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Draw a learner: training curves, cost before and after, closed loops, phase portrait with V; a film if asked.

    Of a plant of yours: training curves, weights, closed loops with set-points, disturbances and limits.

    Every figure is written as PDF and PNG. MPC_1 is the nominal controller, MPC_2 or MPC_3 the learned one.
    """
    check_output_folder(out, tuple(f"{stem}.{suffix}" for stem in _FIGURES for suffix in ("pdf", "png")))
    if film is not None:
        from mpcoffline.plotting import check_film

        check_film(film)
    fitted = loaded_learner(learner)
    task = made_environment(env or _task_of(fitted), alpha, None)
    with working("Loading"):
        import mpcoffline
        from mpcoffline import MPCPolicy, plotting
        from mpcoffline.plants import PlantEnv

    own = isinstance(task.unwrapped, PlantEnv)
    if own and film is not None:
        raise InvalidArgumentError(
            "--animate", expected="none for a plant file, which has no picture", actual=str(film)
        )
    name = "MPC_2" if fitted.learn == "cost" else "MPC_3"
    policies = {"MPC_1": MPCPolicy(fitted.nominal_mpc), name: fitted.policy}
    starts = _starts(task)
    with working("Closed loops"):
        loops = {
            label: mpcoffline.evaluate(policy, task, len(starts), seed, options=starts)
            for label, policy in policies.items()
        }
    with working("Figures"):
        mpcs, names = (fitted.nominal_mpc, fitted.mpc), ("MPC_1", name)
        figures = {
            "training": plotting.training_figure(fitted),
            "cost": plotting.weights_figure(*mpcs, names) if own else plotting.cost_figure(*mpcs, task, names),
            "closed_loop": plotting.loop_figure(loops, task),
        }
        if fitted.value_function is not None and not own:
            figures["phase_portrait"] = plotting.phase_portrait(fitted.value_function.predict, loops, task)
        files = [file for stem, figure in figures.items() for file in plotting.save_figure(figure, out / stem)]
    if film is not None:
        files.append(_filmed(policies, task, loops["MPC_1"].states[0][0], film))
    if as_json:
        print_json({"files": files})
        return
    for file in files:
        say_file("Film" if file == film else "Figure", file)


def _task_of(learner: OfflineMPCLearner) -> str:
    """The first task with as many states and inputs as the learner; of this package's no two have the same."""
    from mpcoffline.envs import PLANTS

    nominal = learner.nominal_mpc
    for plant in PLANTS.values():
        if (len(plant.observations), len(plant.inputs)) == (nominal.ny, nominal.nu):
            return plant.id
    raise InvalidArgumentError(
        "learner",
        expected=f"one of a task that can be drawn ({', '.join(plant.id for plant in PLANTS.values())})",
        actual=f"{nominal.ny} states and {nominal.nu} inputs",
        hint="For a plant of yours, name its file: --env PLANT.py.",
    )


def _starts(task: Env[Any, Any]) -> list[dict[str, str]]:
    """The start of each episode: the hardest first, where the task knows one."""
    from mpcoffline.envs import ControlTask

    if not isinstance(task.unwrapped, ControlTask):
        return [{}]
    known = task.unwrapped.starts
    hardest = [{"start": "hanging"}] if "hanging" in known else []
    return hardest + [{"start": "broad"}] * (_BROAD_STARTS + 1 - len(hardest))


def _filmed(policies: dict[str, MPCPolicy], task: Env[Any, Any], start: Any, film: Path) -> Path:
    from mpcoffline.plotting import animate

    with working("Film"):
        return animate(policies, task, start, film, seconds=_FILM_SECONDS)
