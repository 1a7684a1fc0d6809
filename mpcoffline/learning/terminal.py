"""The terminal cost T of (MPC) from a learned value function.

By Theorem 1 of Gros & Zanon (doi:10.1109/TAC.2019.2913768) an MPC is optimal for any model if T = V* and the stage cost
fits. V itself is too large for the inner loop of a solver; here it becomes a quadratic cost, or a small network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
import scipy.optimize
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mpcoffline.core.checks import check_integers, check_known, check_number
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, MPCOfflineError
from mpcoffline.core.types import Array
from mpcoffline.mpc import NetworkCost, QuadraticCost, TerminalCost
from mpcoffline.mpc.networks import HIDDEN
from mpcoffline.mpc.scaling import spread_of

from .distillation import fit_network

StateFunction = Callable[[Tensor], Tensor]
TerminalKind = Literal["quadratic", "network"]

TERMINAL_KINDS = ("quadratic", "network")

_FLAT = 1e-6  # relative spread below which a coordinate counts as constant, in float32
_FLAT_DOUBLE = 1e-12  # the same where states have the digits of float64
_ROUNDINGS = 8.0  # of the largest V: a spread below is none
_ENDS = 0.05  # least share of the states where episodes end, which are few
_MAX_ERROR = 0.5  # of the spread of V: what is worse than this has learned nothing


@dataclass(frozen=True)
class DistillConfig:
    """How V becomes a network.

    Attributes:
        hidden: Widths of the hidden layers.
        max_rows: States that are learned from; a random subset where there are more.
        n_steps: Levenberg-Marquardt steps.
        batch_size: States a step.
    """

    hidden: tuple[int, ...] = HIDDEN
    max_rows: int = 50_000
    n_steps: int = 40
    batch_size: int = 4_096

    def __post_init__(self) -> None:
        check_integers(1, **{f"hidden[{i}]": width for i, width in enumerate(self.hidden)})
        check_integers(1, max_rows=self.max_rows, n_steps=self.n_steps, batch_size=self.batch_size)


@dataclass(frozen=True)
class TerminalError:
    """How far a terminal cost is from V.

    Attributes:
        rms: Root mean square of T - V, in the units of V.
        spread: Standard deviation of V.
        largest: Largest ``|T - V|``.
    """

    rms: float
    spread: float
    largest: float

    @property
    def relative(self) -> float:
        """The root mean square in units of the spread of V; of V itself where that is constant."""
        return self.rms / self.spread if self.spread > 0.0 else self.rms


def fit_terminal(
    kind: TerminalKind,
    value: StateFunction,
    observations: ArrayLike,
    *,
    x_ref: ArrayLike,
    seed: int,
    blend: float = 0.0,
    config: DistillConfig | None = None,
    ends: tuple[Array, Array] | None = None,
) -> TerminalCost:
    """A terminal cost T that is close to V on the data.

    ``"quadratic"`` is the positive semidefinite least-squares fit, a convex problem::

        q(x) = (x - x_ref)'W (x - x_ref) + c,      W, c = argmin E_D[ (V - q)^2 ],   W positive semidefinite

    ``"network"`` adds a small network that holds the rest, V - q, of which a part may be left out: the network is what
    local minima come from::

        T = q + (1 - blend) net,        net = argmin E_D[ (V - q - net)^2 ]

    Plans may end where no data are. There the network, whose output is bounded, says little, and q decides: the cost
    grows with the distance from the reference wherever W is not singular.

    Args:
        kind: ``"quadratic"`` or ``"network"``.
        value: V, from states ``(n, nx)`` to ``(n,)``; e.g. a :class:`~mpcoffline.learning.ValueFunction`. The states
            are float32, or float64 where the given ones have more digits.
        observations: States of the data, ``(n, nx)``.
        x_ref: Where q has its minimum, ``(nx,)``.
        seed: Seeds weights and minibatches; the same seed gives the same weights on the same machine.
        blend: Share of q in T, from 0 (T = V) to 1 (T = q).
        config: Size of the network and schedule.
        ends: States where episodes ended ``(k, nx)`` and T there ``(k,)``, where V is not defined.

    Returns:
        A :class:`~mpcoffline.QuadraticCost` or a :class:`~mpcoffline.NetworkCost` (the former also where V does not
        vary); :func:`terminal_error` says how
        close it is.

    Raises:
        UnknownIdError: For another kind.
        InvalidArgumentError: For a blend outside [0, 1], or states of another size than ``x_ref``.
        InvalidDataError: If states or their values are not finite.
        MPCOfflineError: If the network does not learn V.
    """
    check_known("terminal cost", kind, TERMINAL_KINDS)
    check_number("blend", blend, 0.0, 1.0, open_low=False)
    config = config or DistillConfig()
    reference = np.atleast_1d(np.asarray(x_ref, dtype=np.float64))
    states = _states(observations, len(reference))
    rng = np.random.default_rng(seed)
    states = states[np.sort(rng.permutation(len(states))[: config.max_rows])]
    targets, rounding = _values(value, states)
    if ends is not None:
        times = max(1, round(_ENDS * len(states) / len(ends[1])))
        states = np.concatenate([states, *[_states(ends[0], len(reference))] * times])
        targets = np.concatenate([targets, *[ends[1]] * times])
    W, constant = _fit_quadratic(states, reference, targets)
    if kind == "quadratic" or targets.std() <= rounding:  # a constant has nothing for a network
        return QuadraticCost(W, x_ref=reference, constant=constant)

    e = states - reference
    rest = targets - np.einsum("bi,ij,bj->b", e, W, e) - constant
    mean, std = states.mean(axis=0), spread_of(states, _flat(states))
    offset, scale = float(rest.mean()), float(rest.std() or targets.std())
    weights, biases = fit_network(
        (states - mean) / std,
        (rest - offset) / scale,
        config.hidden,
        rng=rng,
        n_steps=config.n_steps,
        batch_size=config.batch_size,
    )

    def with_network(share: float) -> NetworkCost:
        level = constant + share * offset
        return NetworkCost(weights, biases, mean=mean, std=std, offset=level, scale=share * scale, W=W, x_ref=reference)

    _check_learned(_error(with_network(1.0), states, targets))
    return with_network(1.0 - blend)


def terminal_error(cost: TerminalCost, value: StateFunction, observations: ArrayLike) -> TerminalError:
    """How far a terminal cost is from V on some states.

    Args:
        cost: The terminal cost T.
        value: V, as in :func:`fit_terminal`.
        observations: The states, ``(n, nx)``.

    Raises:
        InvalidDataError: If states or their values are not finite.
    """
    states = _states(observations)
    return _error(cost, states, _values(value, states)[0])


def _error(cost: TerminalCost, states: Array, targets: Array) -> TerminalError:
    """How far it is from targets ``(n,)`` at states ``(n, nx)``."""
    x, theta = ca.SX.sym("x", states.shape[1]), ca.SX.sym("theta", cost.space.size)
    T = ca.Function("T", [x, theta], [cost.terminal_expression(x, cost.space.symbols(theta))])
    errors = T(states.T, cost.space.theta).full().ravel() - targets
    return TerminalError(float(np.sqrt(np.mean(errors**2))), float(targets.std()), float(np.abs(errors).max()))


def _states(observations: ArrayLike, nx: int | None = None) -> Array:
    """The observations as float64 ``(n, nx)``."""
    states = np.asarray(observations, dtype=np.float64)
    if states.ndim != 2 or len(states) == 0 or nx not in (None, states.shape[1]):
        raise InvalidArgumentError("observations", expected=f"shape (n, {nx or 'nx'})", actual=f"shape {states.shape}")
    if not np.isfinite(states).all():
        raise InvalidDataError("observations", expected="finite numbers", actual="NaN or inf")
    return states


def _narrowed(states: Array) -> NDArray[np.floating[Any]]:
    """The states in float32, where that holds them."""
    narrow = states.astype(np.float32)
    return narrow if np.array_equal(narrow, states) else states


def _flat(states: Array) -> float:
    """The relative spread below which a coordinate of these states counts as constant."""
    return _FLAT if _narrowed(states).dtype == np.float32 else _FLAT_DOUBLE


def _values(value: StateFunction, states: Array) -> tuple[Array, float]:
    """V of states ``(n, nx)`` in float64, ``(n,)``, and what may be rounding of the largest."""
    with torch.no_grad():
        found = value(torch.from_numpy(_narrowed(states)))
        values = found.double().numpy()
    if values.shape != states.shape[:1] or not np.isfinite(values).all():
        raise InvalidDataError(
            "value", expected=f"{len(states)} finite numbers", actual=f"shape {values.shape}, or NaN or inf in it"
        )
    return np.asarray(values), _ROUNDINGS * torch.finfo(found.dtype).eps * float(np.abs(values).max())


def _fit_quadratic(states: Array, x_ref: Array, targets: Array) -> tuple[Array, float]:
    """W and c of the positive semidefinite least-squares fit of e'We + c, e = x - x_ref, to targets ``(n,)``.

    With W = C C' the loss has no local minima that are not global; it is a polynomial whose coefficients are gathered
    from the data once.
    """
    n, nx = states.shape
    e = states - x_ref
    size = np.sqrt(np.mean(e**2, axis=0))
    size = np.where(
        size > _flat(states) * np.abs(states).max(axis=0), size, np.inf
    )  # what stays at x_ref gets no weight
    spread = float(targets.std()) or 1.0
    products = np.einsum("bi,bj->bij", e / size, e / size).reshape(n, -1)
    mean_products, mean_target = products.mean(axis=0), targets.mean()
    centred = products - mean_products
    gram = centred.T @ centred / n
    moment = centred.T @ ((targets - mean_target) / spread) / n

    def objective(flat: Array) -> tuple[float, Array]:
        C = flat.reshape(nx, nx)
        w = (C @ C.T).ravel()
        slope = 2.0 * (gram @ w - moment).reshape(nx, nx)
        return float(w @ gram @ w - 2.0 * moment @ w), ((slope + slope.T) @ C).ravel()

    start: Array = np.eye(nx).ravel()
    found = scipy.optimize.minimize(
        objective, start, jac=True, method="L-BFGS-B", options={"maxiter": 2_000, "ftol": 1e-15, "gtol": 1e-10}
    )
    C = spread**0.5 * found.x.reshape(nx, nx)
    W = (C @ C.T) / np.outer(size, size)
    return W, float(mean_target - (C @ C.T).ravel() @ mean_products)


def _check_learned(error: TerminalError) -> None:
    if not error.relative <= _MAX_ERROR:
        raise MPCOfflineError(
            "terminal cost",
            expected=f"a network within {_MAX_ERROR:.0%} of the spread of V",
            actual=f"an error of {error.relative:.0%}",
            hint="Give more data or a larger network, or take kind='quadratic'.",
        )
