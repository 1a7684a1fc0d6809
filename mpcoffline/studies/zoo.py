"""Plants that nobody tuned for, from plant files: MPC_1, a yardstick and the learned MPC on the true plant."""

from __future__ import annotations

import csv
import io
import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import FileFormatError, StorageError
from mpcoffline.core.tables import Table
from mpcoffline.core.text import markdown
from mpcoffline.core.types import Array
from mpcoffline.learner.learner import OfflineMPCLearner

from .plant_files import Loops, PlantFile

NAN = float("nan")
MARGIN, CLOSE = 0.02, 0.05  # "worse" and "better" by more than this of |MPC_1|; "as good" within this of |yardstick|
_SAID = 300


@dataclass(frozen=True)
class Case:
    """One plant file at one seed (of MPC_1's errors, of the log, of learning and of the starts)."""

    path: str
    plant: str
    seed: int
    n_starts: int
    diagnose: bool = False

    @property
    def key(self) -> tuple[str, int, int]:
        """What makes it the same case: plant, seed, number of starts."""
        return self.plant, self.seed, self.n_starts


@dataclass(frozen=True)
class Outcome:
    """What came of a case; a line of the results. Costs are means over the starts; NaN where there is none.

    Attributes:
        plant: Name of the plant.
        seed: The seed.
        starts: Number of episodes of each controller, from the same starts.
        rows: Transitions in the log.
        behaviour: Cost of the controllers that made the log.
        mpc_1: Cost of the rough MPC.
        yardstick: Cost of the best MPC that the plant file knows.
        learned: Cost of the learned MPC.
        gain: learned - MPC_1: mean of the differences, start by start.
        gain_error: Its standard error.
        short: learned - yardstick, likewise.
        short_error: Its standard error.
        ends_behaviour: Share of the episodes that end well.
        ends_mpc_1: The same of MPC_1.
        ends_yardstick: The same of the yardstick.
        ends_learned: The same of the learned MPC.
        fit_s: Time of the fit in s of one core.
        build_s: Time to build the learned MPC's solver, its compiler included, likewise.
        said: What the learner said of itself: its warnings.
        verdict: That of ``diagnose``, where it was asked.
        error: What went wrong; such a case is tried again.
    """

    plant: str
    seed: int
    starts: int
    rows: int = 0
    behaviour: float = NAN
    mpc_1: float = NAN
    yardstick: float = NAN
    learned: float = NAN
    gain: float = NAN
    gain_error: float = NAN
    short: float = NAN
    short_error: float = NAN
    ends_behaviour: float = NAN
    ends_mpc_1: float = NAN
    ends_yardstick: float = NAN
    ends_learned: float = NAN
    fit_s: float = NAN
    build_s: float = NAN
    said: str = ""
    verdict: str = ""
    error: str = ""

    @property
    def key(self) -> tuple[str, int, int]:
        """That of its case."""
        return self.plant, self.seed, self.starts

    @property
    def worse(self) -> bool:
        """Whether the learned MPC costs more than MPC_1, by more than 2 % of its size; so does one without a cost."""
        return not self.gain <= MARGIN * abs(self.mpc_1)

    @property
    def better(self) -> bool:
        """Whether it costs less, by more than 2 %."""
        return self.gain < -MARGIN * abs(self.mpc_1)

    @property
    def close(self) -> bool:
        """Whether it costs at most as much as the yardstick and 5 % of its size."""
        return self.short <= CLOSE * abs(self.yardstick)

    @property
    def room(self) -> bool:
        """Whether the yardstick costs less than MPC_1, by more than 2 %."""
        return self.yardstick < self.mpc_1 - MARGIN * abs(self.mpc_1)


def run_case(case: Case, tell: Callable[[str], None] = lambda what: None) -> Outcome:
    """Logs, learns with the default preset, and lets all controllers act on the plant; an error becomes part of it.

    Args:
        case: The case.
        tell: Is told what is being done.
    """
    found: dict[str, float | int | str] = {}
    try:
        _fill(found, case, tell)
    except Exception as error:  # one case must not end the others
        found["error"] = _short(f"{type(error).__name__}: {error}")
    return Outcome(case.plant, case.seed, case.n_starts, **found)  # type: ignore[arg-type]


