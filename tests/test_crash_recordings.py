"""scripts/crash_recordings: what is lost, stored twice or mixed is seen, and promises outlive their process."""

from __future__ import annotations

import faulthandler
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import pytest

from mpcoffline.core.errors import StorageError
from mpcoffline.datasets import dataset_from_arrays

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "crash_recordings"


@pytest.fixture
def robustness(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], Any]:
    """Modules of the package that the scripts share, and an empty store."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for key in ("MINARI_DATASETS_PATH", "MPCOFFLINE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.setenv(key, str(tmp_path / key.lower()))
        (tmp_path / key.lower()).mkdir()
    return lambda name: import_module(f"robustness.{name}")


def stored(recordings: Any, serials: Any) -> Path:
    """The HDF5 file of a data set of these episodes."""
    dataset_from_arrays(recordings.ID, recordings.arrays_of(serials), overwrite=True)
    return Path(os.environ["MINARI_DATASETS_PATH"]) / recordings.ID / "data" / "main_data.hdf5"


def test_an_honest_set_is_right(robustness: Any) -> None:
    recordings = robustness("recordings")
    stored(recordings, range(20_000, 20_012))
    found = recordings.check_set(range(20_000, 20_012), allowed=set(range(20_000, 20_012)))
    assert (found.promised, found.stored, found.problems) == (12, 12, [])
    assert recordings.leftovers() == []


def test_what_is_lost_twice_or_foreign_is_seen(robustness: Any) -> None:
    recordings = robustness("recordings")
    stored(recordings, [20_000, 20_001, 20_001, 20_003])
    problems = recordings.check_set(range(20_000, 20_003), allowed={20_000, 20_001, 20_002}).problems
    assert problems == [
        "lost: 1 of 3 promised episodes, the first 20002",
        "duplicated: 1 episodes",
        "mixed: 1 episodes of another recording",
    ]
    stored(recordings, [20_001, 20_000])
    assert recordings.check_set([]).problems == ["mixed: the episodes of environment 10 are out of order"]
    shutil.rmtree(os.environ["MINARI_DATASETS_PATH"])
    assert recordings.check_set([20_000]).problems == ["lost: all 1 episodes, there is no data set"]
    assert recordings.check_set([]).problems == []


@pytest.mark.parametrize("column", ["rewards", "actions", "observations", "terminations"])
def test_a_number_of_another_episode_is_seen(robustness: Any, column: str) -> None:
    recordings = robustness("recordings")
    serial = next(serial for serial in range(20_000, 20_100) if recordings.length_of(serial) > 4)
    path = stored(recordings, [serial, serial + 1])
    with h5py.File(path, "r+") as file:
        values = file["episode_0"][column]
        values[1] = 1 - values[1] if column == "terminations" else values[1] + 1
    (problem,) = recordings.check_set([serial + 1]).problems
    assert problem.startswith("mixed: episode 0: ")


def test_counts_of_the_metadata_are_compared(robustness: Any) -> None:
    recordings = robustness("recordings")
    path = stored(recordings, range(20_000, 20_003)).with_name("metadata.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"total_episodes": 2}))
    assert recordings.check_set([]).problems == ["wrong: 2 episodes in the metadata, 3 stored"]


def test_promises_outlive_a_killed_process(robustness: Any, tmp_path: Path) -> None:
    recordings, rounds = robustness("recordings"), robustness("rounds")
    recordings.PROMISES.renew()

    def job() -> None:
        recordings.PROMISES.add(20_001)
        recordings.PROMISES.say(b"s")
        os.kill(os.getpid(), signal.SIGKILL)

    case = rounds.Round(random.Random(0), tmp_path)
    ended = case.run(job)
    assert os.WTERMSIG(ended.code) == signal.SIGKILL
    assert (list(recordings.PROMISES), recordings.PROMISES.said) == ([20_001], b"s")
    assert case.found.problems == []


def test_crashes_and_raw_errors_are_problems_and_errors_of_ours_are_not(robustness: Any, tmp_path: Path) -> None:
    rounds = robustness("rounds")

    def raw() -> None:
        raise ValueError("raw")

    def ours() -> None:
        raise StorageError("file x", expected="to be written", actual="No space left on device")

    def aborted() -> None:
        faulthandler.disable()  # which would write the child's stack between the tests' lines
        os.abort()

    case = rounds.Round(random.Random(0), tmp_path)
    assert case.run(ours).error == "StorageError: file x: expected to be written, got No space left on device."
    assert case.found.problems == []
    case.run(raw)
    case.run(aborted)
    assert case.found.problems == ["raw error: ValueError: raw", "crash: SIGABRT"]


def test_a_process_is_killed_at_any_moment(robustness: Any, tmp_path: Path) -> None:
    recordings, rounds = robustness("recordings"), robustness("rounds")

    def job() -> None:
        recordings.PROMISES.say(b"s")
        while True:
            len("a call of a C function")

    for seed in range(6):
        recordings.PROMISES.renew()
        case = rounds.Round(random.Random(seed), tmp_path)
        ended = case.killed(job, b"s", within=0.01)
        assert os.WTERMSIG(ended.code) == signal.SIGKILL
        assert case.found.problems == []


def test_leftovers_are_seen(robustness: Any) -> None:
    recordings, rounds = robustness("recordings"), robustness("rounds")
    for place in (".recording/x", ".building-1", ".broken/kept"):
        (recordings.store() / place).mkdir(parents=True)
    assert recordings.leftovers() == [".building-1 (empty)", ".recording (x)"]
    case = rounds.Round(random.Random(0), recordings.store().parent)
    case.swept()
    assert (recordings.leftovers(), case.found.problems) == ([], [])


def test_help(tmp_path: Path) -> None:
    done = subprocess.run([SCRIPT, "--help"], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "scripts/crash_recordings [--full] [--only NAME ...]" in done.stdout


@pytest.mark.slow
def test_some_interruptions(tmp_path: Path) -> None:
    names = ["kill/recording/0", "kill/sealing/0", "signal/record/0"]
    done = subprocess.run(
        [SCRIPT, "--workers", "1", "--out", str(tmp_path / "page.md"), "--only", *names],
        capture_output=True, text=True, timeout=600, cwd=tmp_path,
    )  # fmt: skip
    rows = [line.split(" | ") for line in done.stdout.splitlines() if line.startswith(("| kill/", "| signal/"))]
    assert [row[0] for row in rows] == ["| kill/recording", "| kill/sealing", "| signal/record"], done.stderr
    assert all(row[4:10] == ["0"] * 6 for row in rows), done.stdout  # lost to raw errors
    assert not (tmp_path / "page.md").exists()
