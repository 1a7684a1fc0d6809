"""``tune``: from a plant and a log to a folder with a controller and a verdict on it."""

from __future__ import annotations

from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import casadi as ca

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.datasets.logs.reading import LoggedTable
from mpcoffline.datasets.table.files import hash_of, save_table
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.diagnostics.page import Section
from mpcoffline.plants import BlackBoxPlant, Plant
from mpcoffline.plants.outputs import OutputReader

from .folder import HIDDEN, OUTPUTS, Workplace, identity_of, read_run
from .log_check import check_log, with_equations
from .making import Order, Tell, check_options, made
from .page import LogCheck
from .tuned import Tuned

_SAID = {"problem": "To be looked at", "advice": "Advice"}


def tune(
    plant: Plant | BlackBoxPlant,
    table: TransitionTable,
    out: str | PathLike[str],
    *,
    seed: int = 0,
    tell: Tell | None = None,
    show_progress: bool = True,
    **options: Any,
) -> Tuned:
    """Checks a log, fits, judges the fit, and writes all of it into a folder.

    The folder appears complete, or not at all: until then it is made beside it, in ``OUT.unfinished``, from where the
    same call goes on after an interruption. A folder that holds the result of the same plant, log and options is
    returned as it is; what another one held is kept in a numbered folder inside the new one. It holds

    * ``report.html``, the page of :meth:`~mpcoffline.diagnostics.Report.html`, with what the log's check says;
    * ``policy.zip``, the proposal; MPC_1, where the verdict is ``"keep MPC_1"``;
    * ``learner.zip``, all that was learned, and ``controller/``, the policy as C99;
    * ``log.zip`` and ``plant.json``, from which ``retune`` goes on without running the plant file again;
    * ``run.json``, options, versions, hashes, verdict and expected costs.

    Of a plant with outputs, model and states are found in these first (:meth:`mpcoffline.Plant.identify`); the policy
    and its C code have their observer.

    Example:
        >>> plant = mpcoffline.load_plant("two_tank.py")
        >>> tuned = tune(plant, plant.read("log.csv"), "tuned")
        >>> print(tuned)
        >>> action, state = tuned.policy.predict(observation)

    Args:
        plant: The plant; one without equations gets a linear model of the log (:class:`mpcoffline.BlackBoxPlant`).
        table: A log of it, as :meth:`mpcoffline.Plant.read` gives it.
        out: The folder.
        seed: Of everything random: the same seed, data and machine give the same folder.
        tell: Is told, in a sentence, what is done now.
        show_progress: Whether the fit draws a progress bar.
        **options: Of :class:`~mpcoffline.OfflineMPCLearner`, numbers and texts: ``preset="best"``, ``learn="cost"``,
            ``polish=True``, ``discount=0.97``.

    Raises:
        InvalidArgumentError: For an option that is no number and no text, or that no learner takes.
        InvalidDataError: If the check says that nothing can be fitted before something is mended.
        StorageError: If the folder holds something else, or cannot be written.
        UnknownIdError: For an unknown preset.
    """
    tell = tell or (lambda _: None)
    plant, model = with_equations(plant, table, seed, tell)
    mpc = plant.mpc()
    options = check_options(options | {"seed": seed}, mpc)
    reader = _reader(plant)
    identity = identity_of(reader=reader, mpc=mpc.to_json(), log=hash_of(table), options=options)
    place = Workplace(Path(out), identity)
    if place.finished is not None:
        tell("This very result is there already")
        return Tuned(place.folder, place.finished, again=True)
    if place.begin():
        tell(f"Going on with {place.path}")

    def checked() -> LogCheck:
        tell("Checking log and description")
        found = check_log(plant, table, seed=options["seed"], tell=lambda what: tell(f"  {what}"))
        forbidding = [each for each in found.remarks if each.forbids]
        if forbidding:
            raise InvalidDataError(
                f"{table.name} and {plant.name}",
                expected="a log and a description that fit together",
                actual=" ".join(f"{each.about}: {each.text}" for each in forbidding),
                hint="`mpcoffline check` shows all that was found.",
            )
        return found

    outputs = None
    if plant.outputs:  # what is found in them is needed below, also where the rest is there
        found = checked()
        outputs = found.outputs
        tell(f"  {outputs}")
        said = place.once("check", lambda: _said(found))
        save_table(table, place.path / OUTPUTS)
    else:
        said = place.once("check", lambda: _said(checked()))
    for each in said["remarks"]:
        if each["kind"] != "good":
            tell(f"{_SAID[each['kind']]}: {each['about']}: {each['text']}")
    order = Order(
        plant.name,
        reader,
        mpc,
        table if outputs is None else outputs.table,
        options,
        sections=[_section(table, said, model)],
        outputs=outputs,
    )
    document = made(order, place, tell, show_progress=show_progress) | {
        "check": said,
        "model": model,
        **_read_as(table),
    }
    former = place.finish(document)
    return Tuned(place.folder, read_run(place.folder), former=former)


def _reader(plant: Plant) -> dict[str, Any]:
    """What reads logs of a plant, and what tells it from another."""
    if not plant.outputs:
        return {"name": plant.name} | plant.wanted.to_json(plant.cost_function)
    sizes = len(plant.outputs), len(plant.inputs), len(plant.signals), len(plant.inputs)
    nothing = ca.Function("nothing", [ca.SX.sym(f"i{k}", n) for k, n in enumerate(sizes)], [ca.SX(0.0)])
    return {"name": plant.name, HIDDEN: OutputReader.of(plant).to_json()} | plant.wanted.to_json(nothing)


def _said(found: LogCheck) -> dict[str, Any]:
    """What a check says, for files."""
    return {"verdict": found.verdict, "remarks": [asdict(each) for each in found.remarks]}


def _read_as(table: TransitionTable) -> dict[str, Any]:
    """How a log was read, so that the next one is read likewise."""
    if not isinstance(table, LoggedTable):
        return {"read": None}
    options = {name: value for name, value in asdict(table.options).items() if value}
    return {"read": {"header": table.header, "options": options}}


def _section(table: TransitionTable, said: dict[str, Any], model: str) -> Section:
    """What the page says of the log before the fit, and of a model that it gave."""
    remarks = [each for each in said["remarks"] if each["about"] != "gain"]
    items = [f"model: {model}"] if model else []
    items += [f"{each['about']}: {each['text']}" for each in remarks]
    if not isinstance(table, LoggedTable):
        return Section("What the check found", (said["verdict"],), items)
    report = table.report
    head, *_ = str(report).splitlines()
    left_out = Table(report.table.header, report.table.rows, "What was left out", report.table.align)
    tables = [left_out] if report.left_out else []
    return Section("What was read and found", (head, said["verdict"]), [*report.notes, *items], tables)
