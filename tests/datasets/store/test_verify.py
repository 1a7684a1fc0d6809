"""Each kind of damage is found, with its episode and step; an intact data set passes."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from pendulum_data import recorded, stored
from rich.console import Console

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.datasets.store.manifest import MANIFEST, write_manifest
from mpcoffline.datasets.store.verification import verify


def hdf5_of(store: Path) -> Path:
    return store / "test" / "set-v0" / "data" / "main_data.hdf5"


@pytest.mark.parametrize("with_manifest", [False, True])
def test_an_intact_data_set_passes(store: Path, with_manifest: bool) -> None:
    dataset = stored(episodes=recorded(episodes=3, terminate=True))
    (store / "test" / "set-v0" / MANIFEST).unlink(missing_ok=True)
    if with_manifest:
        write_manifest(store / "test" / "set-v0")
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    for given in ("test/set-v0", dataset):
        report = verify(given)
        assert report.ok
        assert report.findings == ()
        assert (report.dataset_id, report.episodes, report.steps) == ("test/set-v0", 3, 15)
        assert report.hashed is with_manifest
        assert str(report).startswith("test/set-v0: ok (3 episodes, 15 steps")
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_a_shipped_data_set_passes() -> None:
    report = verify("mpcoffline/pendulum/ddpg-v0")
    assert (report.ok, report.findings, report.episodes, report.steps) == (True, (), 500, 50_000)


Change = Callable[[EpisodeBuffer], EpisodeBuffer]


def _set(column: str, row: int, value: Any) -> Change:
    def change(buffer: EpisodeBuffer) -> EpisodeBuffer:
        holder: Any = buffer.infos if column.startswith("infos/") else vars(buffer)
        holder[column.removeprefix("infos/")][row] = value
        return buffer

    return change


def _cut(column: str) -> Change:
    return lambda buffer: replace(buffer, **{column: getattr(buffer, column)[:-1]})


def _scaled_rewards(buffer: EpisodeBuffer) -> EpisodeBuffer:
    return replace(buffer, rewards=0.001 * np.asarray(buffer.rewards))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "check", "step", "message"),
    [
        (_set("observations", 2, np.nan), "finite", 2, "observations: .* in 1 rows"),
        (_set("actions", 1, np.inf), "finite", 1, "actions"),
        (_set("rewards", 4, np.nan), "finite", 4, "rewards"),
        (_set("infos/state", 5, np.nan), "finite", 5, "infos/state"),
        (_set("actions", 3, 2.5), "bounds", 3, r"actions\[0\]: expected -2 to 2, got 2.5"),
        (_cut("observations"), "alignment", None, r"observations: expected shape \(6, 3\) .* got \(5, 3\)"),
        (_cut("actions"), "alignment", None, r"actions: expected shape \(5, 1\) .* got \(4, 1\)"),
        (_cut("terminations"), "alignment", None, "terminations"),
        (_set("terminations", 1, True), "ends", 1, "last step 4 only"),
        (_set("truncations", -1, False), "ends", 4, "got neither"),
        (_set("rewards", 2, 1.0), "cost", 2, "rewards: expected -infos/cost"),
        (_scaled_rewards, "cost", 0, r"\(5 such rows\)"),
    ],
)
def test_what_is_wrong_in_an_episode_is_found(change: Change, check: str, step: int | None, message: str) -> None:
    episodes = recorded(episodes=3)
    episodes[1] = change(episodes[1])
    report = verify(stored(episodes=episodes))
    assert not report.ok
    first = report.findings[0]
    assert (first.check, first.episode, first.step) == (check, 1, step)
    assert {finding.episode for finding in report.findings} == {1}
    assert re.search(message, first.message), first.message
    assert f"error: {check}: episode 1" in str(report)


def test_an_unknown_start_and_observations_outside_are_notes() -> None:
    episodes = recorded()
    for key in ("cost", "state"):
        episodes[0].infos[key][0] = np.nan  # type: ignore[index]
    episodes[1].observations[3] = 1e6  # type: ignore[index]
    report = verify(stored(episodes=episodes))
    assert report.ok
    assert [(f.check, f.episode, f.step) for f in report.findings] == [
        ("finite", 0, 0),
        ("finite", 0, 0),
        ("bounds", 1, 3),
    ]
    assert "ok, 3 notes" in report.headline


def test_data_without_costs_or_with_other_spaces_pass(store: Path) -> None:
    episodes = [replace(episode, infos={}) for episode in recorded()]
    assert verify(stored("test/plain-v0", episodes=episodes)).ok
    moves: Any = np.array([1, 0, 2, 1, 0])
    episodes = [replace(episode, actions=moves) for episode in episodes]
    assert verify(stored("test/discrete-v0", episodes=episodes, action_space=spaces.Discrete(3), env_spec=None)).ok


@pytest.mark.parametrize("target", ["data/main_data.hdf5", "data/metadata.json", MANIFEST])
def test_a_flipped_bit_is_found(store: Path, target: str) -> None:
    stored(description="a test")
    folder = store / "test" / "set-v0"
    write_manifest(folder)
    content = bytearray((folder / target).read_bytes())
    place = content.index(b"a test") if target.endswith("json") else len(content) // 2
    content[place] ^= 1
    (folder / target).write_bytes(content)
    report = verify("test/set-v0")
    assert not report.ok
    assert any(finding.check == "hash" for finding in report.findings)


def test_a_truncated_file_is_a_finding(store: Path) -> None:
    stored()
    content = hdf5_of(store).read_bytes()
    for length in (0, 100, len(content) // 2, len(content) - 1):
        hdf5_of(store).write_bytes(content[:length])
        report = verify("test/set-v0")
        assert not report.ok
        assert report.findings[0].check == "structure"
        assert report.steps == 0


@pytest.mark.parametrize("seed", range(5))
def test_flipped_bytes_never_crash_it(store: Path, seed: int) -> None:
    stored()
    rng = np.random.default_rng(seed)
    original = hdf5_of(store).read_bytes()
    for _ in range(10):
        content = bytearray(original)
        for place in rng.integers(len(content), size=8):
            content[place] ^= 1 << int(rng.integers(8))
        hdf5_of(store).write_bytes(content)
        str(verify("test/set-v0"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda metadata: metadata.update(minari_version="0.1.0"), "does not support the dataset generated by Minari"),
        (lambda metadata: metadata.update(total_episodes=7), "episode_0 to episode_6"),
        (lambda metadata: metadata.update(total_steps=11), "metadata's 11 steps, got 10"),
        (lambda metadata: metadata.update(dataset_id="test/other-v0"), "id of its folder, got 'test/other-v0'"),
        (lambda metadata: metadata.pop("dataset_id"), "complete Minari data set"),
        (lambda metadata: metadata.pop("action_space"), "stored action_space.*would import"),
        (lambda metadata: metadata.update(action_space="{}"), "complete Minari data set"),
        (lambda metadata: metadata.clear(), "stored observation_space"),
    ],
)
def test_wrong_metadata_are_a_finding(store: Path, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    stored()
    path = hdf5_of(store).with_name("metadata.json")
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))
    report = verify("test/set-v0")
    assert not report.ok
    assert re.search(message, str(report)), str(report)


@pytest.mark.parametrize("content", ["", "{", "[]", "null"])
def test_broken_metadata_are_a_finding(store: Path, content: str) -> None:
    stored()
    hdf5_of(store).with_name("metadata.json").write_text(content)
    report = verify("test/set-v0")
    assert [finding.check for finding in report.findings if finding.check != "hash"] == ["structure"]


def test_odd_groups_ids_and_links_are_found(store: Path, tmp_path: Path) -> None:
    stored(episodes=recorded(episodes=4))
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["values"] = np.zeros(5)
    with h5py.File(hdf5_of(store), "a") as file:
        file["episode_1"].attrs["id"] = 0
        del file["episode_2/rewards"]
        file["episode_2/rewards"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "values")
        file.move("episode_3", "episode_9")
    lines = str(verify("test/set-v0"))
    assert "missing or odd: episode_3, episode_9" in lines
    assert "episode 1: expected an episode id of its own, got 0 as in episode_0" in lines
    assert "/episode_2/rewards: expected data in this file, got a link" in lines
    assert "episode 3: unreadable" in lines


def test_unknown_and_malformed_ids_are_refused() -> None:
    with pytest.raises(UnknownIdError, match="data set id"):
        verify("test/nothing-v0")
    with pytest.raises(InvalidArgumentError, match="namespace"):
        verify("test/nothing")


def test_many_findings_are_counted(store: Path) -> None:
    episodes = recorded(episodes=30)
    for episode in episodes:
        _set("actions", 0, 9.0)(episode)
    report = verify(stored(episodes=episodes))
    assert len(report.findings) == 30
    assert str(report).endswith("... and 10 more")
    console = Console(width=120, record=True)
    console.print(report)
    assert "30 errors" in console.export_text()
