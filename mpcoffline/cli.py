"""The command line ``mpcoffline``. Every command imports what it needs when it runs, so that ``--help`` is quick."""

from __future__ import annotations

import difflib
import itertools
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer.core import TyperGroup

from mpcoffline import cli_datasets
from mpcoffline.errors import InvalidArgumentError, MPCOfflineError, UnknownIdError

if TYPE_CHECKING:
    from gymnasium import Env
    from minari import MinariDataset

    from mpcoffline.learner import OfflineMPCLearner
    from mpcoffline.mpc import MPC
    from mpcoffline.policy import MPCPolicy

USER_ERROR = 2
_BLOCKS = 10

console = Console()


class Task(StrEnum):
    """The tasks with a nominal controller."""

    linear = "linear"
    pendulum = "pendulum"
    cartpole = "cartpole"


class Learn(StrEnum):
    """What is learned."""

    cost = "cost"
    cost_and_model = "cost+model"


class ValueForm(StrEnum):
    """The forms of (VALUE)."""

    residual = "residual"
    td = "td"
    expectile = "expectile"


class Start(StrEnum):
    """The kinds of start."""

    broad = "broad"
    hanging = "hanging"


class _Group(TyperGroup):
    """Shows the errors that a user can do something about as one line, without traceback."""

    def invoke(self, ctx: Any) -> Any:
        import gymnasium as gym

        try:
            return super().invoke(ctx)
        except (MPCOfflineError, gym.error.Error, OSError) as error:
            Console(stderr=True, soft_wrap=True).print(f"[bold red]Error:[/] {escape(str(error))}", highlight=False)
            raise typer.Exit(USER_ERROR) from error


app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with:\n\nmpcoffline run pendulum",
)
app.add_typer(cli_datasets.app, name="datasets")

TaskArgument = Annotated[Task, typer.Argument(help="Which task.", show_default=False)]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
Value = Annotated[ValueForm, typer.Option(help="Form of the value regression; residual is the published one.")]
Alpha = Annotated[
    float,
    typer.Option(help="Size of the model error: of the plant (linear) or of the MPC's model (swing-ups).", min=0.0),
]


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


@app.command(
    epilog="Examples:\n\n"
    "mpcoffline run pendulum\n\n"
    "mpcoffline run cartpole --alpha 1.5 --seed 3 --output results/cartpole-15"
)
def run(
    task: TaskArgument,
    alpha: Alpha = 1.0,
    seed: Seed = 0,
    dataset: Annotated[str | None, typer.Option(help="Data set id.", show_default="the task's DDPG data")] = None,
    episodes: Annotated[int, typer.Option(help="Closed-loop episodes of each controller.", min=1)] = 24,
    value: Value = ValueForm.residual,
    output: Annotated[
        Path | None, typer.Option(help="Folder for table and figure.", show_default="results/TASK", file_okay=False)
    ] = None,
) -> None:
    """The main job: learn MPC_2 and MPC_3 from data and compare them with MPC_1.

    MPC_1 has a wrong model and a nominal cost. MPC_2 learns the cost, MPC_3 cost and model, from logged data alone. All
    three then control the task from the same starts. Writes a table (results.md, .csv, .json), a figure (figure.pdf,
    .png) and the controllers (controllers/*.zip).
    """
    from mpcoffline.study import run_task

    folder = output or Path("results") / task.value
    result = run_task(
        task.value,
        alpha=alpha,
        seed=seed,
        dataset=dataset,
        n_episodes=episodes,
        output=folder,
        value=value.value,
    )
    console.print(result.table())
    for note in result.notes():
        console.print(f"  {escape(note)}", highlight=False, style="dim")
    for what, name in (("Table", "results.md"), ("Figure", "figure.png"), ("Controllers", "controllers")):
        _say_file(what, folder / name)


