"""The summary of a data set: numbers that are those of the data, the card, the figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from matplotlib.image import imread
from pendulum_data import recorded, stored
from rich.console import Console

import mpcoffline.datasets as package
from mpcoffline.core.errors import InvalidDataError, UnknownIdError
from mpcoffline.datasets.check.summary import coverage, show
from mpcoffline.datasets.recipes import catalog_file


def test_the_numbers_are_those_of_the_data(tmp_path: Path) -> None:
    episodes = recorded(length=30, episodes=4, terminate=True)
    dataset = stored(episodes=episodes, algorithm_name="random", description="A test.")
    summary = show("test/set-v0", tmp_path / "new" / "coverage.png")
    found = {s.name: s for s in summary.statistics}
    costs = np.concatenate([-np.asarray(episode.rewards) for episode in episodes])
    assert found["cost L of a step"].quantiles == pytest.approx(np.percentile(costs, [0, 5, 50, 95, 100]))
    assert found["cost J of an episode"].mean == pytest.approx(costs.sum() / 4)
    first = np.concatenate([np.asarray(episode.observations)[:-1, 2] for episode in episodes])
    assert found["phid [rad/s]"].quantiles[4] == pytest.approx(first.max())
    assert found["steps of an episode"].quantiles == (30.0,) * 5
    assert list(found)[:4] == ["cos phi", "sin phi", "phid [rad/s]", "u [N m]"]
    assert summary.facts["episodes"] == "4 (2 terminated, 2 truncated)"
    assert summary.facts["algorithm"] == "random"
    assert summary.facts["environment"] == "mpcoffline/PendulumSwingUp-v0"
    assert summary.card == ""
    text = str(summary)
    assert "| cost J of an episode |" in text
    assert f"coverage: {summary.figure}" in text
    console = Console(width=120, record=True)
    console.print(summary)
    printed = console.export_text()
    assert "cost L of a step" in printed
    assert "A test." in printed
    assert imread(tmp_path / "new" / "coverage.png").std() > 0.01
    assert show(dataset).figure is None


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_a_shipped_data_set_has_its_card() -> None:
    summary = show("mpcoffline/pendulum/ddpg-v0")
    assert summary.card == catalog_file("pendulum.md").read_text(encoding="utf-8")
    assert str(summary).startswith("# mpcoffline/pendulum/ddpg-v0")


def test_any_other_environment_has_panels_too(tmp_path: Path) -> None:
    dataset = stored(env_spec=None)
    figure = coverage(dataset)
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes[:-1]]
    assert labels == [("observation[0]", "observation[1]"), ("observation[0]", "action[0]")]
    figure.savefig(tmp_path / "few.png")
    assert "environment" not in show(dataset).facts


def test_what_has_no_vectors_is_refused() -> None:
    dataset = stored(action_space=spaces.Box(-2.0, 2.0, (1, 1)))
    with pytest.raises(InvalidDataError, match=r"action space: expected a Box of shape \(n,\)"):
        show(dataset)
    with pytest.raises(UnknownIdError):
        show("test/nothing-v0")


def test_the_package_gives_every_function() -> None:
    for name in package.__all__:
        assert callable(getattr(package, name))
