"""What a repair keeps, what it refuses to call good, and folders that are links to other places and disks."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from pendulum_data import recorded, resealed, stored

from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets import TransitionTable, load_dataset, repair, verify
from mpcoffline.datasets.store.manifest import MANIFEST
from mpcoffline.datasets.store.opening import DATA_FILE

ID = "test/set-v0"


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[Path]:
    """A folder on another file system than the store's."""
    if not os.path.isdir("/dev/shm") or os.stat("/dev/shm").st_dev == os.stat(tmp_path).st_dev:
        pytest.skip("one file system only")
    folder = Path(tempfile.mkdtemp(dir="/dev/shm"))
    yield folder
    shutil.rmtree(folder)


def _by_minari(infos: dict[str, Any] | None = None, **metadata: Any) -> None:
    """A data set as Minari's own tools write it, of two episodes of three steps."""
    columns: dict[str, Any] = {
        "observations": np.arange(8.0, dtype=np.float32).reshape(4, 2),
        "actions": np.zeros((3, 1), np.float32),
        "rewards": np.arange(3.0),
        "terminations": np.zeros(3, bool),
        "truncations": np.array([False, False, True]),
    }
    buffers = [EpisodeBuffer(**columns, infos=infos or {}, seed=seed, options={"a": {"b": 2}}) for seed in (3, 4)]
    made = minari.create_dataset_from_buffers(
        ID,
        buffers,
        observation_space=spaces.Box(-9, 9, (2,)),
        action_space=spaces.Box(-1, 1, (1,)),
        author="Ada",
        author_email="ada@example.org",
        code_permalink="https://example.org/code",
        algorithm_name="random",
        description="two episodes",
        **metadata,
    )
    made.storage.update_episode_metadata([{"note": "first"}, {"note": "second"}])


def test_an_intact_set_with_nested_infos_is_intact() -> None:
    _by_minari({"contact": {"left": np.zeros(4), "inner": {"right": np.ones((4, 2))}}})
    assert str(repair(ID)) == f"{ID}: intact, 2 episodes, 6 steps."


def test_all_that_can_be_read_is_kept(store: Path) -> None:
    infos = {"contact": {"left": np.arange(4.0), "inner": {"right": np.ones((4, 2))}}, "text": ["a", "b", "c", "d"]}
    _by_minari(infos, requirements=["numpy"])
    path = store / ID / "data" / "metadata.json"
    before = json.loads(path.read_text()) | {"own": {"key": [1, 2]}}
    path.write_text(json.dumps(before | {"total_steps": 5}))
    report = repair(ID)
    assert (report.action, report.steps, report.notes) == ("rebuilt", 6, ())
    after = json.loads(path.read_text())
    assert {key: after[key] for key in before if key != "dataset_size"} == {
        key: value for key, value in before.items() if key != "dataset_size"
    }
    with h5py.File(store / ID / "data" / DATA_FILE) as file:
        for number, (seed, note) in enumerate([(3, "first"), (4, "second")]):
            group = file[f"episode_{number}"]
            assert {key: group.attrs[key] for key in ("id", "seed", "options/a/b", "note")} == {
                "id": number,
                "seed": seed,
                "options/a/b": 2,
                "note": note,
            }
            np.testing.assert_array_equal(group["infos/contact/inner/right"], np.ones((4, 2)))
            assert list(group["infos/text"].asstr()) == infos["text"]
    assert load_dataset(ID).storage.metadata["author"] == {"Ada"}
    assert verify(ID).ok


def test_metadata_that_minari_cannot_read_are_left_out_and_told(store: Path) -> None:
    stored()
    path = store / ID / "data" / "metadata.json"
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"author": 5, "eval_env_spec": "{", "author_email": ["a"]})
    )
    report = repair(ID)
    assert {note.split(" ", 1)[0] for note in report.notes} == {"author", "eval_env_spec"}
    assert load_dataset(ID).storage.metadata["author_email"] == {"a"}


