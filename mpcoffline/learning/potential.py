"""A potential Phi(s), which makes the stage cost of (FIT) richer and the MPC no harder to solve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from mpcoffline.core import limits
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.limits import check_limit


class Potential:
    """A quadratic polynomial without constant, in standardised coordinates of s.

    ::

        Phi(s) = sum_j c_j m_j((s - mean) / std),        m = all monomials of degree one and two

    Shaping replaces the stage cost by Lhat(s,a) + Phi(s) - gamma Phi(f(s,a)) and the terminal cost T by T + Phi (Ng,
    Harada, Russell, ICML 1999). Along a trajectory the terms telescope to the constant Phi(s_0), so the inputs are
    those of the MPC with Lhat and T: Theorem 1 (doi:10.1109/TAC.2019.2913768) holds with T + Phi = V*, hence
    T = V* - Phi, and Lhat has to explain less.

    Args:
        observations: States that decide the standardisation, ``(n, ny)``.
    """

    def __init__(self, observations: Tensor) -> None:
        std, self._mean = torch.std_mean(observations.double(), dim=0, correction=0)
        self._scale = torch.where(std > 0.0, std, 1.0)
        self._pairs = torch.triu_indices(len(self._mean), len(self._mean))
        self.coefficients: Tensor = torch.zeros(len(self._mean) + self._pairs.shape[1], dtype=torch.float64)

    def to_json(self) -> dict[str, list[float]]:
        """A JSON-able description."""
        return {"mean": self._mean.tolist(), "scale": self._scale.tolist(), "coefficients": self.coefficients.tolist()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Potential:
        """The inverse of :meth:`to_json`.

        Raises:
            FileFormatError: For other sizes, or numbers that are not finite.
        """
        n = len(data["mean"])
        check_limit("potential", "coordinates", n, limits.STATES)
        potential = cls(torch.zeros(1, n))
        arrays = {name: torch.tensor(data[name], dtype=torch.float64) for name in ("mean", "scale", "coefficients")}
        found = [(tuple(array.shape), bool(array.isfinite().all())) for array in arrays.values()]
        if found != [((n,), True), ((n,), True), ((len(potential.coefficients),), True)]:
            raise FileFormatError("potential", expected=f"finite numbers of {n} coordinates", actual=str(found))
        potential._mean, potential._scale, potential.coefficients = arrays.values()
        return potential

    def monomials(self, observations: Tensor) -> Tensor:
        """All m_j of observations ``(n, ny)``, shape ``(n, size)`` in float64."""
        z = (observations.double() - self._mean) / self._scale
        i, j = self._pairs
        return torch.cat([z, z[:, i] * z[:, j]], dim=1)

    def __call__(self, observations: Tensor) -> Tensor:
        """Phi of observations ``(n, ny)``, shape ``(n,)``."""
        return self.monomials(observations) @ self.coefficients
