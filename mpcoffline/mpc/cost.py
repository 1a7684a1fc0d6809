"""Stage and terminal costs of (MPC): (COST) with an optional cross term, and (TERM)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array

from .component import COSTS, Component, blocks_from_json, difference, numbers, vector
from .parameters import Block, ParameterSpace
from .signals import Named


@COSTS.register("QuadraticCost")
class QuadraticCost(Component):
    """The quadratic cost (COST) of arXiv:2301.01667, optionally with a cross term.

    As a stage cost, with e = x - x_ref and v = u - u_ref::

        Lhat(x, u) = e'We + 2 e'Sv + v'Rv + constant,        [[W, S], [S', R]] positive semidefinite

    and as a terminal cost e'We + constant. Without ``S`` the matrices W and R are parameters of their own
    (the paper's form); with ``S`` the whole matrix H = [[W, S], [S', R]] is one.

    With ``D`` a stage cost has a price on changes of the inputs besides (do-mpc's ``rterm``)::

        (u - u_before)'D(u - u_before),        D positive semidefinite

    where ``u_before`` is the input of the step before, which the MPC then carries in its state.

    Args:
        W: State weight, ``(nx, nx)``.
        R: Input weight, ``(nu, nu)``; without it inputs are free of cost.
        S: Cross weight, ``(nx, nu)``; needs ``R``.
        x_ref: State reference, ``(nx,)``; zero by default.
        u_ref: Input reference, ``(nu,)``; zero by default.
        constant: The offset theta_3 of (COST).
        D: Weight of changes of the inputs, ``(nu, nu)``; needs ``R``.
        tracks: Which states follow which signals, ``{1: "set_point"}``: e_1 = x_1 - d.set_point - x_ref_1.

    Raises:
        InvalidArgumentError: If shapes do not fit, what tracks a signal is no state, or the weights are not symmetric
            positive semidefinite.
    """

    convex: ClassVar[bool] = True

    def __init__(
        self,
        W: ArrayLike,
        R: ArrayLike | None = None,
        S: ArrayLike | None = None,
        x_ref: ArrayLike | None = None,
        u_ref: ArrayLike | None = None,
        constant: float = 0.0,
        D: ArrayLike | None = None,
        tracks: Mapping[int, str] | None = None,
    ) -> None:
        weight = np.atleast_2d(numbers("W", W))
        nx = weight.shape[0]
        blocks: list[Block] = []
        nu = 0
        if R is None:
            if S is not None or u_ref is not None or D is not None:
                raise InvalidArgumentError("R", expected="a matrix, as S, D or u_ref is given", actual="None")
            blocks.append(Block.psd("W", weight, "cost"))
        else:
            input_weight = np.atleast_2d(numbers("R", R))
            nu = input_weight.shape[0]
            blocks += _weight_blocks(weight, input_weight, S)
            if D is not None:
                change_weight = np.atleast_2d(numbers("D", D))
                if change_weight.shape != (nu, nu):
                    raise InvalidArgumentError("D", expected=f"shape {(nu, nu)}", actual=f"shape {change_weight.shape}")
                blocks.append(Block.psd("D", change_weight, "cost"))
            blocks.append(Block.free("u_ref", vector("u_ref", u_ref, nu), "reference"))
        blocks.append(Block.free("x_ref", vector("x_ref", x_ref, nx), "reference"))
        offset = numbers("constant", constant)
        if offset.ndim > 0:
            raise InvalidArgumentError("constant", expected="one number", actual=f"shape {offset.shape}")
        blocks.append(Block.free("constant", offset, "cost"))
        self.nx, self.nu, self.tracks = nx, nu, checked_tracks(tracks or {}, nx)
        self.space = ParameterSpace(blocks)

    @property
    def uses_signals(self) -> bool:
        """Whether a state follows a signal."""
        return bool(self.tracks)

    @property
    def W(self) -> Array:
        """State weight, ``(nx, nx)``."""
        return self._weights()[: -self.nu or None, : -self.nu or None]

    @property
    def R(self) -> Array:
        """Input weight, ``(nu, nu)``."""
        n = len(self.W)
        return self._weights()[n:, n:]

    @property
    def S(self) -> Array:
        """Cross weight, ``(nx, nu)``; zero when it is not a parameter."""
        n = len(self.W)
        return self._weights()[:n, n:]

    @property
    def uses_previous(self) -> bool:
        """Whether changes of the inputs have a price."""
        return "D" in self.values

    def _weights(self) -> Array:
        """The matrix H ``(nx + nu, nx + nu)``."""
        values = self.values
        if "H" in values:
            return values["H"]
        return scipy.linalg.block_diag(values["W"], values["R"]) if "R" in values else values["W"]

    def expression(
        self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX], previous: ca.SX | None = None, d: Named | None = None
    ) -> ca.SX:
        """(COST) as a CasADi scalar; ``p["W"]`` is the factor C of W = C C', so that ``e'We = |C'e|^2``.

        Args:
            x: State, ``(nx, 1)``.
            u: Inputs, ``(nu, 1)``.
            p: The parameters.
            previous: The inputs of the step before, ``(nu, 1)``; where there is no ``D``, they are not asked for.
            d: The present signals; where nothing tracks one, they are not asked for.
        """
        cost = self._stationary(self._away(x, d), u, p)
        if previous is not None and "D" in p:
            cost = cost + ca.sumsqr(p["D"].T @ difference("u", u, previous))
        return cost

    def _stationary(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """(COST) without what changes of the inputs cost."""
        e = self._error(x, p)
        if "H" in p:
            return ca.sumsqr(p["H"].T @ ca.vertcat(e, difference("u", u, p["u_ref"]))) + p["constant"]
        cost = ca.sumsqr(p["W"].T @ e) + p["constant"]
        if "R" in p:
            cost += ca.sumsqr(p["R"].T @ difference("u", u, p["u_ref"]))
        return cost

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX], d: Named | None = None) -> ca.SX:
        """The terminal cost e'We + constant as a CasADi scalar."""
        e = self._error(self._away(x, d), p)
        factor = p["W"] if "W" in p else p["H"][: e.numel(), :]
        return ca.sumsqr(factor.T @ e) + p["constant"]

    def _error(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """What W weighs: e = x - x_ref."""
        return difference("x", x, p["x_ref"])

    def _away(self, x: ca.SX, d: Named | None) -> ca.SX:
        """The state, those that track a signal as their distance from it."""
        if d is None or not self.tracks:
            return x
        return x - ca.vertcat(*(d[self.tracks[i]] if i in self.tracks else 0.0 for i in range(x.numel())))

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""
        return super().to_json() | {"tracks": [[i, name] for i, name in self.tracks.items()]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of ``to_json``."""
        cost = cls.__new__(cls)
        cost.space = blocks_from_json(data)
        values = cost.values
        cost.nx = len(values["x_ref"])
        cost.nu = len(values["u_ref"]) if "u_ref" in values else 0
        cost.tracks = checked_tracks(dict(data["tracks"]), cost.nx)
        return cost


@COSTS.register("NormCost")
class NormCost(Component):
    """The terminal cost (TERM) of arXiv:2301.01667: the 2-norm of the distance to the reference, not squared.

    The norm has a kink at the reference, at which Newton's method fails; it is smoothed::

        T(x) = sqrt(|x - x_ref|^2 + eps^2) - eps

    which lies at most ``eps`` below the norm and vanishes at the reference.

    Args:
        x_ref: Reference, ``(nx,)``.
        eps: Smoothing, in the units of x: 0.1 suits states of size 1. Newton solvers get slow below a hundredth of
            their size; where gamma^N is small, a tenth is as good.

    Raises:
        InvalidArgumentError: If ``eps`` is not positive.
    """

    convex: ClassVar[bool] = True

    def __init__(self, x_ref: ArrayLike, eps: float = 0.1) -> None:
        if not (np.isfinite(eps) and eps > 0.0):
            raise InvalidArgumentError("eps", expected="a positive number", actual=str(eps))
        reference = np.atleast_1d(numbers("x_ref", x_ref))
        self.nx, self.eps = len(reference), float(eps)
        self.space = ParameterSpace([Block.free("x_ref", reference, "reference")])

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """(TERM), smoothed, as a CasADi scalar."""
        return ca.sqrt(ca.sumsqr(difference("x", x, p["x_ref"])) + self.eps**2) - self.eps

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""
        return super().to_json() | {"eps": self.eps}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> NormCost:
        """The inverse of ``to_json``."""
        cost = cls(np.zeros(1), float(data["eps"]))
        cost.space = blocks_from_json(data)
        cost.nx = len(cost.values["x_ref"])
        return cost


def checked_tracks(tracks: Mapping[int, str], nx: int) -> dict[int, str]:
    """Which of nx states follow which signals.

    Raises:
        InvalidArgumentError: For what is no state, or no name.
    """
    for i, name in tracks.items():
        if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < nx or not isinstance(name, str):
            raise InvalidArgumentError("tracks", expected=f"names of signals by state, 0 to {nx - 1}", actual=f"{i!r}")
    return dict(tracks)


def _weight_blocks(W: Array, R: Array, S: ArrayLike | None) -> list[Block]:
    """W and R as blocks of their own, or one block H when there is a cross term."""
    if S is None:
        return [Block.psd("W", W, "cost"), Block.psd("R", R, "cost")]
    cross = numbers("S", S)
    if cross.shape != (len(W), len(R)):
        raise InvalidArgumentError("S", expected=f"shape {(len(W), len(R))}", actual=f"shape {cross.shape}")
    for name, matrix in (("W", W), ("R", R)):
        if matrix.shape[0] != matrix.shape[1]:
            raise InvalidArgumentError(name, expected="a square matrix", actual=f"shape {matrix.shape}")
    return [Block.psd("H", np.block([[W, cross], [cross.T, R]]), "cost")]
