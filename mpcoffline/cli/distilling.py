"""The command ``mpcoffline distill``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpcoffline.core.errors import InvalidArgumentError

from .common import check_out, examples, loaded_policy, made_environment, print_json, say, say_file
from .options import Controller, Json, PlantAlpha, Seed, beginning, dataset_ids, environments

app = typer.Typer()


@app.command(
    epilog=examples(
        "mpcoffline distill learner_policy.zip --data mpcoffline/pendulum/ddpg-v0",
        "mpcoffline distill learner_policy.zip --env mpcoffline/PendulumSwingUp-v0 --out small.zip",
        "mpcoffline distill tuned/policy.zip --env two_tank.py --multiply-adds 500",
    )
)
def distill(
    policy: Controller,
    data: Annotated[
        str | None,
        typer.Option(
            metavar="ID",
            help="Data set whose states the loops begin in.",
            show_default="the environment's starts",
            autocompletion=beginning(dataset_ids),
        ),
    ] = None,
    env: Annotated[
        str | None,
        typer.Option(
            metavar="ID|PLANT.py",
            help="Environment in which both are compared at last.",
            show_default="none",
            autocompletion=beginning(environments),
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="File for the explicit policy.", dir_okay=False)] = Path("distilled.zip"),
    multiply_adds: Annotated[int, typer.Option(help="The most multiply-adds that one action may take.", min=1)] = 2000,
    labels: Annotated[int, typer.Option(help="About how many MPCs are solved as examples.", min=1)] = 40_000,
    seed: Seed = 0,
    alpha: PlantAlpha = None,
    as_json: Json = False,
) -> None:
    """Make a small network that acts as an MPC does, for devices that cannot solve one.

    The examples come from closed loops on the MPC's own model, those of the network among them. What the network costs
    more than the MPC is measured there, from other starts, and in the environment, if one is given.

    `mpcoffline evaluate` runs the file, `mpcoffline export` writes it as C99 or ONNX.
    """
    check_out("--out", out, make=False)
    if data is None and env is None:
        raise InvalidArgumentError("--data", expected="a data set, or an environment by --env", actual="neither")
    target = None if env is None else made_environment(env, alpha, None)
    controller = loaded_policy(policy)
    from mpcoffline.control.explicit.distilling import distill as distilled

    small = distilled(
        controller,  # type: ignore[arg-type]  # one that sees outputs is refused, in words
        data,
        env=target,
        seed=seed,
        multiply_adds=multiply_adds,
        n_labels=labels,
        progress=not as_json,
    )
    small.save(out)
    if as_json:
        print_json({"policy": policy, "data": data, "env": env, "out": out} | small.report.to_json())
        return
    say(str(small.report))
    say_file("policy", out)
