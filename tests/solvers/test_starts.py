"""The fixed input sequences that cold solves start from."""

from __future__ import annotations

import numpy as np
import pytest
from mpc_problems import random_linear
from task_ids import PENDULUM

from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers.starts import N_CANDIDATES, SIZES, candidate_inputs


@pytest.mark.parametrize(("nu", "horizon"), [(1, 1), (1, 50), (2, 8), (3, 33)])
def test_within_bounds_and_always_the_same(nu: int, horizon: int) -> None:
    mpc = random_linear(1, nu=nu, horizon=horizon)
    inputs = candidate_inputs(mpc)
    assert inputs.shape == (N_CANDIDATES, horizon, nu)
    assert ((inputs >= mpc.action_low) & (inputs <= mpc.action_high)).all()
    assert (inputs[0] == 0.0).all()
    np.testing.assert_array_equal(inputs, candidate_inputs(mpc))


def test_half_of_them_switch_once_at_times_spread_over_the_horizon() -> None:
    inputs = candidate_inputs(nominal_mpc(PENDULUM))[:, :, 0]
    full = np.abs(inputs) == 2.0
    once = full.all(axis=1) & ((np.diff(inputs, axis=1) != 0.0).sum(axis=1) <= 1)
    assert once.sum() >= N_CANDIDATES // 2
    for sign in (-1.0, 1.0):
        times = np.sort((inputs[once & (inputs[:, -1] == -2.0 * sign)] == 2.0 * sign).sum(axis=1))
        assert times[0] == 0
        assert times[-1] >= 44
        assert np.diff(times).max() <= 4


def test_unbounded_inputs_get_finite_sequences() -> None:
    mpc = random_linear(0, nu=2, action_low=[-np.inf, -1.0], action_high=[np.inf, np.inf])
    inputs = candidate_inputs(mpc)
    assert np.isfinite(inputs).all()
    assert (inputs[..., 1] >= -1.0).all()
    sizes = np.abs(inputs[..., 0]).max(axis=1)
    for size in SIZES:  # nobody knows their unit: of each size there are some
        assert ((sizes > 0.1 * size) & (sizes <= size)).any()
