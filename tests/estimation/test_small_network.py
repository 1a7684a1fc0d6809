"""Least squares of small networks against derivatives that are computed otherwise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpcoffline.estimation.small_network import Effort, SmallNetwork, _normal_equations, _solved, fit_small_network
from mpcoffline.mpc.networks import random_layers


@pytest.mark.parametrize("sizes", [(3, 4, 5, 2), (6, 5, 4, 1), (1, 2, 2, 7)])
def test_the_normal_equations_are_those_of_automatic_derivatives(sizes: tuple[int, int, int, int]) -> None:
    rng = np.random.default_rng(0)
    weights, biases = random_layers(sizes, rng)
    biases = [rng.standard_normal(b.shape) for b in biases]
    z, targets = rng.standard_normal((40, sizes[0])), rng.standard_normal((40, sizes[-1]))
    unit = rng.uniform(0.5, 2.0, targets.shape)
    layers = [np.column_stack(layer) for layer in zip(weights, biases, strict=True)]
    flat = torch.from_numpy(np.concatenate([layer.ravel() for layer in layers]))

    def outputs(p: torch.Tensor) -> torch.Tensor:
        v = torch.from_numpy(z)
        for piece, layer in zip(torch.split(p, [layer.size for layer in layers]), layers, strict=True):
            M = piece.reshape(layer.shape)
            a = v @ M[:, :-1].T + M[:, -1]
            v = a / torch.sqrt(1.0 + a * a)
        return (torch.from_numpy(unit) * v).ravel()

    J = torch.autograd.functional.jacobian(outputs, flat).numpy()
    missed = targets.ravel() - outputs(flat).numpy()
    curvature, slope, error = _normal_equations(layers, z, unit, targets)
    truth = J.T @ J / len(z)
    np.testing.assert_allclose(np.tril(curvature), np.tril(truth), rtol=0, atol=1e-6 * np.abs(truth).max())
    np.testing.assert_allclose(slope, J.T @ missed / len(z), rtol=0, atol=1e-6 * np.abs(J.T @ missed / len(z)).max())
    assert error == pytest.approx(missed @ missed / len(z))


def test_a_step_is_that_of_the_damped_normal_equations() -> None:
    rng = np.random.default_rng(1)
    J, slope, damping = rng.standard_normal((60, 40)), rng.standard_normal(40), rng.uniform(0.1, 1.0, 40)
    curvature = np.tril(J.T @ J).astype(np.float32)  # of which nothing above the diagonal is read
    step = _solved(curvature, damping, slope)
    assert step is not None
    np.testing.assert_allclose(step, np.linalg.solve(J.T @ J + np.diag(damping), slope), rtol=0, atol=1e-5)
    assert _solved(-curvature, damping, slope) is None


@pytest.mark.parametrize("unit", [2.0**-140, 2.0**140])
def test_targets_may_be_in_any_unit(unit: float) -> None:
    """Their squares are beyond single precision."""
    rng = np.random.default_rng(2)
    inputs = rng.standard_normal((300, 2))
    targets = np.sin(2.0 * inputs[:, :1]) * inputs[:, 1:]

    def fitted(size: float) -> SmallNetwork:
        data, stop = ((inputs[part], size * targets[part]) for part in (slice(200), slice(200, 300)))
        return fit_small_network(data, stop, (6, 6), 0, Effort(rows=200, steps=15, decays=(1e-4,)))

    found, other = fitted(1.0)(inputs), fitted(unit)(inputs)
    assert np.mean((found - targets) ** 2) < 0.1 * np.var(targets)
    np.testing.assert_allclose(other / unit, found, rtol=1e-12, atol=0)
