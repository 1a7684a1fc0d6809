"""Presets and overrides, and what they make of an MPC."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from lq_plant import make_mpc

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.learner.fitting import restructured
from mpcoffline.learner.presets import PRESETS, LearnerConfig
from mpcoffline.learning import FitConfig, ValueConfig
from mpcoffline.plants.nominal import nominal_mpc

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def test_overrides_reach_their_field() -> None:
    overrides = {"method": "expectile", "tau": 0.1, "prior": 0.5, "value_n_steps": 7, "fit_n_steps": 9, "trim": 0.8}
    assert LearnerConfig().replaced(overrides | {"hidden": (3,), "horizon": 5}) == LearnerConfig(
        0.8,
        horizon=5,
        value=ValueConfig(method="expectile", tau=0.1, n_steps=7, hidden=(3,)),
        fit=FitConfig(prior=0.5, n_steps=9),
    )


def test_the_paper_preset_changes_nothing_of_the_mpc() -> None:
    mpc = nominal_mpc(PENDULUM)
    assert restructured(mpc, PRESETS["paper"]).to_json() == mpc.to_json()
    assert PRESETS["paper"].value.method == "residual"
    assert PRESETS["paper"].fit.prediction_weight == 0.0
    assert PRESETS["paper"].init == "nominal"


@pytest.mark.parametrize(
    ("preset", "given", "discount"),
    [("default", 0.9, 0.95), ("default", 0.97, 0.97), ("fast", 0.9, 0.95), ("best", 0.95, 0.97), ("best", 0.99, 0.99)],
)
def test_the_other_presets_have_a_least_discount(preset: str, given: float, discount: float) -> None:
    mpc = make_mpc().replace(discount=given)
    assert restructured(mpc, PRESETS[preset]).discount == discount
    assert restructured(mpc, PRESETS[preset].replaced({"discount": 0.8})).discount == 0.8
    assert mpc.discount == given


def test_horizons_are_those_of_the_preset() -> None:
    horizons = {name: restructured(nominal_mpc(PENDULUM), config).horizon for name, config in PRESETS.items()}
    assert horizons["paper"] == 50
    assert horizons["fast"] <= 10 < horizons["default"] <= horizons["best"]


def test_a_cross_term_leaves_the_cost_as_it_is_until_it_is_fitted() -> None:
    mpc = make_mpc()
    crossed = restructured(mpc, LearnerConfig(cross_term=True))
    assert "stage_cost.H" in crossed.values
    rng = np.random.default_rng(0)
    for _ in range(3):
        x, u = rng.normal(size=mpc.nx), rng.normal(size=mpc.nu)
        expected = float(mpc.stage_function(x, u, mpc.theta))
        assert float(crossed.stage_function(x, u, crossed.theta)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", PRESETS)
def test_configurations_survive_json(name: str) -> None:
    config = PRESETS[name].replaced({"hidden": (8, 9), "horizon": 3})
    assert LearnerConfig.from_json(json.loads(json.dumps(asdict(config)))) == config


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"terminal": "networks"}, UnknownIdError, "Did you mean 'network'"),
        ({"init": "identify"}, UnknownIdError, "Did you mean 'identified'"),
        ({"horizon": 0}, InvalidArgumentError, "horizon"),
        ({"discount": 1.5}, InvalidArgumentError, "discount"),
        ({"terminal_blend": -0.1}, InvalidArgumentError, "terminal_blend"),
        ({"prediction_weight": -1.0}, InvalidArgumentError, "prediction_weight"),
        ({"n_step": 3}, UnknownIdError, "option of OfflineMPCLearner"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        LearnerConfig().replaced(options)
