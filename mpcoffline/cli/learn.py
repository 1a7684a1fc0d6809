"""The command ``mpcoffline learn``: tasks, data sets, and plants of one's own."""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.outputs import check_output_folder, make_folder
from mpcoffline.core.tables import Table

from .common import check_out, console, examples, message, print_json, say, say_file, say_prose, without, working
from .options import (
    Alpha,
    Json,
    Preset,
    Seed,
    Task,
    Value,
    beginning,
    checked_share,
    dataset_ids,
    tasks_and_files,
)
from .own_plants import Columns, Episode, MaxGap, Time, TimeFormat, Timezone, Units, Where, read_options

if TYPE_CHECKING:
    from minari import MinariDataset

    from mpcoffline.datasets.table.transitions import TransitionTable
    from mpcoffline.learner.callbacks import Callback
    from mpcoffline.learner.learner import OfflineMPCLearner
    from mpcoffline.mpc import MPC

app = typer.Typer()

_LONG_PARAMETER = 8  # numbers; longer ones are weights of networks, which tell a reader nothing


class Learn(StrEnum):
    """What is learned."""

    cost = "cost"
    cost_and_model = "cost+model"


def _checked_task(given: str | None) -> str | None:
    """Refuses what is neither a task nor a file."""
    if given is None or given in list(Task):
        return given
    if not given.endswith(".py"):
        raise typer.BadParameter(f"{given!r} is not one of {', '.join(Task)}, nor a plant file (.py).")
    if not Path(given).is_file():
        raise typer.BadParameter(f"file {given!r} does not exist.")
    return given


