"""The search for dead time in outputs: which dead times are tried and taken, by a likelihood that is known."""

from __future__ import annotations

import numpy as np
import pytest

from mpcoffline.core.types import Array
from mpcoffline.estimation.output_delays import Fit, search_delays
from mpcoffline.mpc import MPC, Model, QuadraticCost


def mpc_of(nu: int) -> MPC:
    model = Model(lambda x, u, p: 0.9 * x + sum(u[i] for i in range(nu)), 1, nu, 1.0, discrete=True)
    return MPC(model, QuadraticCost(np.eye(1), np.eye(nu)), QuadraticCost(np.eye(1)), 5, 1.0, [-1.0] * nu, [1.0] * nu)


@pytest.mark.parametrize("true", [(0, 0), (2, 0), (0, 7), (5, 3)])
def test_the_likeliest_dead_time_of_each_input_is_found(true: tuple[int, ...]) -> None:
    tried = []

    def fitted(delay: tuple[int, ...], point: Array | None) -> Fit:
        tried.append(delay)
        assert (point is None) == (len(tried) == 1)
        off = sum(abs(d - t) for d, t in zip(delay, true, strict=True))
        return Fit(100.0 * off, np.zeros(1), 0.3 + 0.01 * off)

    found, fit = search_delays(mpc_of(2), [True, True], 60, fitted)
    assert found == true
    assert fit.loss == 0.0
    assert max(max(delay) for delay in tried) <= max(true) + 3


def test_what_is_given_little_likelier_or_worse_ahead_is_left() -> None:
    true = 4

    def fitted(delay: tuple[int, ...], gain: float, missed: float) -> Fit:
        off = abs(delay[0] - true)
        return Fit(gain * off, np.zeros(1), 0.3 - missed * off)

    assert search_delays(mpc_of(1), [False], 60, lambda d, _: fitted(d, 100.0, 0.0))[0] == (0,)
    assert search_delays(mpc_of(1), [True], 60, lambda d, _: fitted(d, 5.0, 0.0))[0] == (0,)
    assert search_delays(mpc_of(1), [True], 60, lambda d, _: fitted(d, 100.0, 0.05))[0] == (0,)
    assert search_delays(mpc_of(1), [True], 6, lambda d, _: fitted(d, 100.0, 0.0))[0] == (2,)  # of episodes of six