@app.command(
    epilog="Examples:\n\n"
    "mpcoffline collect linear --alpha 0.5\n\n"
    "mpcoffline collect pendulum --steps 20000 --seed 1 --dataset-id mine/pendulum-v0"
)
def collect(
    task: TaskArgument,
    alpha: Annotated[
        float | None, typer.Option(help="Plant of the linear task.", show_default="1.0", min=0.0, max=4.0)
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Transitions.", show_default="50000", min=1)] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of agent and environment.", show_default="0", min=0)] = None,
    dataset_id: Annotated[
        str | None, typer.Option(help="Minari id of the new data set.", show_default="says what differs")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a data set of that id.")] = False,
) -> None:
    """Train a DDPG agent on a task from scratch and record every transition as a Minari data set.

    Takes some minutes on one CPU core.
    """
    from mpcoffline.datasets.collection import collect as collect_data
    from mpcoffline.datasets.collection import return_curve

    dataset = collect_data(
        task, alpha=alpha, steps=steps, seed=seed, dataset_id=dataset_id, overwrite=overwrite, progress=True
    )
    returns = return_curve(dataset)
    blocks = min(_BLOCKS, len(returns))
    edges = [round(i * len(returns) / blocks) for i in range(blocks + 1)]
    means = [float(returns[low:high].mean()) for low, high in itertools.pairwise(edges)]
    table = Table(title="Return curve (mean of the episodes)", title_justify="left", box=None, pad_edge=False)
    table.add_column("episodes", justify="right")
    table.add_column("return", justify="right")
    table.add_column("")
    worst, best = min(means), max(means)
    for (low, high), mean in zip(itertools.pairwise(edges), means, strict=True):
        share = (mean - worst) / (best - worst) if best > worst else 1.0
        table.add_row(f"{low + 1}-{high}", f"{mean:.1f}", "█" * (1 + round(29 * share)))
    console.print(table)
    name = str(dataset.spec.dataset_id)
    console.print(f"Recorded {dataset.total_steps} transitions as [bold]{escape(name)}[/].", highlight=False)
    console.print(f"Next: mpcoffline learn --dataset {escape(name)}", highlight=False)


@app.command(
    epilog="Examples:\n\n"
    "mpcoffline learn pendulum --out pendulum.zip\n\n"
    "mpcoffline learn --dataset mpcoffline/cartpole/ddpg-v0 --learn cost --alpha 0.5 --value expectile"
)
def learn(
    task: Annotated[Task | None, typer.Argument(help="Which task; told by the data set if left out.")] = None,
    dataset: Annotated[str | None, typer.Option(help="Data set id.", show_default="the task's DDPG data")] = None,
    learn: Annotated[Learn, typer.Option(help="cost: MPC_2; cost+model: MPC_3.")] = Learn.cost_and_model,
    alpha: Alpha = 1.0,
    seed: Seed = 0,
    value: Value = ValueForm.residual,
    out: Annotated[Path, typer.Option(help="Where to save the learner.", dir_okay=False)] = Path("learner.zip"),
) -> None:
    """Learn the parameters of a task's MPC from a data set.

    Saves the learner and, beside it, its policy (learner.zip, learner_policy.zip).
    """
    from mpcoffline.learner import OfflineMPCLearner

    data, mpc = _data_and_mpc(task, dataset, alpha, seed)
    if not out.parent.is_dir():  # before the work, not after it
        raise InvalidArgumentError("--out", expected="a file in a folder that exists", actual=str(out))
    learner = OfflineMPCLearner(mpc, "cost" if learn is Learn.cost else "cost+model", seed=seed, value=value.value)
    learner.fit(data)
    learner.save(out)
    policy_file = out.with_name(f"{out.stem}_policy{out.suffix}")
    learner.policy.save(policy_file)
    console.print(_parameter_table(learner))
    _say_file("Learner", out)
    _say_file("Policy", policy_file)
    env_id = data.spec.env_spec.id if data.spec.env_spec is not None else "ENV_ID"
    console.print(f"Next: mpcoffline evaluate {escape(str(policy_file))} --env {env_id}", highlight=False)


@app.command(
    epilog="Examples:\n\n"
    "mpcoffline evaluate learner_policy.zip --env mpcoffline/PendulumSwingUp-v0\n\n"
    "mpcoffline evaluate learner.zip --env mpcoffline/CartPoleSwingUp-v0 --episodes 10 --start hanging"
)
def evaluate(
    policy: Annotated[Path, typer.Argument(help="A saved policy or learner (.zip).", exists=True, dir_okay=False)],
    env: Annotated[str, typer.Option(help="Gymnasium id of the environment.", show_default=False)],
    episodes: Annotated[int, typer.Option(help="Number of episodes.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the first start; episode i has seed + i.", min=0)] = 0,
    start: Annotated[Start | None, typer.Option(help="Kind of start.", show_default="the environment's")] = None,
    alpha: Annotated[
        float | None, typer.Option(help="Plant of the linear task.", show_default="1.0", min=0.0, max=4.0)
    ] = None,
) -> None:
    """Run a policy in closed loop and report its cost."""
    import mpcoffline

    controller = _loaded_policy(policy)
    target = _environment(env, alpha, start)
    options = None if start is None else {"start": start.value}
    with console.status("Closed loops"):
        result = mpcoffline.evaluate(
            controller, target, episodes, seed, discount=controller.mpc.discount, options=options
        )
    stats = controller.solver_stats
    table = Table(title=f"{policy.name} in {env}, {episodes} episodes", title_justify="left", box=None, pad_edge=False)
    for name in ("", "mean", "best", "worst"):
        table.add_column(name, justify="right" if name else "left")
    for label, costs in (("cost J", result.cost), (f"discounted cost ({result.discount:g})", result.discounted_cost)):
        table.add_row(label, f"{costs.mean():.2f}", f"{costs.min():.2f}", f"{costs.max():.2f}")
    table.add_row("success", f"{result.success.mean():.0%}")
    table.add_row("time of a solve (ms)", f"{1e3 * stats.time / stats.n_solves:.2f}")
    table.add_row("failed solves", f"{stats.n_failures} of {stats.n_solves}")
    console.print(table)