@app.command(
    epilog=examples(
        "mpcoffline learn pendulum --out pendulum.zip",
        "mpcoffline learn --dataset mpcoffline/cartpole/ddpg-v0 --learn cost --preset paper --value expectile",
        "mpcoffline learn cartpole --preset best --discount 0.97 --checkpoint fit.ckpt --log-csv fit.csv",
        "mpcoffline learn two_tank.py log.csv --column h1=LI-101.PV --out two_tank.zip",
        "mpcoffline learn linear --json > learned.json",
    )
)
def learn(
    task: Annotated[
        str | None,
        typer.Argument(
            metavar="TASK|PLANT.py",
            help=f"Which task ({', '.join(Task)}), or your plant file, which is run; told by the data set if left out.",
            callback=_checked_task,
            autocompletion=beginning(tasks_and_files),
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG", help="Logs of the plant: CSV, Parquet or Arrow.", exists=True, dir_okay=False),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Data set id, in place of a log.",
            show_default="the task's DDPG data",
            autocompletion=beginning(dataset_ids),
        ),
    ] = None,
    preset: Annotated[
        Preset,
        typer.Option(
            help="paper: the published recipe; default: what most users should get; fast: the shortest horizon; "
            "best: the longest."
        ),
    ] = Preset.default,
    learn: Annotated[Learn, typer.Option(help="cost: MPC_2; cost+model: MPC_3.")] = Learn.cost_and_model,
    value: Value = None,
    discount: Annotated[
        float | None,
        typer.Option(help="Discount of a step, gamma, in (0, 1].", show_default="the preset's", callback=checked_share),
    ] = None,
    horizon: Annotated[
        int | None, typer.Option(help="Steps that the learned MPC looks ahead, N.", show_default="the preset's", min=1)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Gradient steps of (VALUE).", show_default="the preset's", min=1)
    ] = None,
    alpha: Alpha = 1.0,
    candidate: Annotated[
        str,
        typer.Option(
            help="auto: the best candidate on models of the data, which takes closed loops; full: the whole fit as it "
            "is; or another candidate by name."
        ),
    ] = "auto",
    polish: Annotated[
        bool,
        typer.Option(
            "--polish",
            help="Move the best candidate's weights, too, by what closed loops cost; needs mpcoffline[polish].",
        ),
    ] = False,
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="Where to save the learner.", dir_okay=False)] = Path("learner.zip"),
    checkpoint: Annotated[
        Path | None,
        typer.Option(help="Keep the fit's state here; a fit that was interrupted goes on from it.", dir_okay=False),
    ] = None,
    log_csv: Annotated[Path | None, typer.Option(help="Add each epoch's metrics to this CSV.", dir_okay=False)] = None,
    tensorboard: Annotated[
        Path | None, typer.Option(help="Write each epoch's metrics to this TensorBoard folder.", file_okay=False)
    ] = None,
    column: Columns = None,
    unit: Units = None,
    where: Where = None,
    log_time: Time = None,
    time_format: TimeFormat = None,
    timezone: Timezone = None,
    episode: Episode = None,
    max_gap: MaxGap = None,
    as_json: Json = False,
) -> None:
    """Learn the parameters of an MPC: of a task's from a data set, of your plant's from its log.

    For a plant of yours, `mpcoffline tune` does this, too, with a check of the log, a verdict, a page and C code.

    Saves the learner and, beside it, its policy (learner.zip, learner_policy.zip). No MPC is solved while learning; the
    choice among what was learned and MPC_1, which comes last, simulates them in closed loop.
    """
    policy_file = out.with_name(f"{out.stem}_policy{out.suffix}")
    for option, path in (("--out", out), ("--out", policy_file), ("--checkpoint", checkpoint), ("--log-csv", log_csv)):
        if path is not None:
            check_out(option, path)
    if tensorboard is not None:
        check_output_folder(tensorboard)
    own = task is not None and task.endswith(".py")
    if task is None and dataset is None:
        raise typer.BadParameter("give a TASK, a PLANT.py with its logs, or --dataset ID.")
    if bool(logs) != (own and dataset is None):
        raise typer.BadParameter("give a PLANT.py with its logs, or with --dataset ID; a TASK has no logs.")
    reading = read_options(column, unit, where, log_time, time_format, timezone, episode, max_gap)
    with working("Loading"):
        from mpcoffline.learner.candidates import outcome
        from mpcoffline.learner.learner import OfflineMPCLearner

        data, mpc = (
            _of_plant(Path(task), logs, dataset, reading) if task and own else _of_task(task, dataset, alpha, seed)
        )
    overrides: dict[str, Any] = {"discount": discount, "horizon": horizon}
    learner = OfflineMPCLearner(
        mpc,
        "cost" if learn is Learn.cost else "cost+model",
        preset.value,
        seed,
        value=value,
        candidate=candidate,
        polish=polish,
        **{name: number for name, number in overrides.items() if number is not None},
    )
    for path in (checkpoint, log_csv):
        if path is not None:
            make_folder(path.parent)
    begin = time.perf_counter()
    try:
        with without(outcome):
            learner.fit(data, n_steps=steps, callbacks=_loggers(log_csv, tensorboard), checkpoint=checkpoint)
    except KeyboardInterrupt:
        if checkpoint is not None and checkpoint.exists():
            message(f"The same command goes on from {checkpoint}.")
        raise
    seconds = time.perf_counter() - begin
    make_folder(out.parent)
    learner.save(out)
    learner.policy.save(policy_file)
    name, env_id = _called(data, task if own else None)
    if as_json:
        print_json({"learner": out, "policy": policy_file, "seconds": seconds, "dataset": name} | _described(learner))
        return
    say_prose(f"Learned from {name} in {seconds:.0f} s.")
    console.print(_parameter_table(learner))
    for finding in learner.findings:
        say_prose(finding)
    if learner.candidates is not None:
        say_prose(str(learner.candidates))
        if learner.candidates.effort is not None and polish:
            console.print(learner.candidates.effort.table)
    say_file("Learner", out)
    say_file("Policy", policy_file)
    say(f"Next: mpcoffline evaluate {escape(str(policy_file))} --env {escape(env_id)}")
    if logs:
        say(f"      mpcoffline plot {escape(str(out))} --env {escape(env_id)}")
    else:
        say(f"      mpcoffline diagnose {escape(str(out))} --dataset {escape(name)}")


def _loggers(log_csv: Path | None, tensorboard: Path | None) -> list[Callback]:
    from mpcoffline.learner.loggers import CSVLogger, TensorBoardLogger

    loggers: list[Callback] = []
    if log_csv is not None:
        loggers.append(CSVLogger(log_csv))
    if tensorboard is not None:
        loggers.append(TensorBoardLogger(tensorboard))
    return loggers