def _fill(found: dict[str, float | int | str], case: Case, tell: Callable[[str], None]) -> None:
    """The figures of a case, each put down as soon as it is known."""
    tell("log")
    plant = PlantFile.load(Path(case.path))
    table, seed, n = plant.log(case.seed), case.seed, case.n_starts
    found["rows"] = len(table)

    def loops(name: str, controller: MPCPolicy | None) -> Loops:
        tell(f"{n} episodes of {name}")
        done = plant.closed_loops(controller, seed, n)
        column = name.lower()
        found[column], found[f"ends_{column}"] = float(done.cost.mean()), float(done.success.mean())
        return done

    loops("behaviour", None)
    nominal = plant.module.mpc(seed)
    first = loops("MPC_1", MPCPolicy(nominal))
    best, truth = None, plant.module.truth()
    if truth is not None:
        best = loops("yardstick", MPCPolicy(truth))
    tell(f"fit of {len(table)} transitions")
    said: list[str] = []
    learner = OfflineMPCLearner(nominal, learn=getattr(plant.module, "LEARN", "cost+model"), seed=seed)
    start = _core_seconds()
    with _heard(said):
        learner.fit(table, show_progress=False)
    found["fit_s"] = _core_seconds() - start
    found["said"] = _short("; ".join(dict.fromkeys(said)))
    tell("build of the solver")
    start = _core_seconds()
    _ = learner.policy.solver
    found["build_s"] = _core_seconds() - start
    learned = loops("learned", learner.policy)
    found["gain"], found["gain_error"] = paired(learned.cost, first.cost)
    if best is not None:
        found["short"], found["short_error"] = paired(learned.cost, best.cost)
    if case.diagnose:
        from mpcoffline.diagnostics import diagnose

        tell("verdict")
        report = diagnose(learner, table, seed=seed)
        found["verdict"] = _short(f"{report.verdict}: {report.reasons[0] if report.reasons else ''}".rstrip(": "))


def _core_seconds() -> float:
    """What this process and its compilers have computed so far, in s: on a busy machine, too, what one core needs."""
    return sum(os.times()[:4])


def paired(costs: Array, others: Array) -> tuple[float, float]:
    """Mean of the differences of costs ``(n,)`` from the same starts, and its standard error (NaN for one start)."""
    difference = costs - others
    n = len(difference)
    return float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(n)) if n > 1 else NAN


@contextmanager
def _heard(said: list[str]) -> Iterator[None]:
    """Collects warnings and logged warnings of the package."""

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    ear, logger = Ear(logging.WARNING), logging.getLogger("mpcoffline")
    logger.addHandler(ear)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        said += [str(each.message) for each in caught if not issubclass(each.category, DeprecationWarning)]
    finally:
        logger.removeHandler(ear)


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _SAID else line[: _SAID - 3] + "..."


_COLUMNS = [field.name for field in fields(Outcome)]


def append(path: Path, outcome: Outcome) -> None:
    """Adds a line to a CSV file, which it begins where there is none; on the disk when it returns.

    Raises:
        StorageError: If it cannot be written.
    """
    values = {key: f"{value:.10g}" if isinstance(value, float) else value for key, value in asdict(outcome).items()}
    try:
        with path.open("a+b") as file:
            text = io.StringIO()
            writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
            if (size := file.seek(0, os.SEEK_END)) == 0:
                writer.writeheader()
            else:
                file.seek(size - 1)
                if file.read(1) != b"\n":  # what a killed process has left
                    text.write("\n")
            writer.writerow(values)
            file.write(text.getvalue().encode())  # at the end, whatever was read
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise StorageError.of(path, error) from error


def read(path: Path) -> list[Outcome]:
    """The outcomes in a CSV file, the last of each case; lines that are not whole are passed over.

    Raises:
        FileFormatError: For a file with other columns.
    """
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))
    if lines and lines[0] != _COLUMNS:
        expected = "results of this version"
        raise FileFormatError(str(path), expected=expected, actual="other columns", hint="Write to another file.")
    found: dict[tuple[str, int, int], Outcome] = {}
    kinds = {field.name: field.type for field in fields(Outcome)}
    convert: dict[str, Callable[[str], float | int | str]] = {"int": int, "float": float, "str": str}
    for line in lines[1:]:
        if len(line) != len(_COLUMNS):
            continue
        try:
            values = {name: convert[str(kinds[name])](value) for name, value in zip(_COLUMNS, line, strict=True)}
        except ValueError:
            continue
        outcome = Outcome(**values)  # type: ignore[arg-type]
        found[outcome.key] = outcome
    return list(found.values())


