"""Methods of (VALUE) of one's own: by name, as objects, in files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learning import VALUE_METHODS, ValueConfig, ValueMethod
from mpcoffline.learning.value.fit import Expectile, ImplicitQ, TemporalDifference
from mpcoffline.learning.value.methods import Critic, method_to_json, sampled_target
from mpcoffline.mpc import MPC, Model, QuadraticCost


@dataclass(frozen=True)
class Huber(ValueMethod):
    """Semi-gradient TD by Huber's loss."""

    width: float = 1.0

    def loss(self, V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        delta = sampled_target(V_target, batch, discount) - V(batch.observations)
        return (self.width**2 * ((1.0 + (delta / self.width).square()).sqrt() - 1.0)).mean()


def mpc() -> MPC:
    cost = QuadraticCost([[1.0]], [[1.0]])
    return MPC(Model(lambda x, u, p: x + u, 1, 1, 0.1, discrete=True), cost, cost, 2, 0.9, [-1.0], [1.0])


def test_names_and_objects_give_the_method() -> None:
    assert ValueConfig("iql", tau=0.2).build() == ImplicitQ(0.2)
    assert ValueConfig("td").build() == TemporalDifference()
    assert ValueConfig(Huber(0.5)).build(noisy=True) == Huber(0.5)
    assert OfflineMPCLearner(mpc(), value=Huber(0.5)).method.value.method == Huber(0.5)
    for wrong in (7, "huber", b"td", ["td"]):
        with pytest.raises(UnknownIdError, match="value method"):
            OfflineMPCLearner(mpc(), value=wrong)  # type: ignore[arg-type]
    for tau in (0.0, 1.0, np.nan, "0.3", True):
        with pytest.raises(InvalidArgumentError, match="tau: expected a number in"):
            Expectile(tau)  # type: ignore[arg-type]


def test_a_method_of_a_class_that_no_file_can_name_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match="value method: expected a registered dataclass"):
        OfflineMPCLearner(mpc(), value=Huber()).save(tmp_path / "l.zip")
    assert list(tmp_path.iterdir()) == []


def test_a_registered_one_is_saved_with_its_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(VALUE_METHODS, "_things", dict(VALUE_METHODS.items()))
    VALUE_METHODS.add("huber", Huber)
    for value in (Huber(0.5), "huber", ImplicitQ(0.2)):
        OfflineMPCLearner(mpc(), value=value).save(tmp_path / "l.zip")
        assert OfflineMPCLearner.load(tmp_path / "l.zip").method.value.method == value
    data = json.loads(json.dumps(method_to_json(Huber(0.5))))
    monkeypatch.undo()
    with pytest.raises(FileFormatError, match=r"expected a value method that is known here .* import what registers"):
        ValueConfig(data)  # type: ignore[arg-type]
