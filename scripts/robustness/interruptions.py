"""Work that is killed, interrupted, or meets a full disk."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

from .recordings import (
    ID,
    PROMISES,
    RUN,
    Found,
    arrays_of,
    check_set,
    fresh,
    leftovers,
    length_of,
    store,
    with_agent,
    with_record,
)  # fmt: skip
from .rounds import Ended, Job, Round, clean, command

# --- kill -9 ------------------------------------------------------------------------------------------------------


def recording(case: Round) -> None:
    """``record`` is killed."""
    case.killed(lambda: with_record(1, 10**6), b"b", within=0.25)
    promised = set(PROMISES)
    case.repaired()
    case.check(promised)


def recording_by_agent(case: Round) -> None:
    """A recorder over three environments is killed."""
    case.killed(lambda: with_agent(1, 3, 10**6), b"b", within=0.5)
    promised = set(PROMISES)
    case.repaired()
    case.check(promised)


def sealing(case: Round) -> None:
    """A recorder that has begun to seal is killed."""
    case.killed(lambda: with_agent(1, case.rng.choice((1, 3)), 200), b"s", within=0.15)
    promised = set(PROMISES)
    case.repaired()
    case.check(promised)


def resuming(case: Round) -> None:
    """One recording is killed again and again, and then goes on to its end."""
    count = 30
    for _ in range(3):
        PROMISES.say(b"-")
        case.killed(lambda: with_record(1, count), b"b", within=0.04)
    ended = case.run(lambda: with_record(1, count))
    done = "exists" in ended.error  # it was whole before
    if ended.error and not done:
        case.problem(f"resume: {ended.error[:200]}")
    case.check(set(PROMISES))
    if case.found.stored != count:
        case.problem(f"wrong: {case.found.stored} episodes for {count}")


def repairing(case: Round) -> None:
    """A repair is killed twice."""
    case.killed(lambda: with_agent(1, 2, 10**6), b"b", within=0.8)
    promised = set(PROMISES)
    from mpcoffline.datasets import repair

    for _ in range(2):
        case.killed(lambda: repair(ID), within=0.12)
        case.found.problems = [text for text in case.found.problems if "UnknownIdError" not in text]
    case.repaired()
    case.check(promised)


def replacing(case: Round) -> None:
    """A recording that replaces a data set is killed; before any repair, that id is the old or the new one, whole."""
    case.run(lambda: with_record(1, 8))
    old = set(range(RUN, RUN + 8))
    PROMISES.clear()
    case.killed(lambda: with_agent(2, 2, 150, overwrite=True), case.rng.choice((b"b", b"s")), within=0.2)
    new = set(PROMISES)
    before = check_set(set())
    stored = {serial for serial in old if not check_set({serial}).problems}
    if before.problems or (stored and stored != old):
        case.problem(f"lost: of the old data set {len(stored)} of {len(old)} episodes; {before.problems[:1]}")
    case.repaired()
    case.check(new or (old if stored else set()), allowed=None if not new else set(range(2 * RUN, 3 * RUN)))


def extending(case: Round) -> None:
    """The second training with a recorder is killed; both are in the data set."""
    case.killed(lambda: with_agent(1, 2, 80, rounds=3), b"s", within=0.6)
    promised = set(PROMISES)
    case.repaired()
    case.check(promised)


def storing(case: Round) -> None:
    """Storing arrays over an old data set is killed: it is the old or the new one."""
    from mpcoffline.datasets import dataset_from_arrays

    old, new = range(RUN, RUN + 10), range(2 * RUN, 2 * RUN + 40)
    dataset_from_arrays(ID, arrays_of(old))
    episodes = arrays_of(new)
    case.killed(lambda: dataset_from_arrays(ID, episodes, overwrite=True), within=0.2)
    is_old = not check_set(set(old)).problems
    case.check(set(old) if is_old else set(new), allowed=set(old) if is_old else set(new), after=False)
    case.run(lambda: dataset_from_arrays("crash/next-v0", arrays_of(old)))
    case.swept()


def tables(case: Round) -> None:
    """Building a cached table is killed; afterwards it is right."""
    from mpcoffline import TransitionTable
    from mpcoffline.datasets import dataset_from_arrays

    serials = range(RUN, RUN + 60)
    dataset_from_arrays(ID, arrays_of(serials))

    def build() -> Any:
        return TransitionTable.from_minari(ID, memory=1)

    case.killed(build, within=0.1)
    costs: list[float] = []

    def again() -> None:
        table = build()
        costs.extend(table.costs.tolist())
        if len(table) != sum(length_of(serial) for serial in serials):
            raise ValueError(f"{len(table)} rows")

    ended = case.run(again)
    if ended.error:
        case.problem(f"wrong: table: {ended.error[:200]}")
    case.check(set(serials))


def cleaning(case: Round) -> None:
    """Cleaning up is killed beside a recording that is not finished: nothing promised goes with it."""
    from mpcoffline.datasets import dataset_from_arrays

    case.killed(lambda: with_record(1, 10**6), b"b", within=0.2)
    case.killed(lambda: dataset_from_arrays("crash/next-v0", arrays_of(range(RUN, RUN + 40))), within=0.2)
    promised = set(PROMISES)
    case.killed(clean, within=0.3)
    case.run(clean)
    case.repaired()
    case.check(promised)


# --- full disks ---------------------------------------------------------------------------------------------------


def file_limit(case: Round) -> None:
    """Files may only be so large: an error of ours, nothing lost, nothing left."""
    size = int(10 ** case.rng.uniform(2.5, 5.3))
    way = case.rng.choice(("record", "agent", "arrays"))

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    _without_room(case, way, limit, lambda: None)


def small_disk(case: Round) -> None:
    """A file system of some hundred kilobytes, which fills up."""
    place = store()
    size = int(10 ** case.rng.uniform(1.5, 3.0)) * 1024
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={max(size, 16_384)}", "tmpfs", str(place)], check=True)
    try:
        grow = ["mount", "-o", "remount,size=64m", str(place)]
        way = case.rng.choice(("record", "agent", "arrays"))
        _without_room(case, way, None, lambda: subprocess.run(grow, check=True))
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def _without_room(case: Round, way: str, before: Job | None, room: Job) -> None:
    from mpcoffline.datasets import dataset_from_arrays

    episodes = arrays_of(range(RUN, RUN + 150))
    jobs: dict[str, Job] = {
        "record": lambda: with_record(1, 150),
        "agent": lambda: with_agent(1, 2, 500),
        "arrays": lambda: dataset_from_arrays(ID, episodes),
    }
    ended = case.run(jobs[way], before)
    promised = set(PROMISES)
    if ended.error and not ended.error.startswith(("StorageError", "RAW")):
        case.problem(f"error: {ended.error[:200]}")
    if way == "arrays" and not ended.error and not ended.crashed:
        promised = set(range(RUN, RUN + 150))
    if left := [path for path in leftovers() if ".recording" not in path]:
        case.problem(f"left: {', '.join(left)[:200]}")
    room()
    case.repaired()
    case.check(promised)


# --- signals ------------------------------------------------------------------------------------------------------


def _interrupted(case: Round, words: list[str], until: Path, within: float) -> Ended:
    """A command that is interrupted twice, some time after a file exists below a folder, and then runs to its end."""
    for _ in range(2):
        number = case.rng.choice((signal.SIGINT, signal.SIGTERM))
        ended = case.killed(
            lambda: command(*words), lambda: any(until.rglob("*.log")) or until.is_file(), within, number
        )
        if "Traceback (most recent call last)" in ended.text:
            case.problem(f"raw error: {ended.text.strip().splitlines()[-1][:200]}")
    return case.run(lambda: command(*words))


def recorded_episodes(case: Round) -> None:
    """``record`` is interrupted, and run again to its end."""
    count = 40
    for _ in range(3):
        number = case.rng.choice((signal.SIGINT, signal.SIGTERM))
        PROMISES.say(b"-")
        case.killed(lambda: with_record(1, count), b"b", within=0.06, number=number)
    ended = case.run(lambda: with_record(1, count))
    if ended.error and "exists" not in ended.error:
        case.problem(f"resume: {ended.error[:200]}")
    case.check(set(PROMISES) | set(range(RUN, RUN + count)))
    if case.found.stored != count:
        case.problem(f"wrong: {case.found.stored} episodes for {count}")


def collected(case: Round) -> None:
    """``mpcoffline collect`` is interrupted twice, and run again to its end: as many steps as asked for, none twice."""
    import h5py

    steps = 250
    words = ["collect", "linear", "--steps", str(steps), "--seed", "1", "--dataset-id", ID]
    ended = _interrupted(case, words, store() / ".recording", 2.0)
    path = store() / ID / "data" / "main_data.hdf5"
    if not path.exists():
        case.problem(f"lost: no data set; {ended.text.strip()[-200:]}")
        return
    with h5py.File(path) as file:
        episodes = [file[f"episode_{k}/observations"][()] for k in range(len(file))]
    starts = {tuple(episode[0].tolist()) for episode in episodes}
    count = sum(len(episode) - 1 for episode in episodes)
    case.found.promised, case.found.stored = 1, len(episodes)
    if count != steps:
        case.problem(f"wrong: {count} steps for {steps}")
    if len(starts) != len(episodes):
        case.problem(f"duplicated: {len(episodes) - len(starts)} of {len(episodes)} episodes")
    case.swept()


_LEARNED: dict[str, Any] = {}  # what is the same for all cases of a process


def _fit(checkpoint: str | None) -> None:
    from .honest import learner

    fitted = learner()
    fitted.fit(_LEARNED["table"], n_steps_per_epoch=2, checkpoint=checkpoint, show_progress=False)
    fitted.save("learned.zip")


def fitted(case: Round) -> None:
    """``fit(checkpoint=...)`` is interrupted, and run again to its end: the same theta."""
    from mpcoffline import TransitionTable
    from mpcoffline.datasets import record

    from .honest import actions, short_env

    if "table" not in _LEARNED:
        _LEARNED["table"] = TransitionTable.from_minari(record(short_env(), actions(0), 6, ID, seed=0))
    for _ in range(2):
        number = case.rng.choice((signal.SIGINT, signal.SIGTERM))
        case.killed(lambda: _fit("fit.ckpt"), within=1.5, number=number)
    case.run(lambda: _fit("fit.ckpt"))
    _compare(case, "fit", lambda: _fit(None))


def learned(case: Round) -> None:
    """``mpcoffline learn --checkpoint`` is interrupted, and run again to its end: the same theta."""
    words = ["learn", "linear", "--preset", "fast", "--steps", "300", "--seed", "2", "--out", "learned.zip"]
    _interrupted(case, [*words, "--checkpoint", "fit.ckpt"], case.folder / "fit.ckpt", 5.0)
    _compare(case, "learn", lambda: command(*words))


def _compare(case: Round, name: str, plainly: Job) -> None:
    """The learner's file in the folder has the theta of one that was not interrupted."""
    from mpcoffline import OfflineMPCLearner

    path = case.folder / "learned.zip"
    case.found.promised = case.found.stored = 1
    if not path.exists():
        case.problem("lost: there is no learner")
        return
    theta = OfflineMPCLearner.load(path).theta.tolist()
    if name not in _LEARNED:
        path.unlink()
        case.run(plainly)
        _LEARNED[name] = OfflineMPCLearner.load(path).theta.tolist()
    if theta != _LEARNED[name]:
        case.problem("wrong: another theta than without the interruption")
    if left := [file for file in os.listdir(case.folder) if file.startswith(".")]:
        case.problem(f"left: {', '.join(left)}")


