"""A quadratic cost in features of the state."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError

from .component import COSTS, vector
from .cost import QuadraticCost, checked_tracks
from .expressions import function_from_json, function_to_json, traced
from .parameters import Block, ParameterSpace

Features = Callable[[ca.SX], ca.SX]


@COSTS.register("LiftedCost")
class LiftedCost(QuadraticCost):
    """The quadratic cost (COST) of arXiv:2301.01667 in features phi of the state.

    As a stage cost, with e = phi(x) - phi(x_ref) and v = u - u_ref::

        Lhat(x, u) = e'We + 2 e'Sv + v'Rv + constant,        [[W, S], [S', R]] positive semidefinite

    and as a terminal cost e'We + constant. It is at least the constant everywhere, and can follow a cost that no
    quadratic form in x can; it is linear in the weights, so that (FIT) stays as easy.

    Example:
        >>> cost = LiftedCost.of(QuadraticCost(W, R, x_ref=x_ref), polynomial_features(nx))

    Args:
        features: phi, ``(nx, 1) -> (m, 1)``, a function of CasADi expressions.
        x_ref: State reference, ``(nx,)``.
        W: Weight of the features, ``(m, m)``.
        R: Input weight, ``(nu, nu)``; without it inputs are free of cost.
        S: Cross weight, ``(m, nu)``; needs ``R``.
        u_ref: Input reference, ``(nu,)``; zero by default.
        constant: The offset theta_3 of (COST).
        D: Weight of changes of the inputs, ``(nu, nu)``, as in :class:`QuadraticCost`; needs ``R``.
        tracks: Which states follow which signals, likewise: x above is then the state with its distance there.

    Raises:
        InvalidArgumentError: If shapes do not fit, the weights are not symmetric positive semidefinite, or CasADi
            cannot evaluate the features.
    """

    convex: ClassVar[bool] = False

    def __init__(
        self,
        features: Features,
        x_ref: ArrayLike,
        W: ArrayLike,
        R: ArrayLike | None = None,
        S: ArrayLike | None = None,
        u_ref: ArrayLike | None = None,
        constant: float = 0.0,
        D: ArrayLike | None = None,
        tracks: Mapping[int, str] | None = None,
    ) -> None:
        super().__init__(W, R, S, u_ref=u_ref, constant=constant, D=D)
        n_features = self.nx
        self.nx = np.size(np.asarray(x_ref))
        self.tracks = checked_tracks(tracks or {}, self.nx)
        reference = Block.free("x_ref", vector("x_ref", x_ref, self.nx), "reference")
        self.space = ParameterSpace([reference if block.name == "x_ref" else block for block in self.space])
        self.features = _traced(features, self.nx)
        if self.features.numel_out(0) != n_features:
            raise InvalidArgumentError(
                "W", expected=f"a row for each of {self.features.numel_out(0)} features", actual=f"{n_features} rows"
            )

    @classmethod
    def of(cls, cost: QuadraticCost, features: Features) -> LiftedCost:
        """A quadratic cost as a lifted one of equal values: what learning may start from.

        Args:
            cost: The cost.
            features: Features of which the first nx are the state itself, e.g. of
                :func:`mpcoffline.mpc.polynomial_features`.

        Raises:
            InvalidArgumentError: If they are not.
        """
        values, nx, nu = cost.values, cost.nx, cost.nu
        phi = _traced(features, nx)
        x = np.linspace(0.3, 0.7, nx)
        if phi.numel_out(0) < nx or not np.allclose(phi(x).full().ravel()[:nx], x):
            raise InvalidArgumentError("features", expected=f"x as the first {nx}", actual="others")
        more = phi.numel_out(0) - nx
        W = scipy.linalg.block_diag(cost.W, np.zeros((more, more)))
        S = np.vstack([cost.S, np.zeros((more, nu))]) if "H" in values else None
        R, u_ref = (cost.R, values["u_ref"]) if nu else (None, None)
        constant = float(values["constant"])
        return cls(features, values["x_ref"], W, R, S, u_ref, constant, values.get("D"), cost.tracks)

    def _error(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """What W weighs: e = phi(x) - phi(x_ref)."""
        return self.features(x) - self.features(p["x_ref"])

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; the features as a list of instructions."""
        return super().to_json() | {"features": function_to_json(self.features)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of ``to_json``."""
        cost = super().from_json(data)
        cost.features = function_from_json(data["features"], "features", inputs=(cost.nx,), output=len(cost.W))
        return cost


def polynomial_features(nx: int, degree: int = 2) -> Features:
    """All monomials of the state from degree 1 to ``degree``: x itself first, then x_i x_j with i <= j, and so on.

    Args:
        nx: Number of states.
        degree: Highest degree.

    Raises:
        InvalidArgumentError: For a degree below 1.
    """
    check_integers(1, degree=degree)
    products = [
        chosen for d in range(1, degree + 1) for chosen in itertools.combinations_with_replacement(range(nx), d)
    ]

    def features(x: ca.SX) -> ca.SX:
        return ca.vertcat(*(math.prod((x[i] for i in chosen), start=ca.SX(1)) for chosen in products))

    return features


def _traced(features: Features, nx: int) -> ca.Function:
    """The features as an SX function."""
    x = ca.SX.sym("x", nx)
    try:
        column = ca.vec(ca.densify(ca.SX(features(x))))
    except (TypeError, NotImplementedError, RuntimeError) as error:
        raise InvalidArgumentError(
            "features",
            expected=f"a function of CasADi SX expressions of {nx} states",
            actual=f"{type(error).__name__}: {error}"[:200],
            hint="Use casadi.sin, casadi.vertcat ... instead of numpy and math.",
        ) from error
    return traced("features", ca.Function("features", [x], [column], ["x"], ["phi"]))
