"""The commands ``mpcoffline learn`` and ``mpcoffline evaluate``."""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.outputs import check_output_folder
from mpcoffline.core.tables import Table

from .common import (
    Alpha,
    Controller,
    Json,
    PlantAlpha,
    Preset,
    Seed,
    Start,
    Task,
    Value,
    check_out,
    console,
    examples,
    loaded_policy,
    made_environment,
    messages,
    print_json,
    say,
    say_file,
)

if TYPE_CHECKING:
    from minari import MinariDataset

    from mpcoffline.control.evaluation import Evaluation
    from mpcoffline.learner.learner import Callback, OfflineMPCLearner
    from mpcoffline.mpc import MPC

app = typer.Typer()

_LONG_PARAMETER = 8  # numbers; longer ones are weights of networks, which tell a reader nothing


class Learn(StrEnum):
    """What is learned."""

    cost = "cost"
    cost_and_model = "cost+model"


@app.command(
    epilog=examples(
        "mpcoffline learn pendulum --out pendulum.zip",
        "mpcoffline learn --dataset mpcoffline/cartpole/ddpg-v0 --learn cost --preset paper --value expectile",
        "mpcoffline learn cartpole --preset best --discount 0.97 --checkpoint fit.ckpt --log-csv fit.csv",
        "mpcoffline learn linear --json > learned.json",
    )
)
def learn(
    task: Annotated[Task | None, typer.Argument(help="Which task; told by the data set if left out.")] = None,
    dataset: Annotated[str | None, typer.Option(help="Data set id.", show_default="the task's DDPG data")] = None,
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
        float | None, typer.Option(help="gamma, in (0, 1).", show_default="the preset's", min=0.0, max=1.0)
    ] = None,
    horizon: Annotated[
        int | None, typer.Option(help="N of the learned MPC.", show_default="the preset's", min=1)
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
    as_json: Json = False,
) -> None:
    """Learn the parameters of a task's MPC from a data set.

    Saves the learner and, beside it, its policy (learner.zip, learner_policy.zip). No MPC is solved while learning; the
    choice among what was learned and MPC_1, which comes last, simulates them in closed loop.
    """
    from mpcoffline.learner.learner import OfflineMPCLearner

    policy_file = out.with_name(f"{out.stem}_policy{out.suffix}")
    for option, path in (("--out", out), ("--out", policy_file), ("--checkpoint", checkpoint), ("--log-csv", log_csv)):
        if path is not None:
            check_out(option, path)
    if tensorboard is not None:
        check_output_folder(tensorboard)
    data, mpc = _data_and_mpc(task, dataset, alpha, seed)
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
    begin = time.perf_counter()
    try:
        learner.fit(data, n_steps=steps, callbacks=_loggers(log_csv, tensorboard), checkpoint=checkpoint)
    except KeyboardInterrupt:
        if checkpoint is not None and checkpoint.exists():
            messages.print(f"The same command goes on from {escape(str(checkpoint))}.")
        raise
    seconds = time.perf_counter() - begin
    learner.save(out)
    learner.policy.save(policy_file)
    if as_json:
        print_json({"learner": out, "policy": policy_file, "seconds": seconds} | _described(learner, data))
        return
    console.print(_parameter_table(learner))
    for finding in learner.findings:
        say(escape(finding))
    if learner.candidates is not None:
        say(escape(str(learner.candidates)))
        if learner.candidates.effort is not None and polish:
            console.print(learner.candidates.effort.table)
    say_file("Learner", out)
    say_file("Policy", policy_file)
    env_id = data.spec.env_spec.id if data.spec.env_spec is not None else "ENV_ID"
    say(f"Next: mpcoffline evaluate {escape(str(policy_file))} --env {escape(env_id)}")
    say(f"      mpcoffline diagnose {escape(str(out))} --dataset {escape(str(data.spec.dataset_id))}")