class Summary(NamedTuple):
    """Counts over all cases that have a result.

    Attributes:
        cases: Number of cases.
        worse: Those where the learned MPC costs more than MPC_1 by more than 2 % of its size.
        yardsticks: Number of cases with a yardstick.
        close: Of these, those within 5 % of it.
        room: Of these, those where the yardstick is better than MPC_1 by more than 2 %.
        better: Of these, those where the learned MPC is, too.
    """

    cases: int
    worse: list[Outcome]
    yardsticks: int
    close: int
    room: int
    better: int


def summarised(outcomes: Sequence[Outcome]) -> Summary:
    """The counts."""
    done = [o for o in outcomes if not o.error]
    measured = [o for o in done if not np.isnan(o.yardstick)]
    room = [o for o in measured if o.room]
    close, better = sum(o.close for o in measured), sum(o.better for o in room)
    return Summary(len(done), [o for o in done if o.worse], len(measured), close, len(room), better)


_HEADER = ["plant", "seed", "behaviour", "MPC_1", "yardstick", "learned", "learned - MPC_1", "learned - yardstick"]
_HEADER += ["ends well: MPC_1/yardstick/learned", "fit (s)", "build (s)"]


def report(outcomes: Sequence[Outcome]) -> str:
    """A page in Markdown: the counts, those that became worse, and a line a case."""
    rows = sorted(outcomes, key=lambda o: o.key)
    s, failed = summarised(rows), [o for o in rows if o.error]
    starts = ", ".join(str(n) for n in sorted({o.starts for o in rows})) or "no"
    lines = [
        "# Plants that nobody tuned for",
        "",
        f"`scripts/bench_zoo`: {s.cases} cases, each a plant file and a seed (of MPC_1's errors, the log, the learning,"
        f" the starts), the default preset, no option set for any plant. Costs are means over {starts} starts that the"
        " log does not hold, the same for all controllers; differences are paired, +- their standard error. The"
        " yardstick is an MPC with the best model and the plant's own stage cost. What a plant file is:"
        " [](../guides/plant_files.md).",
        "",
        f"* Worse than MPC_1 by more than 2 % of its cost: **{len(s.worse)} of {s.cases}**"
        + "".join(f"; {o.plant} {o.seed} ({_pair(o.gain, o.gain_error)})" for o in s.worse),
        f"* Within 5 % of the yardstick: **{s.close} of {s.yardsticks}**",
        f"* Better than MPC_1 by more than 2 % where the yardstick is: **{s.better} of {s.room}**",
        f"* Time in s of one core: fit {_range([o.fit_s for o in rows])};"
        f" build of its solver {_range([o.build_s for o in rows])}",
    ]
    lines += [f"* Failed: {o.plant} {o.seed}: {o.error}" for o in failed]
    judged = any(o.verdict for o in rows)
    header = _HEADER + ["verdict"] * judged
    cells = [_cells(o) + [o.verdict] * judged for o in rows]
    table = Table(header, cells, align="lrrrrrrrrrr" + "l" * judged)
    lines += ["", table.markdown(), "", *_sayings(rows)]
    return "\n".join(lines).rstrip("\n") + "\n"


def _sayings(rows: Sequence[Outcome]) -> list[str]:
    """What the learner said, once a plant where only numbers differ; a column of it would make the table unreadable."""
    first: dict[tuple[str, str], Outcome] = {}
    for o in rows:
        first.setdefault((o.plant, re.sub(r"[\d.]+", "", o.said)), o)
    said = [f"* {o.plant} {o.seed}: {markdown(o.said)}" for o in first.values() if o.said]
    intro = ["## What the learner said", "", "Where it is the same but for numbers, for the first seed.", ""]
    return [*intro, *said] if said else []


def _cells(o: Outcome) -> list[str]:
    costs = [_number(cost) for cost in (o.behaviour, o.mpc_1, o.yardstick, o.learned)]
    ends = "/".join("-" if np.isnan(e) else f"{e:.2f}" for e in (o.ends_mpc_1, o.ends_yardstick, o.ends_learned))
    differences = [_pair(o.gain, o.gain_error), _pair(o.short, o.short_error)]
    times = ["-" if np.isnan(t) else f"{t:.0f}" for t in (o.fit_s, o.build_s)]
    return [o.plant, str(o.seed), *costs, *differences, ends, *times]


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.5g}"


def _pair(mean: float, error: float) -> str:
    return "-" if np.isnan(mean) else f"{mean:+.3g} +- {error:.2g}"


def _range(values: Sequence[float]) -> str:
    known = [value for value in values if not np.isnan(value)]
    return f"{min(known):.0f} to {max(known):.0f} (median {np.median(known):.0f})" if known else "-"
