"""The network of an explicit policy: inputs scaled, outputs held to their bounds, evaluated by numpy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core import limits
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.types import Array

DIGITS = 5  # of a weight that count: a file of C stays small, and a network is what its file says
_FIELDS = ("mean", "spread", "direct", "centre", "unit", "low", "high")


@dataclass(frozen=True, eq=False)
class PolicyNetwork:
    """A fully connected network with a linear part beside it.

    ::

        u = clip(centre + unit (K v + A_n h_n + b_n), low, high),      v = (z - mean) / spread
        h_{k+1} = sigma(A_k h_k + b_k),    h_0 = v,    sigma(a) = a / sqrt(1 + a^2)

    K acts where an MPC is a linear controller, as at rest; the bounds are exact, as the MPC's are, and need no large
    weights. sigma needs a square root and no other function.

    Attributes:
        mean: Centre of the states, ``(nz,)``.
        spread: Scale of the states, ``(nz,)``, positive.
        weights: A_0 ... A_n; A_0 is ``(n_1, nz)``, A_n is ``(nu, n_n)``.
        biases: b_0 ... b_n, one number a row of each A.
        direct: K, ``(nu, nz)``.
        centre: Input where the network is zero, ``(nu,)``.
        unit: Input of a unit of the network's output, ``(nu,)``, positive.
        low: Lower bounds of the inputs, ``(nu,)``; ``-inf`` where there are none.
        high: Upper bounds.
    """

    mean: Array
    spread: Array
    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    direct: Array
    centre: Array
    unit: Array
    low: Array
    high: Array

    @classmethod
    def random(
        cls,
        states: Array,
        bounds: tuple[Array, Array],
        actions: Array,
        hidden: Sequence[int],
        rng: np.random.Generator,
    ) -> Self:
        """Random weights, an output of about zero, and scales from data.

        Args:
            states: States z, ``(n, nz)``.
            bounds: Lower and upper bounds of the inputs; where one is missing, ``actions`` say how large an input is.
            actions: Inputs, ``(n, nu)``.
            hidden: Widths of the hidden layers.
            rng: Draws the weights.
        """
        spread, (low, high) = states.std(axis=0), bounds
        known = np.isfinite(high - low)
        middle, half = np.where(known, low + high, 0.0) / 2.0, np.where(known, high - low, 0.0) / 2.0
        size = actions.std(axis=0)
        size = np.where(size > 0.0, size, np.where(actions[0] != 0.0, np.abs(actions[0]), 1.0))
        nz, nu = states.shape[1], actions.shape[1]
        widths = (nz, *hidden, nu)
        weights = [rng.normal(size=(m, n)) / math.sqrt(n) for n, m in itertools.pairwise(widths)]
        weights[-1] *= 0.1
        return cls(
            states.mean(axis=0),
            np.where(spread > 0.0, spread, 1.0),
            tuple(weights),
            (*(0.5 * rng.normal(size=m) for m in hidden), np.zeros(nu)),
            np.zeros((nu, nz)),
            np.where(known, middle, actions.mean(axis=0)),
            np.where(known, half, size),
            low,
            high,
        )

    @property
    def nz(self) -> int:
        """Number of states."""
        return int(self.direct.shape[1])

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.direct.shape[0])

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(len(bias) for bias in self.biases[:-1])

    @property
    def multiply_adds(self) -> int:
        """Multiplications with additions that an action takes, scaling included; a square root a unit besides."""
        return multiply_adds(self.nz, self.nu, self.hidden)

    def __call__(self, states: Array) -> Array:
        """Inputs ``(..., nu)`` of states ``(..., nz)``, within their bounds."""
        signal = v = (states - self.mean) / self.spread
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            a = signal @ weight.T + bias
            signal = a / np.sqrt(1.0 + a * a)
        output = v @ self.direct.T + signal @ self.weights[-1].T + self.biases[-1]
        return np.clip(self.centre + self.unit * output, self.low, self.high)

    def rounded(self, digits: int = DIGITS) -> Self:
        """With weights and scales of so many significant digits; centre and bounds as they are."""
        return replace(
            self,
            spread=_rounded(self.spread, digits),
            weights=tuple(_rounded(a, digits) for a in self.weights),
            biases=tuple(_rounded(a, digits) for a in self.biases),
            direct=_rounded(self.direct, digits),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All numbers by name."""
        layers = {f"{name}_{k}": a for name in ("weights", "biases") for k, a in enumerate(getattr(self, name))}
        return {name: getattr(self, name) for name in _FIELDS} | layers

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The inverse of :meth:`to_arrays`.

        Raises:
            FileFormatError: If arrays are missing or too many, of the wrong shape, or hold what they must not hold.
        """
        n = sum(name.startswith("weights_") for name in arrays)
        names = {*_FIELDS, *(f"{kind}_{k}" for kind in ("weights", "biases") for k in range(n))}
        if n < 1 or arrays.keys() != names:
            raise FileFormatError("network", expected="its arrays", actual=str(sorted(arrays))[:200])
        known = {name: np.array(array, dtype=np.float64) for name, array in arrays.items()}
        direct = known["direct"]
        if direct.ndim != 2:
            raise FileFormatError("direct", expected="a matrix", actual=f"shape {direct.shape}")
        nu, nz = direct.shape
        check_limit("network", "inputs", nu, limits.INPUTS)
        check_limit("network", "states", nz, limits.STATES)
        widths = (nz, *(known[f"biases_{k}"].size for k in range(n - 1)), nu)
        shapes = {"mean": (nz,), "spread": (nz,), "direct": (nu, nz)}
        shapes |= dict.fromkeys(("centre", "unit", "low", "high"), (nu,))
        shapes |= {f"weights_{k}": (m, w) for k, (w, m) in enumerate(itertools.pairwise(widths))}
        shapes |= {f"biases_{k}": (m,) for k, m in enumerate(widths[1:])}
        for name, array in known.items():
            if array.shape != shapes[name]:
                raise FileFormatError(name, expected=f"shape {shapes[name]}", actual=f"shape {array.shape}")
            if name not in ("low", "high") and not np.isfinite(array).all():
                raise FileFormatError(name, expected="finite numbers", actual="NaN or inf")
        positive = (known["spread"] > 0.0).all() and (known["unit"] > 0.0).all()
        if not positive or not (known["low"] < known["high"]).all():
            raise FileFormatError("network", expected="positive scales, and low < high", actual="others")
        layers = {kind: tuple(known[f"{kind}_{k}"] for k in range(n)) for kind in ("weights", "biases")}
        return cls(**{name: known[name] for name in _FIELDS}, weights=layers["weights"], biases=layers["biases"])


def multiply_adds(nz: int, nu: int, hidden: Sequence[int]) -> int:
    """Multiply-adds of a network of these sizes: scaling of states and inputs, the linear part, the layers."""
    widths = (nz, *hidden, nu)
    return nz + nu * nz + sum(m * n for n, m in itertools.pairwise(widths)) + nu


def widths_within(budget: int, nz: int, nu: int) -> tuple[int, int]:
    """Two hidden layers of the largest equal width, a multiple of two, that a budget of multiply-adds leaves.

    Raises:
        InvalidArgumentError: If not even four units a layer fit.
    """
    width = 4
    if multiply_adds(nz, nu, (width, width)) > budget:
        least = multiply_adds(nz, nu, (width, width))
        raise InvalidArgumentError(
            "multiply_adds", expected=f"at least {least} for {nz} states and {nu} inputs", actual=str(budget)
        )
    while multiply_adds(nz, nu, (width + 2, width + 2)) <= budget:
        width += 2
    return width, width


def _rounded(array: Array, digits: int) -> Array:
    return np.array([float(f"{v:.{digits - 1}e}") for v in array.ravel()], dtype=np.float64).reshape(array.shape)
