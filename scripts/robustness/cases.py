"""One case at a time in a forked process with limits, and what became of it.

The parent has imported everything, so that a case costs a fork (some 20 ms) and not an import (seconds). A case first
makes its files and only then comes under its limits: a file that kills its reader is told from one that could not be
made.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

EQUAL, OTHER, REFUSED = "as the original", "other content", "refused"
EXECUTION, CRASH, RAW, TIME, MEMORY, WRONG, LET_IN = (
    "EXECUTION", "CRASH", "RAW ERROR", "OVER TIME", "OVER MEMORY", "WRONG NUMBERS", "LET IN",
)  # fmt: skip
UNMADE = "not made"
GOOD = (EQUAL, OTHER, REFUSED)
BAD = (EXECUTION, CRASH, RAW, TIME, MEMORY, WRONG, LET_IN)
SECONDS, WALL, ROOM = 2.0, 30, 300 << 20
CANARY = "canary"


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        name: The case, as ``--only`` takes it.
        kind: One of :data:`GOOD`, :data:`BAD` or :data:`UNMADE`.
        detail: The error, or what was done to the file.
        mutation: What was done to the file.
    """

    name: str
    kind: str
    detail: str = ""
    mutation: str = ""


@dataclass(frozen=True)
class Case:
    """A file and how it is read.

    Attributes:
        name: Kind and number, e.g. ``"policy/json/17"``.
        make: Makes the files in an empty folder, from a generator of its own; returns what was done to them, and the
            function that reads them and returns an outcome's kind.
        need: Bytes of address space that reading an honest file takes.
    """

    name: str
    make: Callable[[Path, random.Random], tuple[str, Callable[[], str]]]
    need: int = 0


class Finding(Exception):  # noqa: N818 -- it is no error of the script
    """What a reader did that no reader may do."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(detail)
        self.kind, self.detail = kind, detail


@dataclass
class Limits:
    """The limits of the process that a case runs in."""

    need: int = 0
    stage: str = ""
    pipe: int = -1

    def end_with(self, kind: str, detail: str) -> None:
        """Says what was found, from any thread, and ends this process."""
        os.write(self.pipe, (json.dumps([kind, detail]) + "\n").encode())
        os._exit(0)

    def begin(self, stage: str, seconds: float = SECONDS, wall: int = WALL, room: int = ROOM) -> None:
        """From now on: so many seconds of CPU time, so many of any time, and so much more address space."""
        self.stage = stage
        resource.setrlimit(resource.RLIMIT_AS, (status("VmSize") + self.need + room, resource.RLIM_INFINITY))
        signal.setitimer(signal.ITIMER_PROF, seconds)
        signal.alarm(wall)

    def end(self) -> None:
        """No limits any more."""
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.alarm(0)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


LIMITS = Limits()


def status(key: str) -> int:
    """A line of this process's memory in bytes."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(key))


def run(case: Case, seed: int, scratch: Path, keep: bool = False) -> Outcome:
    """Runs one case in a process of its own."""
    folder = scratch / f"case-{os.getpid()}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(ours)
        _in_child(case, seed, folder, theirs)
    os.close(theirs)
    _, code = os.waitpid(child, 0)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it started, which holds the pipe open
    with os.fdopen(ours, "rb") as pipe:
        said = pipe.read()
    outcome = _judged(case.name, said.decode(errors="replace").splitlines(), code, folder)
    if not keep:
        _remove(folder)
    return outcome