def _of_plant(
    file: Path, logs: list[Path] | None, dataset: str | None, reading: dict[str, Any]
) -> tuple[MinariDataset | TransitionTable, MPC]:
    """Logs, or a data set, and MPC_1 of a plant file."""
    from mpcoffline.datasets import load_dataset
    from mpcoffline.plants import load_plant
    from mpcoffline.plants.outputs import check_measured

    plant = load_plant(file)
    check_measured(plant, "learn")
    return plant.read(logs, **reading) if dataset is None else load_dataset(dataset), plant.mpc()


def _of_task(task: str | None, dataset: str | None, alpha: float, seed: int) -> tuple[MinariDataset, MPC]:
    """The data set and MPC_1 of a task; the task is that of the data set where none is given."""
    from mpcoffline.datasets import load_dataset
    from mpcoffline.plants.nominal import nominal_mpc
    from mpcoffline.studies.setups import setup_of

    if task is not None:
        setup = setup_of(task, alpha, seed)
        return load_dataset(dataset or setup.dataset_id), setup.nominal
    data = load_dataset(str(dataset))
    spec = data.spec.env_spec
    if spec is None:
        hint = f"{dataset} names no environment."
        raise InvalidArgumentError("learn", expected="a TASK or a PLANT.py", actual="none", hint=hint)
    # The linear task's alpha is that of its plant, which the data set knows.
    return data, nominal_mpc(spec.id) if "alpha" in spec.kwargs else nominal_mpc(spec.id, alpha=alpha, seed=seed)


def _called(data: MinariDataset | TransitionTable, file: str | None) -> tuple[str, str]:
    """What the data are called, and the environment that they are of."""
    from mpcoffline.datasets.table.transitions import TransitionTable

    if isinstance(data, TransitionTable):
        return data.name, file or "ENV_ID"
    env_spec = data.spec.env_spec
    return str(data.spec.dataset_id), file or (env_spec.id if env_spec is not None else "ENV_ID")


def _described(learner: OfflineMPCLearner) -> dict[str, Any]:
    """What a learner is, for machines."""
    from mpcoffline.learner.candidates import FULL

    fitted = learner.result
    return {
        "preset": learner.preset,
        "method": learner.method.name,
        "learn": learner.learn,
        "value_method": learner.method.options.get("value"),
        "seed": learner.seed,
        "discount": learner.mpc.discount,
        "horizon": learner.mpc.horizon,
        "loss_before": None if fitted is None else fitted.loss_before,
        "loss_after": None if fitted is None else fitted.loss_after,
        "findings": list(learner.findings),
        "candidate": FULL if learner.candidates is None else learner.candidates.chosen,
        "nominal": learner.nominal_mpc.values,
        "learned": learner.mpc.values,
        "history": [{"epoch": epoch} | metrics for epoch, metrics in learner.history],
    }


def _parameter_table(learner: OfflineMPCLearner) -> Table:
    """The parameters before and after learning: numbers, and the diagonals of matrices; weights of networks as one."""
    before, after = learner.nominal_mpc.values, learner.mpc.values
    units = {each.name: each.unit for mpc in (learner.nominal_mpc, learner.mpc) for each in mpc.space}
    rows, inner = [], 0
    for name in dict.fromkeys([*before, *after]):
        shown = [_shown(values.get(name)) for values in (before, after)]
        if None in shown:
            inner += max(np.size(values.get(name, [])) for values in (before, after))
        else:
            rows.append((name, *map(str, shown), units.get(name, "")))
    if inner:
        rows.append(("weights inside", "", f"{inner} numbers", ""))
    if learner.result is not None:
        rows.append(("regression error", f"{learner.result.loss_before:.4g}", f"{learner.result.loss_after:.4g}", ""))
    return Table(("parameter", "nominal", "learned", "unit"), rows, "Parameters (diagonals of matrices)")


def _shown(value: Any) -> str | None:
    """A parameter as text; empty where an MPC has none of that name, None where it is too long for a reader."""
    if value is None:
        return ""
    array = np.asarray(value)
    square = array.ndim == 2 and array.shape[0] == array.shape[1]
    numbers = np.diag(array) if square else np.atleast_1d(array).ravel()
    return None if numbers.size > _LONG_PARAMETER else " ".join(f"{number:.4g}" for number in numbers)