@app.command(epilog="Example:\n\nmpcoffline export learner_policy.zip --out controller/")
def export(
    policy: Annotated[Path, typer.Argument(help="A saved policy or learner (.zip).", exists=True, dir_okay=False)],
    out: Annotated[Path, typer.Option(help="Folder for the C files.", file_okay=False)] = Path("controller"),
) -> None:
    """Write a policy as self-contained C99: no allocation, no dependency, a fixed budget of iterations.

    The folder receives the controller, a header with names and units of the parameters, a CMake file, and a test that
    compares it with this package's solutions.
    """
    from mpcoffline.export import export_c

    for path in export_c(_loaded_policy(policy), out):
        _say_file("C", path)


def _say_file(what: str, path: Path) -> None:
    """A line with a path, never wrapped, so that it can be copied."""
    console.print(f"{what}: [bold]{escape(str(path))}[/]", highlight=False, soft_wrap=True)


def _data_and_mpc(task: Task | None, dataset: str | None, alpha: float, seed: int) -> tuple[MinariDataset, MPC]:
    """The data set and MPC_1 of a task; the task is that of the data set where none is given."""
    from mpcoffline.datasets import load_dataset
    from mpcoffline.study.setups import setup_of
    from mpcoffline.tasks import nominal_mpc

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


def _loaded_policy(path: Path) -> MPCPolicy:
    """The policy in a policy's or learner's file."""
    from mpcoffline.errors import FileFormatError
    from mpcoffline.learner import OfflineMPCLearner
    from mpcoffline.policy import MPCPolicy

    try:
        return MPCPolicy.load(path)
    except FileFormatError as not_a_policy:
        try:
            return OfflineMPCLearner.load(path).policy
        except FileFormatError:
            raise not_a_policy from None


def _environment(env_id: str, alpha: float | None, start: Start | None) -> Env[Any, Any]:
    """The environment; options that it does not know are refused before anything is solved."""
    import gymnasium as gym

    from mpcoffline.envs import ENV_IDS, ControlTask

    try:
        env: Env[Any, Any] = gym.make(env_id) if alpha is None else gym.make(env_id, alpha=alpha)
    except gym.error.UnregisteredEnv as error:
        nearest = difflib.get_close_matches(env_id, ENV_IDS, n=1, cutoff=0.3)
        hint = f"Did you mean {nearest[0]!r}?" if nearest else ""
        raise UnknownIdError("--env", expected="a registered environment", actual=repr(env_id), hint=hint) from error
    except TypeError as error:
        raise InvalidArgumentError("--alpha", expected=f"none for {env_id}", actual=str(alpha)) from error
    task = env.unwrapped
    known = task.starts if isinstance(task, ControlTask) else ()
    if start is not None and start.value not in known:
        raise InvalidArgumentError("--start", expected=f"one of {known} for {env_id}", actual=repr(start.value))
    return env


def _parameter_table(learner: OfflineMPCLearner) -> Table:
    """Scalars and diagonals of the parameters before and after learning."""
    import numpy as np

    before, after = learner.nominal_mpc.values, learner.mpc.values
    table = Table(title="Parameters (diagonals of matrices)", title_justify="left", box=None, pad_edge=False)
    for name in ("parameter", "nominal", "learned"):
        table.add_column(name)
    for name, old in before.items():
        cells = []
        for array in (old, after[name]):
            shown = np.atleast_1d(np.diag(array) if array.ndim == 2 else array)
            cells.append(" ".join(f"{number:.4g}" for number in shown))
        table.add_row(name, *cells)
    if learner.result is not None:
        table.add_row("regression error", f"{learner.result.loss_before:.4g}", f"{learner.result.loss_after:.4g}")
    return table
