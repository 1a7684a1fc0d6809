"""Damage is a finding: whatever stands in the files, `verify` gives a report."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pendulum_data import recorded, resealed, stored

from mpcoffline.datasets import repair, verify
from mpcoffline.datasets.store.opening import DATA_FILE

ID = "test/set-v0"

ARRAYS: dict[str, Callable[[Any], dict[str, Any]]] = {
    "references": lambda group: {"data": [group.ref] * 5, "dtype": h5py.ref_dtype},
    "texts": lambda group: {"data": ["a"] * 5},
    "compounds": lambda group: {"data": np.zeros(5, [("a", "f4"), ("b", "i4")])},
    "complex": lambda group: {"data": np.zeros(5, complex)},
    "times": lambda group: {"data": np.zeros(5, "i8").astype(h5py.opaque_dtype("M8[s]"))},
    "one number": lambda group: {"data": 1.0},
    "nothing": lambda group: {"data": h5py.Empty("f8")},
    "no row": lambda group: {"data": np.zeros((0, 1))},
    "three ranks": lambda group: {"data": np.zeros((5, 2, 2))},
    "sequences": lambda group: {"data": [np.zeros(2)] * 5, "dtype": h5py.vlen_dtype("f8")},
}


@pytest.mark.parametrize("column", ["observations", "rewards", "terminations", "infos/cost"])
@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_of_any_kind(store: Path, column: str, kind: str) -> None:
    stored(episodes=recorded(episodes=3))
    with h5py.File(store / ID / "data" / DATA_FILE, "a") as file:
        group = file["episode_1"]
        arguments = ARRAYS[kind](group)
        del group[column]
        data = arguments.pop("data")
        if arguments:
            made = group.create_dataset(column, (len(data),), **arguments)
            for i, value in enumerate(data):
                made[i] = value
        else:
            group.create_dataset(column, data=data)
    resealed()
    report = verify(ID)
    assert not report.ok
    assert any(finding.episode == 1 for finding in report.findings)
    assert repair(ID).episodes in (2, 3)


@pytest.mark.parametrize("value", ["x", 1.5, [1, 2], 2**62])
def test_attributes_of_any_kind(store: Path, value: Any) -> None:
    stored()
    with h5py.File(store / ID / "data" / DATA_FILE, "a") as file:
        file["episode_1"].attrs["id"] = value
    resealed()
    assert not verify(ID).ok


def test_groups_of_any_name(store: Path) -> None:
    stored()
    names = [
        "episode_",
        "episode_x",
        "episode_\u0661",
        "episode_" + "9" * 30,
        "episode_-1",
        "episode_01",
        "other",
        "\u00fc",
    ]
    with h5py.File(store / ID / "data" / DATA_FILE, "a") as file:
        for name in names:
            file[f"{name}/infos"] = h5py.SoftLink("/nowhere")
    resealed()
    assert not verify(ID).ok
    assert repair(ID).episodes == 2


_VALUES: list[Any] = [None, True, 0, -1, 1, 10**12, 10**30, 1.5, "", "x", [], {}, "arrow", "../../x", [None], {"a": {}}]


@pytest.mark.parametrize("seed", range(6))
def test_metadata_of_any_kind(store: Path, seed: int) -> None:
    dataset = stored()
    path = store / ID / "data" / "metadata.json"
    good, chosen = json.loads(path.read_text()), random.Random(seed)
    for _ in range(12):
        changed = good | {chosen.choice(list(good)): chosen.choice(_VALUES) for _ in range(2)}
        path.write_text(json.dumps(changed))
        for given in (ID, dataset):
            report = verify(given)
            assert report.ok == (json.dumps(changed) == json.dumps(good)), changed
    path.write_text(json.dumps(good))


def test_a_given_data_set_whose_files_are_gone(store: Path) -> None:
    dataset = stored()
    (store / ID / "data" / DATA_FILE).unlink()
    assert not verify(dataset).ok
    (store / ID / "data" / "metadata.json").unlink()
    assert not verify(dataset).ok
