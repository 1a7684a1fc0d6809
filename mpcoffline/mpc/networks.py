"""Costs that are small neural networks."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array

from .component import COSTS, Component, blocks_from_json, difference, vector
from .cost import QuadraticCost
from .parameters import Block, Parameter, ParameterSpace
from .signals import Named

HIDDEN = (24, 24)  # widths that hold the value of a swing-up to a few percent
_SMALL = 1e-3  # curvature that a convex network cost has by default besides the network's


@COSTS.register("NetworkCost")
class NetworkCost(Component):
    """A terminal cost that is a fully connected network, plus a quadratic one.

    ::

        T(x) = offset + scale * net((x - mean) / std) + e'We,       e = x - x_ref,   W positive semidefinite
        net(z) = A_n h_n + b_n,    h_{k+1} = sigma(A_k h_k + b_k),    h_0 = z,    sigma(a) = a / sqrt(1 + a^2)

    By Theorem 1 of Gros & Zanon (doi:10.1109/TAC.2019.2913768) the terminal cost of a learned MPC should be the value
    function. :func:`mpcoffline.learning.fit_terminal` distils one into this form, which is small enough for
    the inner loop of a solver. The network is bounded: W decides how the cost grows far away from the data.

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
        widths = [np.size(b) for b in biases[:-1]]
        nx = np.shape(weights[0])[-1] if len(weights) and np.ndim(weights[0]) else 0
        sizes = (nx, *widths, 1)
        weight = np.zeros((nx, nx)) if W is None else np.atleast_2d(np.asarray(W, dtype=np.float64))
        if weight.shape != (nx, nx):
            raise InvalidArgumentError("W", expected=f"shape {(nx, nx)}", actual=f"shape {weight.shape}")
        self.nx, self.n_layers = nx, len(sizes) - 1
        self.space = ParameterSpace(
            [
                *_layer_blocks("weights", weights, [(m, n) for n, m in itertools.pairwise(sizes)]),
                *_layer_blocks("biases", biases, [(m,) for m in sizes[1:]]),
                Block.free("offset", float(offset), "cost"),
                Block.psd("W", weight, "cost"),
                Block.free("scale", float(scale), "reference"),
                *_normalisation(mean, std, nx),
                Block.free("x_ref", vector("x_ref", x_ref, nx), "reference"),
            ]
        )

    @classmethod
    def random(cls, nx: int, hidden: Sequence[int] = HIDDEN, *, seed: int, **options: Any) -> NetworkCost:
        """A cost with random weights; see ``random_layers``.

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
        signal = self.standardised(x, p)
        for k in range(self.n_layers):
            signal = ca.mtimes(p[f"weights_{k}"], signal) + p[f"biases_{k}"]
            if k < self.n_layers - 1:
                signal = signal / ca.sqrt(1.0 + signal**2)
        return self.of_output(signal, x, p)

    def standardised(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """What the network sees of states, ``(x - mean) / std``."""
        return difference("x", x, p["mean"]) / p["std"]

    def of_output(self, output: ca.SX, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """T, where the network's output is known."""
        return p["offset"] + p["scale"] * output + ca.sumsqr(ca.mtimes(p["W"].T, x - p["x_ref"]))

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of ``to_json``."""
        cost = cls.__new__(cls)
        cost.space = blocks_from_json(data)
        cost.nx, cost.n_layers = len(cost.values["mean"]), _n_layers(cost.values, "weights")
        return cost


@COSTS.register("ConvexNetworkCost")
class ConvexNetworkCost(QuadraticCost):
    """A stage cost that is an input-convex network in state and input, plus a quadratic cost.

    ::

        Lhat(x, u) = q(x, u) + U_n z_n,      q the quadratic cost of :class:`QuadraticCost`,   U_k >= 0
        z_{k+1} = sigma(U_k z_k + A_k v + b_k),   z_0 absent,    v = ((x, u) - mean) / std,
        sigma(a) = (a + sqrt(a^2 + 1)) / 2

    sigma is convex and rises, so that Lhat is convex in (x, u) for every theta (Amos, Xu, Kolter, "Input Convex Neural
    Networks", arXiv:1609.07152): solvers need no projection, whatever was learned. The network is positive and R keeps
    the minimum over u unique. As a terminal cost u is held at ``u_ref``; without ``R`` the network sees x alone.

    Args:
        passes: A_0 ... A_{n-1}, what each layer takes from the inputs; A_k is ``(n_{k+1}, nx + nu)``.
        biases: b_0 ... b_{n-1}.
        mixes: U_1 ... U_n, not negative; U_k is ``(n_{k+1}, n_k)``, the last ``(1, n_n)``.
        W: State weight of q, ``(nx, nx)``.
        R: Input weight of q, ``(nu, nu)``.
        mean: Centre of (x, u), ``(nx + nu,)``; zero by default.
        std: Scale of (x, u), ``(nx + nu,)``, positive; one by default.
        **options: Further arguments of :class:`QuadraticCost`: ``S``, ``x_ref``, ``u_ref``, ``constant``, ``D`` and
            ``tracks``.

    Raises:
        InvalidArgumentError: If shapes do not fit, an entry of a U is negative, or [[W, S], [S', R]] is not positive
            semidefinite.
    """

    def __init__(
        self,
        passes: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        mixes: Sequence[ArrayLike],
        W: ArrayLike,
        R: ArrayLike | None = None,
        *,
        mean: ArrayLike | None = None,
        std: ArrayLike | None = None,
        **options: Any,
    ) -> None:
        super().__init__(W, R, **options)
        n = self.nx + self.nu
        widths = [np.size(b) for b in biases]
        self.n_layers = len(widths)
        self.space = ParameterSpace(
            [
                *self.space,
                *_layer_blocks("passes", passes, [(m, n) for m in widths]),
                *_layer_blocks("biases", biases, [(m,) for m in widths]),
                *_layer_blocks("mixes", mixes, [(m, k) for k, m in itertools.pairwise((*widths, 1))], low=0.0),
                *_normalisation(mean, std, n),
            ]
        )

    @classmethod
    def random(
        cls,
        nx: int,
        nu: int,
        hidden: Sequence[int] = (16, 16),
        *,
        seed: int,
        W: ArrayLike | None = None,
        R: ArrayLike | None = None,
        **options: Any,
    ) -> ConvexNetworkCost:
        """A cost with random weights.

        Args:
            nx: Number of states.
            nu: Number of inputs that the cost depends on.
            hidden: Widths of the hidden layers, at least one.
            seed: Seeds the weights.
            W: State weight of q; 1e-3 on the diagonal by default.
            R: Input weight of q; likewise.
            **options: Further arguments of the class.
        """
        rng = np.random.default_rng(seed)
        passes = [rng.normal(size=(m, nx + nu)) / np.sqrt(nx + nu) for m in hidden]
        biases = [0.5 * rng.normal(size=m) for m in hidden]
        # Positive weights add up instead of cancelling: each is of the size 1/n, not 1/sqrt(n).
        mixes = [rng.uniform(0.0, 2.0 / n, size=(m, n)) for n, m in itertools.pairwise((*hidden, 1))]
        W = _SMALL * np.eye(nx) if W is None else W
        R = _SMALL * np.eye(nu) if R is None and nu else R
        return cls(passes, biases, mixes, W, R, **options)

    def _stationary(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """Lhat as a CasADi scalar."""
        v = (ca.vertcat(x, u if self.nu else ca.SX(0, 1)) - p["mean"]) / p["std"]
        z = ca.SX(0, 1)
        for k in range(self.n_layers):
            a = ca.mtimes(p[f"passes_{k}"], v) + p[f"biases_{k}"]
            if k > 0:
                a += ca.mtimes(p[f"mixes_{k - 1}"], z)
            z = 0.5 * (a + ca.sqrt(a**2 + 1.0))
        return super()._stationary(x, u, p) + ca.mtimes(p[f"mixes_{self.n_layers - 1}"], z)

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX], d: Named | None = None) -> ca.SX:
        """Lhat(x, u_ref) as a CasADi scalar."""
        return self._stationary(self._away(x, d), p.get("u_ref", ca.SX(0, 1)), p)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of ``to_json``."""
        cost = super().from_json(data)
        cost.n_layers = _n_layers(cost.values, "passes")
        return cost


def random_layers(sizes: Sequence[int], rng: np.random.Generator) -> tuple[list[Array], list[Array]]:
    """Weights that keep the spread of the signals from layer to layer, and biases that make the units differ.

    Args:
        sizes: Number of inputs, widths of the hidden layers, number of outputs.
        rng: Draws the numbers.
    """
    weights = [rng.normal(size=(m, n)) / np.sqrt(n) for n, m in itertools.pairwise(sizes)]
    return weights, [0.5 * rng.normal(size=m) for m in sizes[1:]]


def _layer_blocks(
    name: str, arrays: Sequence[ArrayLike], shapes: Sequence[tuple[int, ...]], low: float = -np.inf
) -> list[Block]:
    """One block a layer, of the shapes that follow from the layers' widths."""
    if len(arrays) != len(shapes) or not shapes:
        raise InvalidArgumentError(name, expected=f"{max(len(shapes), 1)} arrays", actual=str(len(arrays)))
    blocks = [Block.free(f"{name}_{k}", Parameter(array, low), "cost") for k, array in enumerate(arrays)]
    for block, shape in zip(blocks, shapes, strict=True):
        if block.shape != shape:
            raise InvalidArgumentError(block.name, expected=f"shape {shape}", actual=f"shape {block.shape}")
    return blocks


def _normalisation(mean: ArrayLike | None, std: ArrayLike | None, n: int) -> list[Block]:
    """Centre and scale of n inputs."""
    positive = Parameter(vector("std", std, n, 1.0), low=np.finfo(np.float64).tiny)
    return [Block.free("mean", vector("mean", mean, n), "reference"), Block.free("std", positive, "reference")]


def _n_layers(values: Mapping[str, Array], name: str) -> int:
    return sum(key.startswith(f"{name}_") for key in values)
