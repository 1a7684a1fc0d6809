"""Least squares of small networks against derivatives that are computed otherwise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpcoffline.estimation.small_network import _normal_equations
from mpcoffline.mpc.networks import random_layers


@pytest.mark.parametrize("sizes", [(3, 4, 5, 2), (6, 5, 4, 1), (1, 2, 2, 7)])
def test_the_normal_equations_are_those_of_automatic_derivatives(sizes: tuple[int, int, int, int]) -> None:
    rng = np.random.default_rng(0)
    weights, biases = random_layers(sizes, rng)
    biases = [rng.standard_normal(b.shape) for b in biases]
    z, targets = rng.standard_normal((40, sizes[0])), rng.standard_normal((40, sizes[-1]))
    unit = rng.uniform(0.5, 2.0, targets.shape)
    parts = [*weights, *biases]
    flat = torch.from_numpy(np.concatenate([part.ravel() for part in parts]))

    def outputs(p: torch.Tensor) -> torch.Tensor:
        pieces = torch.split(p, [part.size for part in parts])
        shaped = [piece.reshape(part.shape) for piece, part in zip(pieces, parts, strict=True)]
        v = torch.from_numpy(z)
        for A, b in zip(shaped[:3], shaped[3:], strict=True):
            a = v @ A.T + b
            v = a / torch.sqrt(1.0 + a * a)
        return (torch.from_numpy(unit) * v).ravel()

    J = torch.autograd.functional.jacobian(outputs, flat).numpy()
    missed = targets.ravel() - outputs(flat).numpy()
    curvature, slope, error = _normal_equations((weights, biases), z, unit, targets, len(flat))
    np.testing.assert_allclose(curvature, J.T @ J / len(z), rtol=0, atol=1e-6 * np.abs(J.T @ J / len(z)).max())
    np.testing.assert_allclose(slope, J.T @ missed / len(z), rtol=0, atol=1e-6 * np.abs(J.T @ missed / len(z)).max())
    assert error == pytest.approx(missed @ missed / len(z))
