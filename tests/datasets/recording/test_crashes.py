"""Killed processes, full disks, two recorders, and what Minari leaves broken."""

from __future__ import annotations

import gc
import itertools
import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from crashing import DATASET, check_survivors, count_calls, episode, kill_at_call, recording, run_and_kill

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, StorageError, UnknownIdError
from mpcoffline.datasets import load_dataset, repair
from mpcoffline.datasets.recording.episode_log import scan
from mpcoffline.datasets.recording.session import seal
from mpcoffline.datasets.store.manifest import read_manifest, sha256_of, write_manifest
from mpcoffline.datasets.store.recording_lock import log_files


def record(
    episodes: int = 6, start: int = 0, say: Callable[[str], None] = lambda letter: None, **settings: Any
) -> None:
    """Two environments in turns, then the data set."""
    recorded = recording(**settings)
    for number in range(start, start + episodes):
        recorded.append(number % 2, episode(number), complete=True)
        say("e")
    say("s")
    recorded.seal()
    say("d")


def until_closed(pipe: int) -> str:
    said = ""
    while part := os.read(pipe, 100):
        said += part.decode()
    return said


def test_sealing_gives_the_episodes_in_the_order_in_which_they_ended(store: Path) -> None:
    record(7)
    assert check_survivors(7) == 7
    folder = store / DATASET
    sums = read_manifest(folder)
    assert set(sums) == {"data/main_data.hdf5", "data/metadata.json"}
    assert all(sha256_of(folder / name) == digest for name, digest in sums.items())
    assert not list(store.glob(".*"))
    assert minari.load_dataset(DATASET).recover_environment().spec.id == "mpcoffline/PendulumSwingUp-v0"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_killed_at_any_moment_of_recording_or_sealing(seed: int, store: Path) -> None:
    calls = count_calls(lambda: record(sync_episodes=2))
    for path in sorted(store.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    moment = int(np.random.default_rng(seed).integers(1, calls))

    def job(say: Callable[[str], None]) -> None:
        kill_at_call(moment)
        record(say=say, sync_episodes=2)

    said, ended = run_and_kill(job, until_closed)
    assert not ended
    assert "d" not in said
    survivors = check_survivors(said.count("e"))
    assert survivors >= 6 or "s" not in said


@pytest.mark.slow
def test_killed_while_sealing_twice_and_while_extending() -> None:
    record(4)
    calls = count_calls(lambda: seal_interrupted())
    for moment in np.random.default_rng(0).integers(1, calls, size=8):
        before = minari.load_dataset(DATASET).total_episodes
        recorded = recording(mode="extend")
        recorded.append(0, episode(before), complete=True)
        recorded.close()
        for _ in range(2):

            def job(say: Callable[[str], None], moment: int = int(moment)) -> None:
                kill_at_call(moment)
                seal(DATASET)

            run_and_kill(job, until_closed)
        assert check_survivors(before + 1) == before + 1


def seal_interrupted() -> None:
    recorded = recording(mode="extend")
    recorded.append(0, episode(4), complete=True)
    recorded.close()
    seal(DATASET)


def test_a_terminated_process_loses_nothing() -> None:
    def job(say: Callable[[str], None]) -> None:
        recorded = recording()
        for number in range(3):
            recorded.append(0, episode(number), complete=True)
            say("e")
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()

    said, _ = run_and_kill(job, until_closed)
    assert said == "eee"
    assert check_survivors(3) == 3


def test_an_interrupted_recording_goes_on() -> None:
    first = recording()
    first.append(0, episode(0), complete=True)
    first.append(1, episode(1), complete=True)
    first.close()
    torn = log_files(DATASET)[1]
    with torn.open("ab") as file:
        file.write(torn.read_bytes()[-60:-5])
    second = recording()
    assert second.resumed == 2
    second.append(1, episode(2), complete=True)
    second.append(2, episode(3), complete=True)
    second.seal()
    assert check_survivors(4) == 4


def test_resuming_can_be_declined_and_needs_the_same_spaces(store: Path) -> None:
    first = recording()
    first.append(0, episode(5), complete=True)
    first.close()
    with pytest.raises(InvalidArgumentError, match=r"action space: .*interrupted recording.*datasets repair"):
        recording(action_space=minari_space(3.0))
    assert len(log_files(DATASET)) == 1
    second = recording(resume=False)
    assert second.resumed == 0
    second.append(0, episode(0), complete=True)
    second.seal()
    assert check_survivors(1) == 1


def minari_space(high: float) -> Any:
    from gymnasium import spaces

    return spaces.Box(-high, high, (1,), np.float32)


def test_two_recorders_on_one_data_set() -> None:
    first = recording()
    first.append(0, episode(0), complete=True)
    with pytest.raises(InvalidArgumentError, match=rf"expected one recorder at a time.*process {os.getpid()}"):
        recording()
    with pytest.raises(InvalidArgumentError, match="one recorder at a time"):
        repair(DATASET)

    def job(say: Callable[[str], None]) -> None:
        try:
            recording()
        except InvalidArgumentError:
            say("r")

    assert run_and_kill(job, until_closed)[0] == "r"
    first.append(0, episode(1), complete=True)
    first.seal()
    assert check_survivors(2) == 2


def test_a_forgotten_recorder_gives_its_lock_back() -> None:
    first = recording()
    first.append(0, episode(0), complete=True)
    del first
    gc.collect()
    assert check_survivors(1) == 1


def test_nothing_recorded_leaves_nothing(store: Path) -> None:
    with pytest.raises(InvalidArgumentError, match="at least one transition"):
        recording().seal()
    assert not list(store.glob(".*"))
    with pytest.raises(UnknownIdError):
        repair(DATASET)


def test_another_data_set_of_that_id_is_not_replaced() -> None:
    record(2)
    with pytest.raises(InvalidArgumentError, match="exists"):
        recording()
    assert check_survivors(2) == 2
    other = recording(mode="replace")
    other.append(0, episode(0), complete=True)
    other.close()
    with pytest.raises(InvalidArgumentError, match="exists"):
        recording()
    assert minari.load_dataset(DATASET).total_episodes == 2
    assert check_survivors(1) == 1


@pytest.fixture
def small_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A store on a file system of 256 KiB."""
    path = tmp_path / "disk"
    path.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(path)], capture_output=True)
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.decode().strip()}")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(path))
    yield path
    gc.collect()
    subprocess.run(["umount", "-l", str(path)], check=True)


def record_for_ever(recorded: Any) -> None:
    for number in itertools.count():
        recorded.append(0, episode(number), complete=True)


@pytest.mark.slow
def test_a_full_disk_while_recording(small_disk: Path) -> None:
    recorded = recording()
    with pytest.raises(StorageError, match=r"env-0000.log: expected to be written.*No space left.*Free some space"):
        record_for_ever(recorded)
    recorded.close()
    written = len(scan(log_files(DATASET)[0]).records)
    assert written > 100
    # There is no room for a data set beside the log either: that is said, and the log stays.
    with pytest.raises(StorageError, match="No space left"):
        repair(DATASET)
    assert len(log_files(DATASET)) == 1
    assert not (small_disk / DATASET).exists()
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    assert check_survivors(written) == written


def test_an_empty_metadata_file_is_rebuilt(store: Path) -> None:
    record(3)
    data = store / DATASET / "data"
    (data / "metadata.json").write_text("")
    with pytest.raises(FileFormatError, match=f"datasets repair {DATASET}"):
        load_dataset(DATASET)
    report = repair(DATASET, env_spec=None)
    assert (report.action, report.episodes, report.steps) == ("rebuilt", 3, 15)
    assert any("unbounded Box" in note for note in report.notes)
    assert any("env_spec" in note for note in report.notes)
    assert report.backup is not None
    assert (report.backup / "data" / "metadata.json").read_text() == ""
    assert str(report.backup) in str(report)
    dataset = minari.load_dataset(DATASET)
    assert dataset.observation_space.shape == (2,)
    assert check_survivors(3) == 3
    assert repair(DATASET).action == "intact"


def test_a_half_written_episode_is_left_out(store: Path) -> None:
    record(4)
    path = store / DATASET / "data" / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        del file["episode_3/rewards"]
        file["episode_3"]["rewards"] = np.zeros(2)
    report = repair(DATASET)
    assert (report.action, report.episodes) == ("rebuilt", 3)
    unequal, changed = report.notes
    assert unequal == (
        "episode_3 is left out: unequal lengths of observations, actions, terminations, truncations, infos/cost."
    )
    assert "main_data.hdf5 is not what SHA256SUMS says: numbers in the episodes that are kept may be wrong" in changed
    assert minari.load_dataset(DATASET).recover_environment().spec.id == "mpcoffline/PendulumSwingUp-v0"
    assert check_survivors(3) == 3


def test_counts_that_do_not_fit_are_put_right(store: Path) -> None:
    record(3)
    path = store / DATASET / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps(metadata | {"total_episodes": 1}))
    assert minari.load_dataset(DATASET).total_episodes == 1
    assert repair(DATASET).action == "rebuilt"
    assert check_survivors(3) == 3


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_an_unreadable_hdf5_file_is_refused_and_left_alone(store: Path, damage: str) -> None:
    record(3)
    path = store / DATASET / "data" / "main_data.hdf5"
    content = bytearray(path.read_bytes())
    content[3] ^= 64
    path.write_bytes(content if damage == "flipped" else content[1000:3000])
    before = {p: p.read_bytes() for p in store.rglob("*") if p.is_file()}
    with pytest.raises(
        FileFormatError, match=r"main_data.hdf5: expected an HDF5 file that can be opened.*nothing was changed"
    ):
        repair(DATASET)
    assert {p: p.read_bytes() for p in store.rglob("*") if p.is_file()} == before


def test_the_other_metadata_that_cannot_be_loaded(store: Path) -> None:
    record(2)
    path = store / DATASET / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps(metadata | {"minari_version": "0.1.0"}))
    write_manifest(store / DATASET)
    with pytest.raises(FileFormatError, match=r"does not support the dataset generated by Minari 0.1.0"):
        load_dataset(DATASET)
    spec = json.loads(metadata["env_spec"]) | {"entry_point": "no_such_module:Env", "id": "NoSuch-v0"}
    lost = {key: value for key, value in metadata.items() if key not in ("observation_space", "action_space")}
    path.write_text(json.dumps(lost | {"env_spec": json.dumps(spec)}))
    with pytest.raises(FileFormatError, match=f"{path}: expected a stored observation_space, got none"):
        load_dataset(DATASET)


def test_the_report_is_for_the_command_line() -> None:
    record(1)
    assert str(repair(DATASET)) == f"{DATASET}: intact, 1 episodes, 5 steps."
    with pytest.raises(UnknownIdError, match="Did you mean"):
        repair("test/crush-v0")
    with pytest.raises(InvalidArgumentError, match=r"\(namespace/\)\*name-vN"):
        repair("../x-v0")