@app.command(
    epilog=examples(
        "mpcoffline evaluate learner_policy.zip --env mpcoffline/PendulumSwingUp-v0",
        "mpcoffline evaluate learner.zip --env mpcoffline/CartPoleSwingUp-v0 --episodes 10 --start hanging",
        "mpcoffline evaluate learner.zip --env mpcoffline/LinearTracking-v0 --json",
    )
)
def evaluate(
    policy: Controller,
    env: Annotated[str, typer.Option(help="Gymnasium id of the environment.", show_default=False)],
    episodes: Annotated[int, typer.Option(help="Number of episodes.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the first start; episode i has seed + i.", min=0)] = 0,
    start: Annotated[Start | None, typer.Option(help="Kind of start.", show_default="the environment's")] = None,
    alpha: PlantAlpha = None,
    as_json: Json = False,
) -> None:
    """Run a policy in closed loop and report its cost."""
    import mpcoffline

    controller = loaded_policy(policy)
    target = made_environment(env, alpha, start)
    options = None if start is None else {"start": start.value}
    with messages.status("Closed loops"):
        result = mpcoffline.evaluate(
            controller, target, episodes, seed, discount=controller.mpc.discount, options=options
        )
    stats = controller.solver_stats
    if as_json:
        print_json(
            {"policy": policy, "env": env, "episodes": episodes, "seed": seed, "start": start, "alpha": alpha}
            | _figures(result)
            | {"n_solves": stats.n_solves, "n_failures": stats.n_failures, "solve_time": stats.time / stats.n_solves}
            | {"failures": stats.answers}
        )
        return
    costs = ("cost J", result.cost), (f"discounted cost ({result.discount:g})", result.discounted_cost)
    rows = [
        *((label, f"{c.mean():.2f}", f"{c.min():.2f}", f"{c.max():.2f}") for label, c in costs),
        ("success", f"{result.success.mean():.0%}"),
        ("time of a solve (ms)", f"{1e3 * stats.time / stats.n_solves:.2f}"),
        ("failed solves", stats.failures),
    ]
    title = f"{policy.name} in {env}, {episodes} episodes"
    console.print(Table(("", "mean", "best", "worst"), rows, title, "lr"))


def _loggers(log_csv: Path | None, tensorboard: Path | None) -> list[Callback]:
    from mpcoffline.learner.loggers import CSVLogger, TensorBoardLogger

    loggers: list[Callback] = []
    if log_csv is not None:
        loggers.append(CSVLogger(log_csv))
    if tensorboard is not None:
        loggers.append(TensorBoardLogger(tensorboard))
    return loggers


def _data_and_mpc(task: Task | None, dataset: str | None, alpha: float, seed: int) -> tuple[MinariDataset, MPC]:
    """The data set and MPC_1 of a task; the task is that of the data set where none is given."""
    from mpcoffline.datasets import load_dataset
    from mpcoffline.plants.nominal import nominal_mpc
    from mpcoffline.studies.setups import setup_of

    if task is not None:
        setup = setup_of(task, alpha, seed)
        return load_dataset(dataset or setup.dataset_id), setup.nominal
    if dataset is None:
        raise InvalidArgumentError("learn", expected="a TASK or --dataset ID", actual="neither")
    data = load_dataset(dataset)
    spec = data.spec.env_spec
    if spec is None:
        raise InvalidArgumentError("learn", expected="a TASK", actual="none", hint=f"{dataset} names no environment.")
    # The linear task's alpha is that of its plant, which the data set knows.
    return data, nominal_mpc(spec.id) if "alpha" in spec.kwargs else nominal_mpc(spec.id, alpha=alpha, seed=seed)


def _described(learner: OfflineMPCLearner, data: MinariDataset) -> dict[str, Any]:
    """What a learner is, for machines."""
    from mpcoffline.learner.candidates import FULL

    fitted = learner.result
    return {
        "dataset": str(data.spec.dataset_id),
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


def _figures(result: Evaluation) -> dict[str, Any]:
    """Costs for machines: means, and one number an episode."""
    return {
        "cost": result.cost.mean(),
        "discounted_cost": result.discounted_cost.mean(),
        "discount": result.discount,
        "success": result.success.mean(),
        "costs": result.cost,
        "discounted_costs": result.discounted_cost,
        "successes": result.success,
    }


def _parameter_table(learner: OfflineMPCLearner) -> Table:
    """The parameters before and after learning: numbers, and the diagonals of matrices."""
    before, after = learner.nominal_mpc.values, learner.mpc.values
    rows = [(name, _shown(before.get(name)), _shown(after.get(name))) for name in dict.fromkeys([*before, *after])]
    if learner.result is not None:
        rows.append(("regression error", f"{learner.result.loss_before:.4g}", f"{learner.result.loss_after:.4g}"))
    return Table(("parameter", "nominal", "learned"), rows, "Parameters (diagonals of matrices)")


def _shown(value: Any) -> str:
    """A parameter as text; empty where an MPC has none of that name."""
    import numpy as np

    if value is None:
        return ""
    array = np.asarray(value)
    square = array.ndim == 2 and array.shape[0] == array.shape[1]
    numbers = np.diag(array) if square else np.atleast_1d(array).ravel()
    if numbers.size > _LONG_PARAMETER:
        return f"{array.size} numbers"
    return " ".join(f"{number:.4g}" for number in numbers)
