"""Loading by id: local, shipped, unknown, damaged; the shipped data against the environments."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from pendulum_data import recorded, stored

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError, UnknownIdError
from mpcoffline.datasets import TransitionTable, list_datasets, load_dataset
from mpcoffline.datasets.recipes import Recipe, catalog_file, recorded_tasks
from mpcoffline.datasets.store import local
from mpcoffline.datasets.store.local import shipped_datasets
from mpcoffline.datasets.store.packed import pack, packed_size, unpack
from mpcoffline.datasets.store.writing import write_dataset
from mpcoffline.envs import ControlTask

SHIPPED = sorted(f"mpcoffline/{task}/ddpg-v0" for task in recorded_tasks())


@pytest.mark.slow
@pytest.mark.parametrize("task_name", recorded_tasks())
def test_shipped_data_are_episodes_that_the_environment_repeats(task_name: str) -> None:
    recipe = Recipe.load(task_name)
    load_dataset(recipe.dataset_id)
    dataset = minari.load_dataset(recipe.dataset_id)  # Minari alone reads it from now on
    n_episodes = recipe.steps // 100
    assert (dataset.total_episodes, dataset.total_steps) == (n_episodes, recipe.steps)
    env = dataset.recover_environment()
    assert env.spec is not None
    assert env.spec.id == recipe.env_id
    assert env.spec.max_episode_steps == 100
    for episode in dataset.iterate_episodes([0, 1, n_episodes // 2, n_episodes - 1]):
        observation, _ = env.reset(options={"state": episode.infos["state"][0]})
        np.testing.assert_allclose(episode.observations[0], observation, rtol=1e-6)
        for k in range(100):
            # One step from the recorded state: errors do not pile up, so this holds on any machine.
            env.reset(options={"state": episode.infos["state"][k]})
            observation, reward, terminated, _, info = env.step(episode.actions[k])
            scale = 1.0 + np.abs(info["state"])
            difference = episode.infos["state"][k + 1] - info["state"]
            assert (np.abs(difference) <= 1e-12 * scale).all()
            np.testing.assert_allclose(episode.observations[k + 1], observation, rtol=1e-6, atol=1e-7)
            assert abs(episode.rewards[k] - reward) <= 1e-12 * (1.0 + abs(reward))
            assert episode.infos["cost"][k + 1, 0] == -episode.rewards[k]
            assert not terminated
        assert not episode.terminations.any()
        assert list(episode.truncations) == [False] * 99 + [True]
    # The agent learned: the last tenth of its training against the first, exploration included.
    costs = -np.array([episode.rewards.sum() for episode in dataset.iterate_episodes()])
    tenth = n_episodes // 10
    assert np.median(costs[-tenth:]) < 0.6 * np.median(costs[:tenth])
    table = TransitionTable.from_minari(dataset)
    task = env.unwrapped
    assert isinstance(task, ControlTask)
    assert (table.n_episodes, len(table)) == (n_episodes, recipe.steps)
    assert table.costs.min() >= 0.0
    table.check_fits(
        *task.observation_space.shape, *task.action_space.shape, task.action_space.low, task.action_space.high
    )


def test_checksums_are_those_of_the_files() -> None:
    lines = catalog_file("SHA256SUMS").read_text(encoding="utf-8").splitlines()
    listed = {name: digest for digest, name in (line.split("  ") for line in lines)}
    assert (
        set(listed)
        == {f"{task}.h5" for task in shipped_datasets().values()}
        == {f"{task}.h5" for task in recorded_tasks()}
    )
    for name, digest in listed.items():
        content = catalog_file(name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == digest
        assert len(content) < 2e6


def test_a_shipped_file_that_is_not_the_one_shipped_is_refused(
    tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SHA256SUMS", "pendulum.h5"):
        (tmp_path / name).write_bytes(catalog_file(name).read_bytes())
    content = bytearray((tmp_path / "pendulum.h5").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "pendulum.h5").write_bytes(content)
    monkeypatch.setattr(local, "catalog_file", lambda name, task=None: tmp_path / name)
    with pytest.raises(FileFormatError, match=r"pendulum.h5: expected sha256 .* Reinstall"):
        load_dataset("mpcoffline/pendulum/ddpg-v0")
    assert not [path for path in store.rglob("*") if path.is_file()]


@pytest.mark.slow
def test_two_that_materialise_at_once_both_get_it(store: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        sets = list(pool.map(load_dataset, ["mpcoffline/pendulum/ddpg-v0"] * 2))
    assert [dataset.total_steps for dataset in sets] == [50_000, 50_000]
    assert not list(store.glob(".*"))


@pytest.mark.slow
def test_listing_says_where_data_sets_are() -> None:
    rows = {row.id: row for row in list_datasets()}
    assert sorted(rows) == SHIPPED
    assert {row.where for row in rows.values()} == {"shipped"}
    stored("test/mine-v0")
    load_dataset("mpcoffline/pendulum/ddpg-v0")
    rows = {row.id: row for row in list_datasets()}
    assert (rows["test/mine-v0"].where, rows["test/mine-v0"].episodes, rows["test/mine-v0"].steps) == ("local", 2, 10)
    assert rows["mpcoffline/pendulum/ddpg-v0"].where == "local"
    for recipe in map(Recipe.load, recorded_tasks()):
        row = rows[recipe.dataset_id]
        assert (row.episodes, row.steps) == (recipe.steps // 100, recipe.steps)


@pytest.mark.parametrize(
    ("dataset_id", "nearest"),
    [
        ("mpcoffline/pendulum/dpg-v0", "mpcoffline/pendulum/ddpg-v0"),
        ("mpcoffline/cartpole/ddpg", "mpcoffline/cartpole/ddpg-v0"),
        ("mpcoffline/linear/ddpg-v0.1", "mpcoffline/linear/ddpg-v0"),
        ("test/mine-v1", "test/mine-v0"),
    ],
)
def test_an_unknown_id_names_the_nearest(dataset_id: str, nearest: str) -> None:
    stored("test/mine-v0")
    with pytest.raises(UnknownIdError, match=rf"Did you mean .*'{nearest}'.*mpcoffline collect"):
        load_dataset(dataset_id)


@pytest.mark.parametrize("dataset_id", ["../../etc-v0", "", "/etc-v0", 7, None])
def test_an_id_outside_the_store_is_unknown(dataset_id: Any) -> None:
    with pytest.raises(UnknownIdError, match="data set id"):
        load_dataset(dataset_id)


@pytest.mark.parametrize("damage", ["metadata", "no metadata", "no data"])
def test_a_damaged_local_data_set_is_named(store: Path, damage: str) -> None:
    stored("test/broken-v0")
    data = store / "test" / "broken-v0" / "data"
    if damage == "metadata":
        (data / "metadata.json").write_text("")
    else:
        (data / ("metadata.json" if damage == "no metadata" else "main_data.hdf5")).unlink()
    with pytest.raises(FileFormatError, match=r"test/broken-v0.*expected a complete Minari data set"):
        load_dataset("test/broken-v0")


def test_a_failed_write_leaves_nothing_and_the_old_set_alone(store: Path) -> None:
    stored("test/set-v0")
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    bad = recorded()
    broken = EpisodeBuffer(**{**vars(bad[1]), "rewards": object()})
    for dataset_id in ("test/set-v0", "test/other-v0"):
        with pytest.raises(TypeError):
            stored(dataset_id, episodes=[bad[0], broken], overwrite=True)
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before
    assert not list(store.glob(".*"))
    with pytest.raises(InvalidArgumentError, match="exists"):
        stored("test/set-v0")
    with pytest.raises(InvalidArgumentError, match="at least one transition"):
        write_dataset(
            "test/none-v0", [], env_spec=None, observation_space=spaces.Box(0, 1), action_space=spaces.Box(0, 1)
        )


def test_packing_there_and_back_is_exact(tmp_path: Path) -> None:
    original = stored("test/set-v0", episodes=recorded(episodes=3), algorithm_name="random", description="A test.")
    pack(original, tmp_path / "set.h5")
    pack(original, tmp_path / "again.h5")
    assert (tmp_path / "set.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()
    assert packed_size(tmp_path / "set.h5") == (3, 15)
    copy = unpack(tmp_path / "set.h5", "test/copy-v0")
    for a, b in zip(original.iterate_episodes(), copy.iterate_episodes(), strict=True):
        for column in ("observations", "actions", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(a, column), getattr(b, column))
            assert getattr(a, column).dtype == getattr(b, column).dtype
        np.testing.assert_allclose(a.rewards, b.rewards, rtol=1e-14)
        np.testing.assert_array_equal(a.infos["state"], b.infos["state"])
        np.testing.assert_allclose(a.infos["cost"], b.infos["cost"], rtol=1e-14)
    assert copy.env_spec == original.env_spec
    assert copy.observation_space == original.observation_space
    metadata = [json.loads((Path(d.spec.data_path) / "metadata.json").read_text()) for d in (original, copy)]
    for key in ("algorithm_name", "description", "total_steps", "action_space"):
        assert metadata[0][key] == metadata[1][key]


def test_what_the_environment_does_not_repeat_is_not_packed(tmp_path: Path) -> None:
    buffers = recorded()
    buffers[1].rewards[3] += 1e-9
    with pytest.raises(InvalidDataError, match=r"episode 1: rewards: expected what states and actions give"):
        pack(stored("test/one-v0", episodes=buffers), tmp_path / "x.h5")
    buffers = recorded()
    buffers[0].infos["state"][0] = np.nan
    with pytest.raises(InvalidDataError, match=r"episode 0: infos/state: .* joined halfway"):
        pack(stored("test/two-v0", episodes=buffers), tmp_path / "x.h5")
    assert not (tmp_path / "x.h5").exists()


def test_foreign_and_truncated_files_are_refused(tmp_path: Path, store: Path) -> None:
    pack(stored("test/set-v0"), tmp_path / "set.h5")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "set.h5").read_bytes()[:-200])
    (tmp_path / "text.h5").write_text("hello")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file.attrs["format"] = "something else"
    for name in ("cut", "text", "foreign", "missing"):
        with pytest.raises(FileFormatError, match=f"{name}.h5"):
            unpack(tmp_path / f"{name}.h5", "test/new-v0")
    with h5py.File(tmp_path / "set.h5", "a") as file:
        del file["lengths"]
        file["lengths"] = np.array([5], np.int32)
    with pytest.raises(FileFormatError, match="12 states, 10 actions in 1 episodes"):
        unpack(tmp_path / "set.h5", "test/new-v0")
    assert not (store / "test" / "new-v0").exists()
