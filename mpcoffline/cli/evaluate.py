"""The command ``mpcoffline evaluate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from mpcoffline.core.tables import Table

from .common import console, examples, loaded_actor, made_environment, print_json, working
from .options import Controller, Json, PlantAlpha, Start, beginning, environments

if TYPE_CHECKING:
    from mpcoffline.control.evaluation import Evaluation
    from mpcoffline.control.explicit.policy import DistilledPolicy
    from mpcoffline.control.loading import Acting
    from mpcoffline.solvers.fallback import SolverStats

app = typer.Typer()


@app.command(
    epilog=examples(
        "mpcoffline evaluate learner_policy.zip --env mpcoffline/PendulumSwingUp-v0",
        "mpcoffline evaluate learner.zip --env mpcoffline/CartPoleSwingUp-v0 --episodes 10 --start hanging",
        "mpcoffline evaluate tuned/policy.zip --env two_tank.py",
        "mpcoffline evaluate learner.zip --env mpcoffline/LinearTracking-v0 --json",
        "mpcoffline evaluate distilled.zip --env mpcoffline/PendulumSwingUp-v0",
    )
)
def evaluate(
    policy: Controller,
    env: Annotated[
        str,
        typer.Option(
            metavar="ID|PLANT.py",
            help="Gymnasium id of the environment, or a plant file, which is run and simulated.",
            show_default=False,
            autocompletion=beginning(environments),
        ),
    ],
    episodes: Annotated[int, typer.Option(help="Number of episodes.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the first start; episode i has seed + i.", min=0)] = 0,
    start: Annotated[Start | None, typer.Option(help="Kind of start.", show_default="the environment's")] = None,
    alpha: PlantAlpha = None,
    as_json: Json = False,
) -> None:
    """Run a policy in closed loop and report its cost."""
    import mpcoffline

    target = made_environment(env, alpha, None if start is None else start.value)
    controller = loaded_actor(policy)
    options = None if start is None else {"start": start.value}
    discount = _discount(controller)
    with working("Closed loops"):
        result = mpcoffline.evaluate(controller, target, episodes, seed, discount=discount, options=options)
    stats = getattr(controller, "solver_stats", None)  # an explicit policy solves nothing
    if as_json:
        solves = {} if stats is None else _solves(stats)
        print_json(
            {"policy": policy, "env": env, "episodes": episodes, "seed": seed, "start": start, "alpha": alpha}
            | _figures(result)
            | solves
        )
        return
    costs = ("cost J", result.cost), (f"discounted cost ({result.discount:g})", result.discounted_cost)
    rows = [
        *((label, f"{c.mean():.2f}", f"{c.min():.2f}", f"{c.max():.2f}") for label, c in costs),
        *([("success", f"{result.success.mean():.0%}")] if result.knows_success else []),
    ]
    if stats is not None:
        rows += [
            ("time of a solve (ms)", f"{1e3 * stats.time / stats.n_solves:.2f}"),
            ("failed solves", stats.failures),
        ]
    title = f"{policy.name} in {env}, {episodes} episodes"
    console.print(Table(("", "mean", "best", "worst"), rows, title, "lr"))


def _discount(controller: Acting | DistilledPolicy) -> float:
    """The MPC's discount, or that of the MPC that was distilled."""
    from mpcoffline.control.explicit.policy import DistilledPolicy

    return controller.report.discount if isinstance(controller, DistilledPolicy) else controller.mpc.discount


def _solves(stats: SolverStats) -> dict[str, Any]:
    """How the solves went, for machines."""
    return {
        "n_solves": stats.n_solves,
        "n_failures": stats.n_failures,
        "solve_time": stats.time / stats.n_solves,
        "failures": stats.answers,
    }


def _figures(result: Evaluation) -> dict[str, Any]:
    """Costs for machines: means, and one number an episode."""
    return {
        "cost": result.cost.mean(),
        "discounted_cost": result.discounted_cost.mean(),
        "discount": result.discount,
        "success": result.success.mean() if result.knows_success else None,
        "costs": result.cost,
        "discounted_costs": result.discounted_cost,
        "successes": result.success,
    }