KILLS = {
    "recording": (recording, 110), "recording by agent": (recording_by_agent, 70), "sealing": (sealing, 90),
    "resuming": (resuming, 30), "repairing": (repairing, 40), "replacing": (replacing, 60),
    "extending": (extending, 40), "storing arrays": (storing, 70), "building a table": (tables, 60),
    "cleaning": (cleaning, 30),
}  # fmt: skip
DISKS = {"limit on files": (file_limit, 30), "small disk": (small_disk, 20)}
SIGNALS = {
    "record": (recorded_episodes, 20), "fit": (fitted, 12), "collect": (collected, 6), "learn": (learned, 2)
}  # fmt: skip
SLOW = ("learn",)  # in the full run alone
PARTS = {"kill": KILLS, "disk": DISKS, "signal": SIGNALS}
PER_ROUND = {"resuming": 3, "repairing": 3, "cleaning": 3, "record": 3, "fit": 2, "collect": 2, "learn": 2}


def run_round(name: str, seed: int, folder: Path) -> Found:
    """One case, by its name ``part/kind/number``."""
    part, kind, _ = name.split("/")
    fresh(folder)
    os.environ["HOME"] = str(folder)
    case = Round(random.Random(f"{seed} {name}"), folder)
    try:
        PARTS[part][kind][0](case)
    except Exception as error:
        case.problem(f"wrong: the case itself failed: {type(error).__name__}: {error}")
    shutil.rmtree(folder, ignore_errors=True)
    return case.found


def can_mount(folder: Path) -> bool:
    """Whether this user may mount a file system."""
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if done.returncode == 0:
        subprocess.run(["umount", "-l", str(folder)], check=False)
    return done.returncode == 0
