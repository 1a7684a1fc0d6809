"""Presets and overrides, and what they make of an MPC."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from lq_plant import make_mpc

from mpcoffline import OfflineMPCLearner
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.learner.presets import PRESETS
from mpcoffline.learning import METHODS, Bellman, Paper, ParameterConfig, ValueConfig
from mpcoffline.plants.nominal import nominal_mpc

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def test_overrides_reach_their_field() -> None:
    overrides = {"value": "expectile", "tau": 0.1, "prior": 0.5, "value_n_steps": 7, "fit_n_steps": 9, "trim": 0.8}
    assert Paper().replaced(overrides | {"hidden": (3,), "horizon": 5}) == Paper(
        0.8,
        horizon=5,
        value=ValueConfig(method="expectile", tau=0.1, n_steps=7, hidden=(3,)),
        fit=ParameterConfig(prior=0.5, n_steps=9),
    )


def test_the_paper_preset_changes_nothing_of_the_mpc() -> None:
    mpc = nominal_mpc(PENDULUM)
    assert PRESETS["paper"].restructured(mpc).to_json() == mpc.to_json()
    options = PRESETS["paper"].options
    assert (options["value"], options["prediction_weight"], options["fit_n_steps"]) == ("residual", 0.0, 1_000)
    assert (options["init"], options["terminal"]) == ("nominal", "given")


def test_what_is_asked_for_wins_over_the_paper_preset() -> None:
    learner = OfflineMPCLearner(make_mpc(), preset="paper", terminal="network", init="identified")
    assert (learner.method.options["terminal"], learner.method.options["init"]) == ("network", "identified")
    assert list(METHODS["paper"]().stages()) == ["value", "fit"]


@pytest.mark.parametrize("name", METHODS)
def test_an_option_has_one_spelling_and_each_comes_back(name: str) -> None:
    method = METHODS[name]()
    options = method.options
    assert method.replaced(options) == method
    for stage, field in (("value", "tau"), ("value", "method"), ("fit", "prior"), ("terminal", "method")):
        with pytest.raises(UnknownIdError, match="option of the learning method"):
            method.replaced({f"{stage}_{field}": 1})
    assert {"value", "value_n_steps", "fit_n_steps", "tau", "prior", "discount"} <= set(options)
    assert ("terminal" in options) == ("init" in options) == (name == "bellman")


@pytest.mark.parametrize(
    ("preset", "given", "discount"),
    [("default", 0.9, 0.95), ("default", 0.97, 0.97), ("fast", 0.9, 0.95), ("best", 0.95, 0.97), ("best", 0.99, 0.99)],
)
def test_the_other_presets_have_a_least_discount(preset: str, given: float, discount: float) -> None:
    mpc = nominal_mpc(PENDULUM).replace(discount=given)
    assert PRESETS[preset].restructured(mpc).discount == discount
    assert PRESETS[preset].replaced({"discount": 0.8}).restructured(mpc).discount == 0.8
    assert mpc.discount == given


@pytest.mark.parametrize("preset", ["default", "fast", "best"])
def test_a_linear_quadratic_mpc_keeps_its_discount(preset: str) -> None:
    assert PRESETS[preset].restructured(make_mpc()).discount == make_mpc().discount == 0.9
    limited = make_mpc().replace(constraints=lambda x, u, p: x[0] - 1.0)
    assert PRESETS[preset].restructured(limited).discount > 0.9


def test_horizons_are_those_of_the_preset() -> None:
    horizons = {name: method.restructured(nominal_mpc(PENDULUM)).horizon for name, method in PRESETS.items()}
    assert horizons["paper"] == 50
    assert horizons["fast"] <= 10 < horizons["default"] <= horizons["best"]


@pytest.mark.parametrize(
    ("discount", "given", "horizon"),
    # .95^30 = .2146; .995^307 = .2146, .97^51 = .2115, .97^50 = .2181
    [(0.95, 100, 30), (0.9, 200, 30), (0.97, 20, 30), (0.97, 40, 40), (0.97, 200, 51), (0.995, 200, 200)],
)
def test_a_horizon_is_shortened_as_far_as_the_discount_allows(discount: float, given: int, horizon: int) -> None:
    """The terminal cost weighs no more than in the study, whatever the sampling time."""
    mpc = make_mpc().replace(discount=discount, horizon=given)
    assert PRESETS["default"].restructured(mpc).horizon == horizon
    assert PRESETS["default"].replaced({"horizon": 7}).restructured(mpc).horizon == 7
    assert PRESETS["paper"].restructured(mpc).horizon == given


def test_a_cross_term_leaves_the_cost_as_it_is_until_it_is_fitted() -> None:
    mpc = make_mpc()
    crossed = Paper(cross_term=True).restructured(mpc)
    assert "stage_cost.H" in crossed.values
    rng = np.random.default_rng(0)
    for _ in range(3):
        x, u = rng.normal(size=mpc.nx), rng.normal(size=mpc.nu)
        expected = float(mpc.stage_function(x, u, mpc.theta))
        assert float(crossed.stage_function(x, u, crossed.theta)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", PRESETS)
def test_configurations_survive_json(name: str) -> None:
    method = PRESETS[name].replaced({"hidden": (8, 9), "horizon": 3})
    assert METHODS[method.name].from_json(json.loads(json.dumps(method.to_json()))) == method


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"terminal": "networks"}, UnknownIdError, "Did you mean 'network'"),
        ({"init": "identify"}, UnknownIdError, "Did you mean 'identified'"),
        ({"horizon": 0}, InvalidArgumentError, "horizon"),
        ({"discount": 1.5}, InvalidArgumentError, "discount"),
        ({"blend": -0.1}, InvalidArgumentError, "blend"),
        ({"prediction_weight": -1.0}, InvalidArgumentError, "prediction_weight"),
        ({"n_step": 3}, UnknownIdError, "option of the learning method Bellman"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Bellman().replaced(options)