def test_dict_observations_are_kept(store: Path) -> None:
    from dataclasses import replace

    episodes = [
        replace(episode, observations={"a": np.asarray(episode.observations), "b": np.arange(6)})
        for episode in recorded(episodes=3)
    ]
    space = spaces.Dict({"a": spaces.Box(-9, 9, (3,)), "b": spaces.Discrete(6)})
    stored(episodes=episodes, observation_space=space, env_spec=None)
    assert repair(ID).action == "intact"
    with h5py.File(store / ID / "data" / DATA_FILE, "a") as file:
        del file["episode_1/observations/b"]
        file["episode_1/observations/b"] = np.arange(5)
    report = repair(ID)
    assert (report.episodes, "observations/b" in report.notes[0]) == (2, True)
    assert load_dataset(ID)[1].observations["b"].tolist() == list(range(6))


def _flip(store: Path) -> None:
    path = store / ID / "data" / DATA_FILE
    content = bytearray(path.read_bytes())
    content[content.index(np.float64(recorded()[0].rewards[2]).tobytes()) + 6] ^= 0x30
    path.write_bytes(content)


def test_changed_numbers_are_never_intact_and_never_sealed_in_silence(store: Path) -> None:
    stored()
    _flip(store)
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    with pytest.raises(FileFormatError, match="expected sha256"):
        repair(ID)
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before
    (store / ID / "data" / "metadata.json").unlink()
    report = repair(ID)
    assert report.action == "rebuilt"
    assert any(f"{DATA_FILE} is not what {MANIFEST} says: numbers" in note for note in report.notes)


def test_sums_that_cannot_be_read_leave_the_rest_to_be_repaired(store: Path) -> None:
    stored()
    (store / ID / "data" / "metadata.json").unlink()
    (store / ID / MANIFEST).unlink()
    (store / ID / MANIFEST).symlink_to(MANIFEST)  # to itself
    assert any(note.startswith("Whether numbers have changed is unknown") for note in repair(ID).notes)


def test_lost_metadata_over_sound_data_are_no_change_of_numbers(store: Path) -> None:
    stored()
    (store / ID / "data" / "metadata.json").unlink()
    assert not any(MANIFEST in note for note in repair(ID).notes)


def _rebuilt(store: Path) -> None:
    path = store / ID / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"total_steps": 1}))
    report = repair(ID)
    assert (report.action, report.steps) == ("rebuilt", 10)
    assert report.backup is not None
    assert json.loads((report.backup / "data" / "metadata.json").read_text())["total_steps"] == 1
    assert TransitionTable.from_minari(ID).rows.shape == (10, 9)


def test_a_namespace_on_another_disk(store: Path, elsewhere: Path) -> None:
    store.mkdir()
    (store / "test").symlink_to(elsewhere)
    stored()
    stored(overwrite=True, episodes=recorded(seed=5))
    assert load_dataset(ID).total_steps == 10
    _rebuilt(store)
    assert (store / "test").is_symlink()
    assert {path.name for path in elsewhere.iterdir()} == {"set-v0", "namespace_metadata.json"}
    assert not list(store.glob(".building*"))


@pytest.mark.parametrize("far", [False, True])
def test_a_data_set_whose_folder_is_a_link(store: Path, tmp_path: Path, far: bool, request: Any) -> None:
    place = (request.getfixturevalue("elsewhere") if far else tmp_path) / "real"
    stored()
    shutil.move(store / ID, place)
    (store / ID).symlink_to(place)
    stored(overwrite=True, episodes=recorded(seed=5))
    assert (store / ID).is_symlink()
    np.testing.assert_array_equal(load_dataset(ID)[0].actions, recorded(seed=5)[0].actions)
    _rebuilt(store)
    assert (store / ID).resolve() == place.resolve()
    assert not list(store.glob(".building*")) + list(place.parent.glob(".building*"))


def test_special_files_beside_the_data_do_not_stop_a_repair(store: Path) -> None:
    stored()
    os.mkfifo(store / ID / "fifo")
    _rebuilt(store)


def test_resealed_is_what_it_says(store: Path) -> None:
    stored()
    _flip(store)
    resealed()
    assert load_dataset(ID).total_steps == 10
