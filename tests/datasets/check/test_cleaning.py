"""What piles up is found and removed; what can be used, finished or repaired is not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import crashing
import numpy as np
import pytest
from crashing import recording
from filelock import FileLock
from typer.testing import CliRunner

from mpcoffline.cli.main import app
from mpcoffline.core import places
from mpcoffline.core.errors import UnknownIdError
from mpcoffline.datasets import clean, dataset_from_arrays, list_datasets, load_dataset
from mpcoffline.datasets.check.cleaning import Kind
from mpcoffline.datasets.recording import session as module_of_recording
from mpcoffline.datasets.recording.session import Recording
from mpcoffline.datasets.store.recording_lock import RecordingLock

SPACES = {"observation_space": crashing.SPACE, "action_space": crashing.ACTIONS}

pytestmark = pytest.mark.usefixtures("machine")


def episode(steps: int = 20) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(steps + 1, 3)), rng.uniform(-1, 1, size=(steps, 1)), rng.normal(size=steps)


STORING = """
import os, signal
import numpy as np
from mpcoffline.datasets.store import writing
from mpcoffline.datasets import dataset_from_arrays
writing.finish = lambda *arguments: os.kill(os.getpid(), signal.SIGKILL)
dataset_from_arrays("mine/plant/log-v0", [(np.zeros((21, 3)), np.zeros((20, 1)), np.zeros(20))])
"""


def test_what_a_killed_process_had_half_stored_goes_with_the_next(machine: Path) -> None:
    store = machine / "store"
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", STORING], env=os.environ, check=False)
        assert done.returncode == -signal.SIGKILL
    (left,) = store.glob(".building-*")  # the second removed what the first had left
    (found,) = clean(["leftovers"]).found
    assert found.path == left
    assert found.size > 0
    assert left.exists()
    dataset_from_arrays("mine/plant/log-v0", [episode()])
    assert not list(store.glob(".building-*"))
    assert not clean(["leftovers"]).found
    assert load_dataset("mine/plant/log-v0").total_steps == 20


def filled(machine: Path) -> dict[str, Path]:
    """Everything that there can be, by what it is."""
    dataset_from_arrays("mine/plant/log-v0", [episode()])
    store, solvers, tables = machine / "store", places.cache_folder("solvers"), places.cache_folder("tables")
    paths = {
        "data set": store / "mine" / "plant" / "log-v0",
        "recording": store / ".recording" / "mine" / "other-v0",
        "leftover": store / "mine" / ".building-old",
        "leftover table": tables / ".building-old",
        "solver": solvers / f"ddp-{'a' * 24}.so",
        "table": tables / ("b" * 40),
        "broken off": store / ".downloading" / "mine--first-v0",
        "going on": store / ".downloading" / "mine--second-v0",
        "backup": store / ".broken" / "mine" / "plant" / "log-v0-0",
    }
    for path in paths.values():
        if path.suffix != ".so":
            (path / "data").mkdir(parents=True, exist_ok=True)
            path = path / "data" / "file"
        path.write_bytes(bytes(50_000))
    (paths["recording"] / "env-0000.log").write_bytes(bytes(50_000))
    for name in ("leftover", "leftover table"):
        os.utime(paths[name], (0, 0))
    for name in ("broken off", "going on"):
        paths[name].with_name(paths[name].name + ".lock").touch()
    return paths


CAN_GO = {
    "leftovers": {"leftover", "leftover table"},
    "caches": {"solver", "table"},
    "downloads": {"broken off"},
    "backups": {"backup"},
}


@pytest.mark.parametrize(
    "kinds", [[], ["leftovers"], ["caches"], ["downloads"], ["backups"], ["downloads", "backups", "caches"]]
)
def test_only_what_is_named_goes_and_only_if_told_to(kinds: list[str], machine: Path) -> None:
    paths = filled(machine)
    named = set().union(*(CAN_GO[kind] for kind in kinds or ["leftovers", "caches"]))
    with FileLock(machine / "store" / ".downloading" / "mine--second-v0.lock"):
        looked = CliRunner().invoke(app, ["clean", *kinds])
        assert looked.exit_code == 0, looked.output
        assert all(path.exists() for path in paths.values())
        assert "Nothing was removed; to remove it, add --yes." in looked.stdout
        told = CliRunner().invoke(app, ["clean", *kinds, "--yes", "--json"])
    assert told.exit_code == 0, told.output
    found = json.loads(told.stdout)["found"]
    assert {each["path"] for each in found} == {str(paths[name]) for name in named}
    assert all(each["removed"] and each["size"] >= 50_000 for each in found)
    assert {name for name, path in paths.items() if not path.exists()} == named
    assert [row.id for row in list_datasets() if row.where == "local"] == ["mine/plant/log-v0"]


def test_a_download_that_goes_on_meanwhile_stays(machine: Path) -> None:
    going = filled(machine)["going on"]
    with FileLock(going.with_name(going.name + ".lock")):
        assert going not in {waste.path for waste in clean(["downloads"], remove_found=True).found}
    assert going.exists()


def test_the_report_says_what_and_how_much(machine: Path) -> None:
    assert str(clean()) == "Nothing to clean."
    filled(machine)
    report = clean()
    assert report.size == sum(waste.size for waste in report.found) >= 200_000
    assert report.freed == 0
    text = str(report)
    assert "leftovers (half-built things of killed processes: nobody reads them):" in text
    assert f"0.1 MB in 1 there: {machine}/cache/tables" in text
    assert clean(remove_found=True).freed == report.size


def test_another_kind_is_refused() -> None:
    with pytest.raises(UnknownIdError, match="leftovers"):
        clean(cast("list[Kind]", ["leftover"]))
    assert CliRunner().invoke(app, ["clean", "datasets"]).exit_code == 2


def test_folders_of_recordings_without_a_log_go_and_others_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    root = tmp_path / ".recording"
    (root / "killed" / "early-v0").mkdir(parents=True)
    (root / "killed" / "later-v0").mkdir()
    (root / "killed" / "later-v0" / "lock").touch()
    (root / "killed" / "header-v0").mkdir()
    (root / "killed" / "header-v0" / "env-0000.new").write_bytes(b"half a header")
    (root / "cut" / "set-v0").mkdir(parents=True)
    (root / "cut" / "set-v0" / "env-0000.log").write_bytes(b"episodes")
    held = RecordingLock("alive/set-v0")
    report = clean(["leftovers"])
    assert [waste.path for waste in report.found] == [root / "killed"]
    assert (root / "killed" / "early-v0").exists()
    clean(["leftovers"], remove_found=True)
    assert not (root / "killed").exists()
    assert (root / "cut" / "set-v0" / "env-0000.log").exists()
    held.release()
    clean(["leftovers"], remove_found=True)
    (root / "cut" / "set-v0" / "env-0000.log").unlink()
    clean(["leftovers"], remove_found=True)
    assert not root.exists()


def test_recordings_that_were_put_aside_are_backups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    kept = tmp_path / ".broken" / "cut" / "set-v0-recording-0"
    kept.mkdir(parents=True)
    (kept / "env-0000.log").write_bytes(b"episodes")
    assert [waste.path for waste in clean(["backups"]).found] == [kept]
    assert kept.exists()
    clean(["backups"], remove_found=True)
    assert not (tmp_path / ".broken").exists()


def test_logs_that_are_in_their_data_set_go(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed after the data set got its name and before the logs were removed; another recording's logs stay."""
    sealed, opened = recording(), Recording("test/open-v0", env_spec=None, **SPACES)
    for recorded in (sealed, opened):
        recorded.append(0, crashing.episode(0), complete=True)
    with monkeypatch.context() as patch:
        patch.setattr(module_of_recording, "remove_logs", interrupt)
        with pytest.raises(KeyboardInterrupt):
            sealed.seal()
    for recorded in (sealed, opened):
        recorded.close()
    root = machine / "store" / ".recording"
    (found,) = clean(["leftovers"]).found
    assert found.path == root / crashing.DATASET
    assert clean(["leftovers"], remove_found=True).found[0].removed
    assert not list(root.glob(f"{crashing.DATASET}/*.log"))
    assert len(list(root.glob("test/open-v0/*.log"))) == 1
    assert load_dataset(crashing.DATASET).total_episodes == 1


def interrupt(dataset_id: str) -> None:
    raise KeyboardInterrupt
