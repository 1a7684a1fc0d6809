"""Which ids are refused, and that a store with a folder of such a name stays usable."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from minari.dataset.minari_dataset import gen_dataset_id, parse_dataset_id
from pendulum_data import stored

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.datasets import list_datasets, load_dataset, verify
from mpcoffline.datasets.store.ids import backup_path, is_valid_id


@pytest.mark.parametrize(
    "dataset_id",
    [
        "data/pump-v0",
        "mine/data/pump-v0",
        "Data/pump-v0",
        "plant/run-v0/part-v0",
        "run-v1/part-v0",
        "x-v00",
        "x-v01",
        "x-v\u0661",
        "-v0",
        "x" * 253 + "-v0",
        "aa/" + "y" * 300 + "-v0",
        "\u00e9" * 130 + "-v0",
        "/".join(["dd"] * 2000) + "/x-v0",
        "a" * 1_000_000,
        "a/" * 500_000,
        "aa//x-v0",
        "x-v0\n",
        None,
        5,
        b"x-v0",
    ],
)
def test_refused(dataset_id: object) -> None:
    assert not is_valid_id(dataset_id)


@pytest.mark.parametrize(
    "dataset_id",
    [
        "x-v0",
        "mine/x-v10",
        "my-data/x-v0",
        "database/x-v0",
        "mine/data-v0",
        "run-v/x-v0",
        "run-v1b/x-v0",
        "x" * 252 + "-v0",
        "\u00fcn\u00ef/\u65e5-v0",
    ],
)
def test_allowed_and_stored(dataset_id: str) -> None:
    assert is_valid_id(dataset_id)
    stored(dataset_id)
    assert load_dataset(dataset_id).total_steps == 10
    assert verify(dataset_id).ok
    assert dataset_id in {row.id for row in list_datasets()}


@given(st.from_regex(r"\A([-_a-z0-9]{1,5}/){0,2}[-_a-z0-9]{1,8}-v[0-9]{1,3}\Z"))
def test_a_valid_id_is_what_minari_makes_of_it(dataset_id: str) -> None:
    if is_valid_id(dataset_id):
        assert gen_dataset_id(*parse_dataset_id(dataset_id)) == dataset_id


def test_a_store_with_folders_of_such_names_stays_usable(store: Path) -> None:
    stored("mine/good-v0")
    for odd in ("data/pump-v0", "mine/data/pump-v0", "mine/good-v0/part-v0", "mine/x-v00"):
        shutil.copytree(store / "mine/good-v0/data", store / odd / "data")
    (store / "mine" / "again").symlink_to(store)
    shutil.copytree(store / "mine/good-v0", store / "mine/moved-v0")
    shutil.copytree(store / "mine/good-v0", store / "mine/broken-v0")
    (store / "mine/broken-v0/data/metadata.json").write_text(json.dumps({"dataset_id": 1}))
    with pytest.warns(UserWarning, match="Not listed") as told:
        local = [row.id for row in list_datasets() if row.where == "local"]
    assert local == ["mine/good-v0"]
    assert {str(warning.message).split("'")[1] for warning in told} == {"mine/broken-v0", "mine/moved-v0"}
    assert verify("mine/good-v0").ok
    assert load_dataset("mine/good-v0").total_steps == 10
    with (
        pytest.raises(UnknownIdError, match="Did you mean 'mine/good-v0'"),
        pytest.warns(UserWarning, match="Not listed"),
    ):
        load_dataset("mine/god-v0")
    with pytest.raises(InvalidArgumentError, match="not 'data'"):
        stored("data/pump-v0")


@pytest.mark.parametrize("ending", ["", "-recording"])
def test_whatever_has_a_valid_id_can_be_kept(ending: str) -> None:
    longest = "aa/" + "x" * 252 + "-v0"
    assert is_valid_id(longest)
    kept = [backup_path(longest, ending)]
    for _ in range(2):
        kept[-1].mkdir(parents=True)
        kept.append(backup_path(longest, ending))
    assert len(set(kept)) == 3
    assert {path.parent.parent.name for path in kept} == {".broken"}
