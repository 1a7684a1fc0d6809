"""Costs that are small neural networks."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.errors import InvalidArgumentError

from .component import Component, blocks_from_json, difference, vector
from .parameters import Array, Block, Parameter, ParameterSpace

HIDDEN = (24, 24)  # widths that hold the value of a swing-up to some tenths of a percent


class NetworkCost(Component):
    """A terminal cost that is a fully connected network, plus a quadratic one.

    ::

        T(x) = offset + scale * net((x - mean) / std) + e'We,       e = x - x_ref,   W positive semidefinite
        net(z) = A_n h_n + b_n,    h_{k+1} = sigma(A_k h_k + b_k),    h_0 = z,    sigma(a) = a / sqrt(1 + a^2)

    By Theorem 1 of Gros & Zanon (doi:10.1109/TAC.2019.2913768) the terminal cost of a learned MPC should be the value
    function; :func:`mpcoffline.learning.terminal.fit_terminal` distils one into this form, which is small enough for the inner
    loop of a solver. The network is bounded, so that W decides how the cost grows far away from the data.

    All numbers are parameters; those of the normalisation and the reference belong to the group ``"reference"``.

    Args:
        weights: A_0 ... A_n; A_0 is ``(n_1, nx)``, A_n is ``(1, n_n)``.
        biases: b_0 ... b_n, one number a row of each A.
        mean: Centre of the states, ``(nx,)``; zero by default.
        std: Scale of the states, ``(nx,)``, positive; one by default.
        offset: Cost where the network is zero.
        scale: Cost of a unit of the network's output.
        W: State weight, ``(nx, nx)``; zero by default.
        x_ref: Reference of the quadratic part, ``(nx,)``; zero by default.

    Raises:
        InvalidArgumentError: If shapes do not fit, ``std`` is not positive, or W is not positive semidefinite.
    """

    convex: ClassVar[bool] = False

    def __init__(
        self,
        weights: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        *,
        mean: ArrayLike | None = None,
        std: ArrayLike | None = None,
        offset: float = 0.0,
        scale: float = 1.0,
        W: ArrayLike | None = None,
        x_ref: ArrayLike | None = None,
    ) -> None:
        layers = [Block.free(f"weights_{k}", np.asarray(A, np.float64), "cost") for k, A in enumerate(weights)]
        shifts = [Block.free(f"biases_{k}", np.asarray(b, np.float64), "cost") for k, b in enumerate(biases)]
        _check_layers(layers, shifts)
        self.nx, self.n_layers = layers[0].shape[1], len(layers)
        nx = self.nx
        weight = np.zeros((nx, nx)) if W is None else np.atleast_2d(np.asarray(W, dtype=np.float64))
        if weight.shape != (nx, nx):
            raise InvalidArgumentError("W", expected=f"shape {(nx, nx)}", actual=f"shape {weight.shape}")
        smallest = np.finfo(np.float64).tiny
        self.space = ParameterSpace(
            [
                *layers,
                *shifts,
                Block.free("offset", float(offset), "cost"),
                Block.psd("W", weight, "cost"),
                Block.free("scale", float(scale), "reference"),
                Block.free("mean", vector("mean", mean, nx), "reference"),
                Block.free("std", Parameter(vector("std", std, nx, 1.0), low=smallest), "reference"),
                Block.free("x_ref", vector("x_ref", x_ref, nx), "reference"),
            ]
        )

    @classmethod
    def random(cls, nx: int, hidden: Sequence[int] = HIDDEN, *, seed: int, **options: Any) -> NetworkCost:
        """A cost with random weights; see :func:`random_layers`.

        Args:
            nx: Number of states.
            hidden: Widths of the hidden layers.
            seed: Seeds the weights.
            **options: Further arguments of the class.
        """
        weights, biases = random_layers((nx, *hidden, 1), np.random.default_rng(seed))
        return cls(weights, biases, **options)

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """T as a CasADi scalar; ``p["W"]`` is the factor C of W = C C'."""
        signal = difference("x", x, p["mean"]) / p["std"]
        for k in range(self.n_layers):
            signal = ca.mtimes(p[f"weights_{k}"], signal) + p[f"biases_{k}"]
            if k < self.n_layers - 1:
                signal = signal / ca.sqrt(1.0 + signal**2)
        return p["offset"] + p["scale"] * signal + ca.sumsqr(ca.mtimes(p["W"].T, x - p["x_ref"]))

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> NetworkCost:
        """The inverse of :meth:`to_json`."""
        space = blocks_from_json(data)
        values = {block.name: block.value for block in space}
        weights, biases = _layers(values, "weights"), _layers(values, "biases")
        cost = cls(weights, biases, mean=values["mean"], std=values["std"], x_ref=values["x_ref"])
        cost.space = space
        return cost


def random_layers(sizes: Sequence[int], rng: np.random.Generator) -> tuple[list[Array], list[Array]]:
    """Weights that keep the spread of the signals from layer to layer, and biases that make the units differ.

    Args:
        sizes: Number of inputs, widths of the hidden layers, number of outputs.
        rng: Draws the numbers.
    """
    weights = [rng.normal(size=(m, n)) / np.sqrt(n) for n, m in itertools.pairwise(sizes)]
    return weights, [0.5 * rng.normal(size=m) for m in sizes[1:]]


def _layers(values: Mapping[str, Array], name: str) -> list[Array]:
    """The matrices or columns of the layers in order."""
    return [values[f"{name}_{k}"] for k in range(sum(key.startswith(f"{name}_") for key in values))]


def _check_layers(weights: Sequence[Block], biases: Sequence[Block]) -> None:
    """Refuses layers that do not follow each other, or that do not end in one number."""
    if not weights or len(weights) != len(biases):
        raise InvalidArgumentError(
            "weights", expected="one matrix a layer, and as many biases", actual=f"{len(weights)} and {len(biases)}"
        )
    n_in: int | str = "n"
    for k, (A, b) in enumerate(zip(weights, biases, strict=True)):
        rows: int | str = 1 if k == len(weights) - 1 else "m"
        fits = len(A.shape) == 2 and n_in in ("n", A.shape[1]) and rows in ("m", A.shape[0])
        if not fits:
            raise InvalidArgumentError(A.name, expected=f"shape ({rows}, {n_in})", actual=f"shape {A.shape}")
        if b.shape != A.shape[:1]:
            raise InvalidArgumentError(b.name, expected=f"shape {A.shape[:1]}", actual=f"shape {b.shape}")
        n_in = A.shape[0]
