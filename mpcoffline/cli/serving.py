"""The command ``mpcoffline serve``: a policy in charge of a plant."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from .common import check_out, examples, loaded_policy, message, print_json, say
from .options import Controller, Json, Seed

if TYPE_CHECKING:
    from mpcoffline.control.loading import Acting
    from mpcoffline.control.serving import Clock, Device

app = typer.Typer()

_ANSWER = 0.5  # of a period, that a device may take for an answer


@app.command(
    epilog=examples(
        "mpcoffline serve tuned/policy.zip --simulate two_tank.py --log trial.csv",
        "mpcoffline serve tuned/policy.zip --device 192.168.0.7:5020 --log trial.csv --fallback pump=0",
    )
)
def serve(
    policy: Controller,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            help="Address of the plant, which answers one JSON object a line over TCP.",
            show_default=False,
        ),
    ] = None,
    simulate: Annotated[
        Path | None,
        typer.Option(
            metavar="PLANT.py",
            help="Simulate this plant file instead, as fast as it goes.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="CSV of every decision; an existing one is continued.", dir_okay=False, show_default="none"),
    ] = None,
    periods: Annotated[
        int | None,
        typer.Option(help="How many periods.", min=1, show_default="until Ctrl-C; a simulation: an episode"),
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Time between decisions.", show_default="the plant's", min=1e-6),
    ] = None,
    fallback: Annotated[
        list[str] | None,
        typer.Option(metavar="INPUT=VALUE", help="The safe input; repeatable. Others are held.", show_default=False),
    ] = None,
    hold: Annotated[
        int,
        typer.Option(
            help="How many periods without a decision the input before is held, until the fall-back comes in.", min=0
        ),
    ] = 5,
    transfer: Annotated[int, typer.Option(help="Decisions over which the policy takes over.", min=1)] = 10,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Put a policy in charge of a plant: measure, decide, write, once a period, and log every decision.

    A lost measurement, a failed solve or one that takes too long never ends it: the input before is held, and after
    some periods the fall-back input comes in until the policy decides again. It takes over without a bump. The log is
    what `mpcoffline retune` reads.
    """
    if (device is None) == (simulate is None):
        raise typer.BadParameter("give one of --device and --simulate.")
    host, _, port = (device or "").rpartition(":")
    if device is not None and not (host and port.isdecimal()):
        raise typer.BadParameter(f"expected HOST:PORT, got {device!r}.", param_hint="--device")
    from .own_plants import pairs

    safe = _numbers(pairs("--fallback", fallback))
    if log is not None:
        check_out("--log", log, make=False)
    from contextlib import ExitStack

    from mpcoffline.control.serving import DecisionLog, LineDevice, Service, SystemClock

    controller = loaded_policy(policy)
    clock: Clock = SystemClock()
    plant: Device
    every = float(controller.mpc.model.dt if period is None else period)
    if simulate is not None:
        plant, clock, periods = _simulated(simulate, controller, every, seed, periods)
    else:
        plant = LineDevice(host, int(port), timeout=_ANSWER * every)
    with ExitStack() as closing:
        decisions = (
            None if log is None else closing.enter_context(DecisionLog(log, controller.mpc, controller.y_labels))
        )
        service = Service(
            controller,
            plant,
            period=every,
            fallback=safe,
            hold=hold,
            transfer=transfer,
            clock=clock,
            log=decisions,
            tell=message,
        )
        try:
            service.run(periods)
        except KeyboardInterrupt:
            message("Ended; the fall-back input was sent last." if safe else "Ended; the inputs stay.")
    stats = service.stats
    if as_json:
        print_json({"policy": policy, "log": log} | vars(stats))
        return
    took = f"; at most {stats.longest:.3g} s of {every:g} s" if simulate is None else " (simulated time)"
    say(escape(str(stats)) + took)
    if log is not None:
        say(f"Log: [bold]{escape(str(log))}[/]")
        folder = policy.parent
        if (folder / "run.json").is_file():
            say(f"Next: mpcoffline retune {escape(str(folder))} {escape(str(log))}")


def _numbers(given: dict[str, str]) -> dict[str, float]:
    found = {}
    for name, text in given.items():
        try:
            found[name] = float(text)
        except ValueError as error:
            raise typer.BadParameter(f"expected a number, got {text!r}.", param_hint="--fallback") from error
    return found


def _simulated(file: Path, policy: Acting, period: float, seed: int, periods: int | None) -> tuple[Device, Clock, int]:
    """A plant file as a device, its clock, and how many periods."""
    import time

    from mpcoffline.control.serving import SimulatedDevice, VirtualClock
    from mpcoffline.plants import load_plant

    plant, clock = load_plant(file), VirtualClock(time.time())
    count = plant.steps if periods is None else periods
    env = plant.env(steps=count + 1)
    device = SimulatedDevice(env, policy.mpc, clock, period=period, seed=seed, measured=policy.y_labels)
    return device, clock, count
