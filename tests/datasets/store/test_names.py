"""Names and units of columns: from what a log is read with, through the stored data set, to what people see of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pendulum_data import resealed, stored

from mpcoffline import TransitionTable, load_dataset
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.datasets import dataset_from_arrays, show
from mpcoffline.datasets.check.summary import coverage
from mpcoffline.datasets.store.ids import dataset_path
from mpcoffline.datasets.store.names import NAMES, names_of

TANKS = ("h1 [cm]", "h2 [cm]", "pump [V]")


def episode(rows: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(1, 9, (rows + 1, 2)), rng.uniform(0, 6, (rows, 1)), rng.uniform(size=rows)


def test_they_come_back_with_the_data() -> None:
    states, actions, costs = episode()
    dataset_from_arrays("test/tanks-v0", [(states, actions, costs)], names=TANKS)
    dataset = load_dataset("test/tanks-v0")
    assert names_of(dataset) == TANKS
    table = TransitionTable.from_minari(dataset)
    assert table.names == TANKS
    assert repr(table) == "TransitionTable(\"data set 'test/tanks-v0'\", n=30; h1 [cm], h2 [cm], pump [V])"
    assert ">pump [V]<" in table._repr_html_()
    for part in (table.take(slice(3)), table.sample(3, 0), table.trim(0.5), table.with_states(states[1:], states[1:])):
        assert part.names == TANKS
    assert TransitionTable.concat([table, table]).names == TANKS


def test_people_see_them() -> None:
    states, actions, costs = episode()
    dataset = dataset_from_arrays("test/tanks-v0", [(states, actions, costs)], names=TANKS)
    summary = show(dataset)
    found = {each.name: each for each in summary.statistics}
    assert list(found)[:3] == list(TANKS)
    assert found["h2 [cm]"].quantiles[4] == pytest.approx(states[:-1, 1].max())
    assert found["pump [V]"].mean == pytest.approx(actions.mean())
    assert summary.facts["observation"] == "h1 [cm], h2 [cm]"
    assert summary.facts["action"] == "pump [V]"
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in coverage(dataset).figure.axes[:-1]]
    assert labels == [("h1 [cm]", "h2 [cm]"), ("h1 [cm]", "pump [V]")]


def test_a_task_names_its_own() -> None:
    assert names_of(stored()) == ("cos phi", "sin phi", "phid [rad/s]", "u [N m]")


def test_where_nobody_said_any_there_are_none() -> None:
    dataset = stored(env_spec=None)
    assert names_of(dataset) == ()
    assert repr(TransitionTable.from_minari(dataset)).endswith("ny=3, nu=1)")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (TANKS[:2], r"names of columns: expected 3, one a column, got 2"),
        (("h1", "h2", "pump\x1b[2J"), r"name of a column: expected letters, digits"),
        (("h1", "", "pump"), r"name of a column: expected from 1 to 220 characters"),
    ],
)
def test_what_is_no_name_is_refused(names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        dataset_from_arrays("test/tanks-v0", [episode()], names=names)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (list(TANKS[:2]), "expected 3, one a column, got 2"),
        ("h1", "expected a list of names, got str"),
        ([1, 2, 3], "name of a column: expected a text"),
        (["h1", "h2", "<script>"], "name of a column: expected letters"),
    ],
)
def test_damaged_ones_are_told(names: object, message: str) -> None:
    dataset_from_arrays("test/tanks-v0", [episode()], names=TANKS)
    path = dataset_path("test/tanks-v0") / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {NAMES: names}))
    resealed("test/tanks-v0")
    with pytest.raises(FileFormatError, match=message):
        show("test/tanks-v0")
