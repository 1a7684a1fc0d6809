"""What the verdict asks for where the models disagree: never less than nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from mpcoffline.diagnostics.measures import LagCheck
from mpcoffline.diagnostics.verdict import Comparison, decide
from mpcoffline.estimation.smoothing import NoiseEstimate

QUIET = NoiseEstimate(np.zeros(2), np.zeros(2), np.ones(2), "repeated")


def comparison(ratios: list[float]) -> Comparison:
    """MPC_1 costs 100 on every member and never succeeds."""
    n = len(ratios)
    return Comparison((100.0,) * n, tuple(100.0 * r for r in ratios), (0.0,) * n, (1.0,) * n, 0.0, 20, 100, 1.0)


@given(st.lists(st.floats(1e-6, 10.0), min_size=2, max_size=12))
def test_no_limit_is_below_zero(ratios: list[float]) -> None:
    c = comparison(ratios)
    assert 0.0 <= c.limit <= 0.98
    verdict, reasons = decide(c, LagCheck(0.0, 1.0), QUIET, 50_000)
    assert not any("than -" in reason for reason in reasons)
    assert (verdict == "recommend") == (max(ratios) < min(0.98, 1.0 - 0.5 * c.spread))


def test_models_that_disagree_too_much_are_called_that() -> None:
    verdict, reasons = decide(comparison([0.01, 0.1, 0.1, 0.005]), LagCheck(0.0, 1.0), QUIET, 50_000)
    assert verdict == "try with care"
    (why,) = reasons
    assert "0.10 times on the worst of 4, and 20 times as much as on the best" in why
    assert "no recommendation" in why
    assert "asked for" not in why


@pytest.mark.parametrize("worst", [0.8, 0.9])
def test_a_limit_above_zero_is_still_said(worst: float) -> None:
    c = comparison([0.3, worst])
    _, reasons = decide(c, LagCheck(0.0, 1.0), QUIET, 50_000)
    assert f"where less than {c.limit:.2f} is asked for" in reasons[0]
