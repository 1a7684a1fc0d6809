"""The rule of the verdict, case by case."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from mpcoffline.diagnostics.measures import LagCheck
from mpcoffline.diagnostics.verdict import Comparison, decide
from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.simulation.closed_loop import Simulation

NO_LAG = LagCheck(0.0, 1.0)


def comparison(*ratios: float, success: tuple[float, float] = (0.8, 1.0), **changes: Any) -> Comparison:
    """MPC_1 costs 100 on every member."""
    n = len(ratios)
    base = Comparison(
        (100.0,) * n, tuple(100.0 * r for r in ratios), (success[0],) * n, (success[1],) * n, 0.0, 20, 100, 0.999
    )
    return replace(base, **changes)


def noise(level: float = 0.0) -> NoiseEstimate:
    return NoiseEstimate(np.full(2, level), np.zeros(2), np.ones(2), "repeated")


def verdict(c: Comparison, lag: LagCheck = NO_LAG, level: float = 0.0, n_rows: int = 10_000) -> tuple[str, str]:
    found, reasons = decide(c, lag, noise(level), n_rows)
    assert reasons
    return found, " ".join(reasons)


def test_better_on_all_models_is_recommended() -> None:
    found, why = verdict(comparison(0.7, 0.65, 0.72))
    assert found == "recommend"
    assert "28 % to 35 % less cost" in why
    assert "safe" not in why


def test_one_model_that_disagrees_much_prevents_a_recommendation() -> None:
    found, why = verdict(comparison(0.7, 0.6, 0.95))  # log(.95 / .6) = .46, so .77 is asked for
    assert found == "try with care"
    assert "0.95 times on the worst" in why
    assert "0.77" in why


def test_no_gain_on_the_identified_model_keeps_mpc_1() -> None:
    assert verdict(comparison(0.99, 0.9, 0.95))[0] == "keep MPC_1"
    assert verdict(comparison(1.5, 1.4, 1.6))[0] == "keep MPC_1"


def test_fewer_successes_are_no_recommendation() -> None:
    found, why = verdict(comparison(0.7, 0.7, success=(1.0, 0.9)))
    assert found == "keep MPC_1"
    assert "fewer episodes" in why


@pytest.mark.parametrize(
    ("case", "word"),
    [
        ({"lag": LagCheck(0.4, 1e-20)}, "late"),
        ({"level": 0.2}, "noise"),
        ({"level": 0.05, "n_rows": 300}, "rows"),
        ({"c": comparison(0.7, 0.7, cost_r2=0.5)}, "cost"),
        ({"c": comparison(0.7, 0.7, lost=0.1)}, "ran away"),
    ],
)
def test_what_no_member_can_know_withholds_the_recommendation(case: dict[str, Any], word: str) -> None:
    found, why = verdict(**({"c": comparison(0.7, 0.7)} | case))
    assert found == "try with care"
    assert word in why


@given(st.lists(st.floats(0.01, 10.0), min_size=2, max_size=12))
def test_only_controllers_that_are_better_everywhere_are_recommended(ratios: list[float]) -> None:
    found, _ = verdict(comparison(*ratios))
    assert (found == "recommend") <= (max(ratios) < 0.98)
    assert (found == "keep MPC_1") <= (ratios[0] >= 0.95)


@given(st.lists(st.floats(0.2, 5.0), min_size=2, max_size=6), st.floats(0.5, 0.99))
def test_a_better_controller_is_never_judged_worse(ratios: list[float], factor: float) -> None:
    order = ["keep MPC_1", "try with care", "recommend"]
    better = verdict(comparison(*(factor * r for r in ratios)))[0]
    assert order.index(better) >= order.index(verdict(comparison(*ratios))[0])


def simulation(*costs: float) -> Simulation:
    each = np.array(costs)[:, None] * np.ones((1, 4))
    yes = np.ones(each.shape, dtype=bool)
    return Simulation(each, yes, ~yes, np.zeros((4, 6, 2)), np.zeros((4, 5, 1)))


def test_ratios_are_of_costs_above_the_cheapest() -> None:
    c = Comparison.of(simulation(10.0, 20.0), simulation(5.0, 30.0), 1.0)
    assert c.ratios == pytest.approx((0.5, 1.5))
    assert c.spread == pytest.approx(np.log(3.0))
    assert (c.n_starts, c.n_steps) == (4, 5)
    below = Comparison.of(simulation(10.0, 20.0), simulation(-5.0, 30.0), 1.0)  # cheaper than anything logged
    assert all(r >= 0.0 for r in below.ratios)
    assert below.ratios == pytest.approx((3.5 / 18.5, 38.5 / 28.5))  # from a tenth of -5 ... 30 below -5
