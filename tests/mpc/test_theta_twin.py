"""Functions of rows and one theta: values and gradients against torch's autograd."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from torch import Tensor

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc.theta_twin import ThetaTwin
from mpcoffline.mpc.torch_twin import TorchTwin


def symbols() -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("s", 3), ca.SX.sym("a"), ca.SX.sym("theta", 4)


def motion() -> ca.Function:
    """Of theta the third is of no use, the fourth only beyond a threshold."""
    s, a, p = symbols()
    pushed = ca.if_else(s[2] > 0.2, p[3] * s[2], 0.0)
    return ca.Function("motion", [s, a, p], [ca.vertcat(p[0] * ca.sin(s[0]) * a, s[1] / p[1] + pushed)])


def network() -> ca.Function:
    """Large, and products of matrices: torch is faster."""
    s, a, p = symbols()
    z, rng = ca.vertcat(s, a), np.random.default_rng(1)
    for rows in (48, 48, 2):
        z = ca.tanh(ca.mtimes(ca.DM(rng.normal(size=(rows, z.numel())) / 4.0), z))
    return ca.Function("network", [s, a, p], [p[0] * z])


def power() -> ca.Function:
    """A valve that is shut at times: 0^theta does not move, though CasADi multiplies 0 by log 0."""
    s, a, p = symbols()
    return ca.Function("power", [s, a, p], [ca.vertcat(p[1] * a ** p[0], s[0] * p[2])])


def rows(seed: int, count: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    s, a = rng.normal(size=(count, 3)), rng.uniform(0.0, 1.0, (count, 1)).round(1)  # some are 0
    return torch.from_numpy(s), torch.from_numpy(a)


@cache
def twins(make: Callable[[], ca.Function]) -> tuple[ThetaTwin, TorchTwin]:
    function = make()
    return ThetaTwin(function), TorchTwin(function)


@pytest.mark.parametrize("make", [motion, network, power])
@given(st.integers(0, 2**31), st.sampled_from([1, 7, 600]))
@settings(max_examples=20)
def test_values_and_gradient_are_autograds(make: Callable[[], ca.Function], seed: int, count: int) -> None:
    s, a = rows(seed, count)
    found, by_torch = (
        (theta := torch.tensor([1.5, 0.7, -0.3, 2.0], dtype=torch.float64, requires_grad=True), twin(s, a, theta))
        for twin in twins(make)
    )
    torch.testing.assert_close(found[1], by_torch[1], rtol=1e-12, atol=1e-13)
    gradients = []
    for theta, reached in (found, by_torch):
        (reached.square().sum() + reached[:, 0].sum()).backward()  # type: ignore[no-untyped-call]
        gradients.append(theta.grad)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-10, atol=1e-10)
    assert torch.isfinite(gradients[0]).all()


def test_an_operation_that_neither_has_is_refused_at_once() -> None:
    s, a, p = symbols()
    with pytest.raises(InvalidArgumentError, match="turned: expected operations that torch has"):
        ThetaTwin(ca.Function("turned", [s, a, p], [ca.remainder(p[0] * s[0], 2.0)]))


def test_nothing_is_kept_where_no_gradient_is_asked_for() -> None:
    x, u = rows(0, 5)
    with torch.no_grad():
        assert not ThetaTwin(motion())(x, u, torch.ones(4, dtype=torch.float64)).requires_grad
