"""Equations that states of a plant always satisfy, as cos^2 + sin^2 = 1: models are kept on them.

A model is fitted where such equations hold and knows nothing beside them. Small errors across them add up over a long
simulation, to states that the plant cannot have.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc.scaling import spread_of

_HOLDS = 1e-3  # root mean square of an equation of unit weights in the log, states in spreads
_KEPT = 0.02  # the same after some steps of the model, of the way that the states went
_STEPS = 5
_ROWS = 1_000
_NEWTON = 2
_FARTHEST = 0.5  # spreads: a state farther off is none of a plant any more
_LEAST = 1e-9


class Invariants(NamedTuple):
    """Quadratic equations ``w' [1, z, z_i z_j] = 0`` of the states, z standardised.

    Attributes:
        mean: Of the states, ``(n,)``.
        spread: Likewise.
        weights: One column an equation, ``(q, k)``.
    """

    mean: Array
    spread: Array
    weights: Array

    @classmethod
    def of(cls, states: Array, inputs: Array, step: Callable[[Array, Array], Array], seed: int) -> Self:
        """Those that hold in the log and that the model keeps, whatever the inputs.

        What merely happened to hold, since the log's controller had it so, a model under inputs drawn at random leaves.

        Args:
            states: Logged states, ``(N, n)``.
            inputs: What acted there, ``(N, nu)``.
            step: The model: successors of states ``(B, n)`` under inputs ``(B, nu)``.
            seed: Draws.
        """
        rng = np.random.default_rng(seed)
        rows = rng.permutation(len(states))[:_ROWS]
        x, found = states[rows], cls(states.mean(axis=0), spread_of(states), np.zeros((0, 0)))
        features = found.features(x)
        _, sizes, directions = np.linalg.svd(features, full_matrices=False)
        weights = directions[sizes / np.sqrt(len(x)) < _HOLDS].T
        if len(rows) <= features.shape[1] or not weights.shape[1]:
            return found._replace(weights=np.zeros((features.shape[1], 0)))
        reached = x
        for _ in range(_STEPS):  # each input from another row: any that was ever applied, at any time
            reached = step(reached, np.stack([rng.permutation(column) for column in inputs[rows].T], axis=1))
        good = np.isfinite(reached).all(axis=1)
        way = np.sqrt(np.mean(np.square((reached - x)[good] / found.spread))) if good.any() else 0.0
        left = found.features(reached[good]) @ weights
        _, sizes, mixed = np.linalg.svd(left, full_matrices=False)
        kept = mixed[sizes / np.sqrt(max(len(left), 1)) < _KEPT * way].T
        return found._replace(weights=weights @ kept)

    def features(self, x: Array) -> Array:
        """1, z and its products, of states ``(..., n)``."""
        z = (x - self.mean) / self.spread
        i, j = np.triu_indices(z.shape[-1])
        return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., j]], axis=-1)

    def projected(self, x: Array) -> Array:
        """The nearest states that satisfy the equations, by Newton's method, ``(..., n)``; far ones as they are."""
        if not self.weights.shape[1]:
            return x
        n, moved = x.shape[-1], x
        i, j = np.triu_indices(n)
        linear, products = self.weights[1 : n + 1], np.zeros((n, n, self.weights.shape[1]))
        products[i, j] += self.weights[n + 1 :]
        products[j, i] += self.weights[n + 1 :]
        unit = np.eye(self.weights.shape[1])
        for _ in range(_NEWTON):
            z = (moved - self.mean) / self.spread
            slopes = linear + np.tensordot(z, products, axes=1)  # (..., n, k)
            square = slopes.swapaxes(-1, -2) @ slopes
            missed = (self.features(moved) @ self.weights)[..., None]
            damped = square + _LEAST * np.trace(square, axis1=-2, axis2=-1)[..., None, None] * unit + 1e-300 * unit
            moved = moved - self.spread * (slopes @ np.linalg.solve(damped, missed))[..., 0]
        near = (np.abs(moved - x) <= _FARTHEST * self.spread).all(axis=-1, keepdims=True)
        return np.asarray(np.where(near, moved, x))
