"""``tune``: a folder that is complete or not there, goes on after an interruption, and says what its policy is."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planted_logs import QUICK, heater, short_episodes, tanks
from typer.testing import CliRunner

from mpcoffline import FileFormatError, InvalidArgumentError, InvalidDataError, OfflineMPCLearner, StorageError
from mpcoffline.cli import app
from mpcoffline.datasets.table.files import hash_of, load_table
from mpcoffline.tune import Tuned, making, tune

pytest.importorskip("polars")

LOG = short_episodes(21)
FILES = {"report.html", "policy.zip", "learner.zip", "controller", "log.zip", "plant.json", "run.json"}


def tuned_in(folder: Path, log: Any = LOG, **options: Any) -> Tuned:
    plant = heater()
    return tune(plant, plant.read(log), folder / "tuned", **QUICK | options)


def names(folder: Path) -> set[str]:
    return {each.name for each in folder.iterdir()}


def test_the_folder_is_complete_and_says_what_it_holds(once: Tuned) -> None:
    assert names(once.folder) == FILES
    assert names(once.folder.parent) == {"tuned"}
    loaded, plant = Tuned.load(once.folder), heater()
    assert loaded.verdict == "recommend"
    assert loaded.document["policy"] == loaded.document["proposal"] == loaded.learner.candidates.chosen  # type: ignore[union-attr]
    assert hash_of(loaded.table) == hash_of(plant.read(LOG)) == loaded.document["sha256"]["log"]
    y = np.array([30.0, 20.0])
    assert loaded.policy.predict(y)[0] == pytest.approx(loaded.learner.policy.predict(y)[0])
    page = (once.folder / "report.html").read_text(encoding="utf-8")
    for words in (
        "<h1>heater</h1>",
        "What was read and found",
        "200 rows, 5 s apart",
        "parameters: the log determines",
    ):
        assert words in page
    text = str(loaded)
    assert text.startswith("Verdict: recommend\n")
    assert text.endswith(f"mpcoffline retune {once.folder} trial.csv")
    assert (once.folder / "controller" / "mpc_controller.c").is_file()


def test_the_commands_that_a_result_ends_with_are_taken_as_they_are(once: Tuned, tmp_path: Path) -> None:
    """What ``serve`` is told to do has a plant at its other end: here one that does not answer."""
    (line,) = (each for each in once.next_steps if "mpcoffline serve" in each)
    _, *words = shlex.split(line)
    words = ["127.0.0.1:9" if word == "HOST:PORT" else word for word in words]
    words[words.index("trial.csv")] = str(tmp_path / "trial.csv")
    done = CliRunner().invoke(app, [*words, "--periods", "2", "--period", "0.01"])
    assert done.exit_code == 0, done.output


def test_the_same_call_finds_its_result_and_the_same_run_gives_it_again(
    once: Tuned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tuned_in(tmp_path)
    for name in FILES - {"controller"}:
        assert (other.folder / name).read_bytes() == (once.folder / name).read_bytes(), name
    monkeypatch.setattr(making, "made", None)
    again = tuned_in(tmp_path)
    assert again.again
    assert again.document["sha256"] == other.document["sha256"]


def test_what_was_finished_is_used_again_after_an_interruption(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as now:
        now.setattr(making, "diagnose", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tuned_in(tmp_path)
    assert names(tmp_path) == {"tuned.unfinished"}
    with monkeypatch.context() as now:
        now.setattr(OfflineMPCLearner, "fit", interrupted)
        now.setattr("mpcoffline.tune.tuning.check_log", interrupted)
        told: list[str] = []
        assert tuned_in(tmp_path, tell=told.append).verdict == "recommend"
    assert told[0].startswith("Going on with ")
    assert names(tmp_path) == {"tuned"}
    assert names(tmp_path / "tuned") == FILES


def test_another_log_starts_anew_and_what_was_there_is_kept(
    once: Tuned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = Path(shutil.copytree(once.folder, tmp_path / "tuned"))
    assert once.document["policy"] != "MPC_1"
    policy = (place / "policy.zip").read_bytes()
    whole = making.diagnose

    def kept(*arguments: Any, **options: Any) -> Any:
        report = whole(*arguments, **options)
        return replace(report, judgement=replace(report.judgement, verdict="keep MPC_1"))

    monkeypatch.setattr(making, "diagnose", kept)
    second = tuned_in(tmp_path, short_episodes(4))
    assert second.former == place / "1"
    assert names(place / "1") == FILES
    assert (place / "1" / "policy.zip").read_bytes() == policy
    # The verdict is to keep MPC_1, so that is what the policy is.
    assert second.document["policy"] == "MPC_1"
    assert np.array_equal(second.policy.mpc.theta, heater().mpc().theta)
    assert "MPC_1, the controller of the plant file as it is" in str(second)


def test_what_contradicts_the_description_is_refused_before_any_fit(tmp_path: Path) -> None:
    with pytest.raises(InvalidDataError, match="a log and a description that fit together") as refusal:
        tune(tanks(), heater().read(LOG), tmp_path / "tuned", **QUICK)
    assert "mpcoffline check" in str(refusal.value)
    assert not (tmp_path / "tuned").exists()
    with pytest.raises(InvalidArgumentError, match="a number or a text"):
        tuned_in(tmp_path, value=object())


def test_a_folder_of_something_else_stays_as_it_is(tmp_path: Path) -> None:
    place = tmp_path / "tuned"
    place.mkdir()
    (place / "thesis.txt").write_text("mine")
    with pytest.raises(StorageError, match="Name another folder"):
        tuned_in(tmp_path)
    assert names(place) == {"thesis.txt"}


def test_a_damaged_table_is_refused(once: Tuned, tmp_path: Path) -> None:
    file = tmp_path / "log.zip"
    file.write_bytes((once.folder / "log.zip").read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"log.zip"):
        load_table(file)
    with pytest.raises(FileFormatError, match=r"a folder that tune has made, got no run.json in it"):
        Tuned.load(tmp_path)


def test_the_command_hands_on_in_which_share_limits_are_to_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, log = tmp_path / "heater.py", tmp_path / "log.csv"
    file.write_text("from planted_logs import heater\nplant = heater()\n")
    log.write_text("power,T,ambient\n" + "\n".join(f"{20 + 5 * (i % 7)},{30 + i % 5},20" for i in range(30)))
    given: list[dict[str, Any]] = []

    def stand_in(plant: Any, table: Any, out: Path, **options: Any) -> Tuned:
        given.append(options)
        raise InvalidArgumentError("stand-in", expected="no more", actual="enough")

    monkeypatch.setattr("mpcoffline.tune.tune", stand_in)
    command = ["tune", str(file), str(log)]
    assert CliRunner().invoke(app, command).exit_code == 1
    assert CliRunner().invoke(app, [*command, "--keep-limits", "0.95"]).exit_code == 1
    assert CliRunner().invoke(app, [*command, "--keep-limits", "1.5"]).exit_code == 2
    assert [options.get("keep_limits") for options in given] == [None, 0.95]


def test_the_command_tells_what_it_does_and_ends_with_what_to_do(
    once: Tuned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, log = tmp_path / "heater.py", tmp_path / "log.csv"
    file.write_text("from planted_logs import heater\nplant = heater()\n")
    log.write_text("power,T,ambient\n" + "\n".join(f"{20 + 5 * (i % 7)},{30 + i % 5},20" for i in range(30)))
    given: dict[str, Any] = {}
    now = [0.0]

    def stand_in(plant: Any, table: Any, out: Path, **options: Any) -> Tuned:
        given.update(options, rows=len(table))
        options["tell"]("Fitting")
        now[0] += 61.0
        return Tuned.load(once.folder)

    monkeypatch.setattr("mpcoffline.core.progress.monotonic", lambda: now[0])

    monkeypatch.setattr("mpcoffline.tune.tune", stand_in)
    result = CliRunner().invoke(app, ["tune", str(file), str(log), "--preset", "best", "--seed", "3"])
    assert result.exit_code == 0, result.output
    assert result.stderr.startswith("Reading log.csv\n29 control intervals of 5 s")
    assert result.stderr.endswith("\nFitting\nFitting (61 s, 61 s in all)\n")  # no terminal: plain lines
    assert result.stderr.replace("\n", "").isprintable()
    assert result.stdout.startswith("Verdict: recommend\n")
    assert (given["preset"], given["seed"], given["rows"]) == ("best", 3, 29)
    document = json.loads(CliRunner().invoke(app, ["tune", str(file), str(log), "--json"]).stdout)
    assert document["verdict"] == "recommend"
    assert document["folder"] == str(once.folder)
