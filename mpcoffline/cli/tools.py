"""The commands ``mpcoffline export``, ``mpcoffline doctor`` and ``mpcoffline clean``."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from .common import examples, loaded_actor, loaded_policy, print_json, say, say_file, working
from .options import Controller, Json

app = typer.Typer()

_MARKS = {"ok": "[green]ok[/]  ", "warn": "[yellow]warn[/]", "fail": "[bold red]fail[/]"}


class Target(StrEnum):
    """What a policy is written for."""

    c = "c"
    do_mpc = "do-mpc"
    acados = "acados"
    casadi = "casadi"
    fmi = "fmi"
    onnx = "onnx"


@app.command(
    epilog=examples(
        "mpcoffline export learner_policy.zip --out controller/",
        "mpcoffline export learner_policy.zip --to do-mpc --out controller/",
        "mpcoffline export learner_policy.zip --to acados --out controller/",
        "mpcoffline export learner_policy.zip --to casadi --out controller/",
        "mpcoffline export learner_policy.zip --to fmi --out controller/",
        "mpcoffline export distilled.zip --to c --out controller/",
        "mpcoffline export learner.zip --to onnx --out controller/",
    )
)
def export(
    policy: Controller,
    to: Annotated[
        Target, typer.Option(help="C99, a script for do-mpc or acados, CasADi's files of the problem, an FMU, or ONNX.")
    ] = Target.c,
    out: Annotated[Path, typer.Option(help="Folder for the files.", file_okay=False)] = Path("controller"),
) -> None:
    """Write a policy as self-contained C99: no allocation, no dependency, a fixed budget of iterations.

    The folder receives the controller, a header with names and units of the parameters, a CMake file, and a test that
    compares it with this package's solutions. A policy that sees outputs comes with its observer. The C of an explicit
    policy, as `mpcoffline distill` makes it, is below 20 kB.

    With `--to do-mpc`: a script for do-mpc that makes the same controller, and its functions as CasADi's files.

    With `--to acados`: the same for acados, whose solver is C.

    With `--to casadi`: model, costs and the whole nonlinear program as CasADi's files, and a script that solves it.

    With `--to fmi`: its model, a differential equation, as an FMU of FMI 3.0 for model exchange.

    With `--to onnx`: an explicit policy, or of a learner its value function V.
    """
    with working(f"Writing {to.value}"):
        paths = _exported(policy, to, out)
    for path in paths:
        say_file(to.value, path)


def _exported(policy: Path, to: Target, out: Path) -> list[Path]:
    """The files written."""
    if to is Target.onnx:
        from mpcoffline.control.export_onnx import export_onnx

        return export_onnx(policy, out)
    if to is Target.c:
        from mpcoffline.control.explicit.code import export_explicit_c
        from mpcoffline.control.explicit.policy import DistilledPolicy
        from mpcoffline.control.export import export_c

        controller = loaded_actor(policy)
        if isinstance(controller, DistilledPolicy):
            return export_explicit_c(controller, out)
        return export_c(controller, out)
    from mpcoffline.control.export_acados import export_acados
    from mpcoffline.control.export_casadi import export_casadi
    from mpcoffline.control.export_do_mpc import export_do_mpc
    from mpcoffline.control.export_fmi import export_fmi

    written = {
        Target.do_mpc: export_do_mpc,
        Target.acados: export_acados,
        Target.fmi: export_fmi,
        Target.casadi: export_casadi,
    }
    return written[to](loaded_policy(policy), out)


class Waste(StrEnum):
    """What piles up, ``mpcoffline.datasets.check.cleaning.KINDS_OF_WASTE``."""

    leftovers = "leftovers"
    caches = "caches"
    downloads = "downloads"
    backups = "backups"


@app.command(epilog=examples("mpcoffline clean", "mpcoffline clean --yes", "mpcoffline clean downloads backups"))
def clean(
    kinds: Annotated[
        list[Waste] | None, typer.Argument(metavar="KIND", help="What to look for.", show_default="leftovers caches")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Remove it.")] = False,
    as_json: Json = False,
) -> None:
    """Say what piled up on this machine can go, and how much room it takes; with `--yes` remove it.

    **leftovers**: what killed processes had half built. **caches**: compiled solvers and tables, which are made again
    when needed. **downloads** that broke off, and **backups** of repaired data sets, only if named. Data sets, and
    recordings that `mpcoffline datasets repair` can finish, are never touched.
    """
    from mpcoffline.datasets.check.cleaning import DEFAULT_KINDS, clean as look

    report = look([kind.value for kind in kinds] if kinds else DEFAULT_KINDS, remove_found=yes)
    if as_json:
        print_json({"found": [asdict(waste) | {"path": str(waste.path)} for waste in report.found]})
        return
    say(escape(str(report)))
    if report.found and not yes:
        say(f"{report.size / 1e6:.1f} MB in all. Nothing was removed; to remove it, add --yes.")


@app.command(epilog=examples("mpcoffline doctor", "mpcoffline doctor --json > doctor.json"))
def doctor(as_json: Json = False) -> None:
    """Check this installation: versions, C compiler, cache, solvers, data sets, GPU, threads; what bug reports need.

    Exit code 1 if something that is needed is broken.
    """
    with working("Looking at versions, compiler, solvers and data"):
        from .doctor import checkup

        found = checkup()
    if as_json:
        print_json(found)
    else:
        for check in found["checks"]:
            advice = f" -> {check['advice']}" if check["advice"] else ""
            say(f"{_MARKS[check['status']]}  {check['name']}: {escape(check['found'] + advice)}")
    raise typer.Exit(0 if found["ok"] else 1)