def _in_child(case: Case, seed: int, folder: Path, pipe: int) -> None:
    def say(*words: str) -> None:
        os.write(pipe, (json.dumps([word[:2000] for word in words]) + "\n").encode())  # a pipe holds 64 KB

    try:
        os.setsid()
        output = os.open(folder.parent / f"{folder.name}.said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.chdir(folder)
        sys.path.insert(0, str(folder))
        warnings.simplefilter("ignore")
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.alarm(120)
        mutation, read = case.make(folder, random.Random(f"{seed} {case.name}"))
        say("made", mutation)
        sys.addaudithook(_watch(folder))
        LIMITS.need, LIMITS.pipe = case.need, pipe
        LIMITS.begin("load")
        kind, detail = _outcome(read)
        LIMITS.end()
        say(kind, f"{LIMITS.stage}: {detail}" if detail else "")
    except BaseException as error:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        say("unmade", "".join(traceback.format_exception_only(error)).strip())
    os._exit(0)


def _outcome(read: Callable[[], str]) -> tuple[str, str]:
    from mpcoffline.core.errors import MPCOfflineError

    try:
        return read(), ""
    except Finding as finding:
        return finding.kind, finding.detail
    except BaseException as error:
        LIMITS.end()
        chain, cause = [], error
        while cause is not None and cause not in chain:
            chain.append(cause)
            cause = cause.__cause__ or cause.__context__
        text = f"{type(error).__name__}: {error}"
        if any(isinstance(e, MemoryError) or "bad_alloc" in str(e) or "allocate memory" in str(e) for e in chain):
            return MEMORY, text
        return (REFUSED if isinstance(error, MPCOfflineError) else RAW), text


def _watch(folder: Path) -> Callable[[str, tuple[object, ...]], None]:
    """Notes what no reader of a file does, also where it fails: a shell, and unpickling."""

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event in ("os.system", "pickle.find_class", "os.exec"):
            (folder / CANARY).touch()

    return hook


def _judged(name: str, said: list[str], code: int, folder: Path) -> Outcome:
    words = [json.loads(line) for line in said]
    mutation = words[0][1] if words and words[0][0] == "made" else ""
    if (folder / CANARY).exists():
        return Outcome(name, EXECUTION, "code of the file ran", mutation)
    if not words or words[0][0] == "unmade":
        return Outcome(name, UNMADE, words[0][1] if words else f"status {code}", mutation)
    if len(words) > 1 and words[1][0] != "unmade":
        return Outcome(name, words[1][0], words[1][1], mutation)
    if os.WIFSIGNALED(code):
        number = os.WTERMSIG(code)
        kind = TIME if number in (signal.SIGPROF, signal.SIGALRM, signal.SIGXCPU) else CRASH
        return Outcome(name, kind, signal.Signals(number).name, mutation)
    return Outcome(name, RAW, words[1][1] if len(words) > 1 else f"exit status {code}", mutation)


def _remove(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o700)
    shutil.rmtree(folder, ignore_errors=True)


def run_all(cases: list[Case], seed: int, scratch: Path, workers: int, keep: bool = False) -> Iterator[Outcome]:
    """Runs cases in several processes, each of which forks one for each of its cases."""

    def short(case: Case) -> Outcome:
        outcome = run(case, seed, scratch, keep)
        return replace(outcome, detail=outcome.detail[:400], mutation=outcome.mutation[:150])

    return spread(short, cases, workers)


def spread(
    job: Callable[[Any], Any], items: list[Any], workers: int, begin: Callable[[], object] | None = None
) -> Iterator[Any]:
    """What a function gives for each of some things, as it comes: from several processes, which begin with ``begin``.

    What goes wrong in one of them is an error here, and no second script that goes on in a fork of this one.
    """
    _SPREAD[:] = job, items
    with ProcessPoolExecutor(workers, get_context("fork"), begin) as pool:
        for done in as_completed([pool.submit(_one, number) for number in range(len(items))]):
            yield done.result()


_SPREAD: list[Any] = []  # what the processes have from their fork: most of it cannot be sent


def _one(number: int) -> Any:
    job, items = _SPREAD
    return job(items[number])


def with_progress(outcomes: Iterable[Outcome], total: int) -> list[Outcome]:
    """All outcomes; says now and then how many there are, and names each bad one."""
    done: list[Outcome] = []
    start = said = time.monotonic()
    for outcome in outcomes:
        done.append(outcome)
        if outcome.kind not in GOOD:
            print(f"  {outcome.kind}: {outcome.name} ({outcome.mutation}) {outcome.detail[:160]}", file=sys.stderr)
        if time.monotonic() - said > 15 or len(done) == total:
            said = time.monotonic()
            print(f"{len(done)} of {total}, {said - start:.0f} s", file=sys.stderr, flush=True)
    return done


def table(outcomes: list[Outcome]) -> list[str]:
    """A row for each kind of file and mutation, Markdown."""
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for outcome in outcomes:
        rows[outcome.name.rpartition("/")[0]][outcome.kind] += 1
    columns = [*GOOD, *BAD]
    lines = [
        f"| what | files | {' | '.join(columns)} |",
        f"|---|--:|{'--:|' * len(columns)}",
    ]
    for name, counts in [*rows.items(), ("**all**", sum(rows.values(), Counter()))]:
        cells = [f"**{counts[kind]}**" if kind in BAD and counts[kind] else str(counts[kind]) for kind in columns]
        lines.append(f"| {name} | {sum(counts.values())} | {' | '.join(cells)} |")
    return lines


def findings(outcomes: list[Outcome]) -> list[str]:
    """One line for each kind of thing that went wrong, with how many and one case to replay it."""
    groups: dict[tuple[str, str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        if outcome.kind not in GOOD:
            groups[outcome.name.rpartition("/")[0], outcome.kind, _short(outcome.detail)].append(outcome)
    lines = []
    for (place, kind, detail), group in sorted(groups.items()):
        names = [outcome.name for outcome in (group if place.startswith("hostile") else group[:1])]
        mutation = "" if place.startswith("hostile") else f" ({group[0].mutation})"
        lines.append(f"{place}: {kind}: {len(group)} x {detail}; `--only {' '.join(map(repr, names))}`{mutation}")
    return lines


def _short(detail: str) -> str:
    """An error without the numbers and paths that differ from case to case."""
    words = ["#" if any(c.isdigit() or c == "/" for c in word) else word for word in detail.split()]
    return " ".join(words)[:110]
