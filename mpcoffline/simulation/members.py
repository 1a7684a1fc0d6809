"""The maps of several models of one plant, evaluated together, and how those that are identified anew come about."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Residual
from mpcoffline.estimation.identification import OneStepProblem
from mpcoffline.estimation.rows import Rows
from mpcoffline.mpc import MPC
from mpcoffline.mpc.integrators import Scheme
from mpcoffline.mpc.row_twin import RowTwin
from mpcoffline.mpc.substeps import Flow, choice_on

_ROWS = 3_000  # on which the parameters are identified
_LEAST_MOVE = 0.02  # of the increments' spread
_FARTHEST = 0.3  # in scaled coordinates
_FEW_EPISODES = 5
_ITERATIONS = 20
_WEAKEST_PRIOR = 1e-8
_FARTHER, _FAR_ROWS = 2.0, 500
_FINEST = 16  # substeps


class Members:
    """One plant map with several theta, the last ones with a learned residual each.

    Args:
        mpc: The MPC whose model it is.
        thetas: All its parameters, one row a member, ``(m, size)``.
        residuals: Those of the last members; all have a network, of the same outputs.
        kept: Move successors to where states can be, one after the other.
    """

    thetas: Array

    def __init__(
        self,
        mpc: MPC,
        thetas: Array,
        residuals: Sequence[Residual],
        kept: Sequence[Callable[[Array], Array]] = (),
    ) -> None:
        self._mpc, self._residuals, self._kept = mpc, residuals, kept
        self._twin, self.thetas = RowTwin(mpc.plant_function), thetas
        self._networks = _Networks(residuals) if residuals else None

    def some(self, kept: NDArray[np.bool_]) -> Members:
        """Some of them, ``(m,)`` of truth values."""
        first = len(self) - len(self._residuals)
        residuals = [each for each, keep in zip(self._residuals, kept[first:], strict=True) if keep]
        return Members(self._mpc, self.thetas[kept], residuals, self._kept)

    def __len__(self) -> int:
        """Number of members."""
        return len(self.thetas)

    def __call__(self, x: Array, u: Array) -> Array:
        """The successors of plant states ``(m, n, n_states)`` under what acts ``(m, n, nu)``, each member its own."""
        reached = self._twin(x, u, self.thetas[:, None])
        if self._networks is not None:
            first = len(self) - len(self._networks)
            reached[first:, :, self._networks.outputs] += self._networks(np.concatenate([x, u], axis=2)[first:])
        for keep in self._kept:
            reached = keep(reached)
        return np.asarray(reached)


class _Networks:
    """Networks of one shape, evaluated together; see :class:`~mpcoffline.estimation.small_network.SmallNetwork`."""

    def __init__(self, residuals: Sequence[Residual]) -> None:
        networks = [r.network for r in residuals if r.network is not None]
        gates = [network.gate for network in networks]
        self.outputs = np.flatnonzero(residuals[0].outputs)
        self._mean, self._slope, self._limit, unit = (
            np.stack(parts)[:, None]
            for parts in (
                [gate.mean for gate in gates],
                [gate.slope for gate in gates],
                [network.limit for network in networks],
                [r.unit[self.outputs] for r in residuals],
            )
        )
        self._limit = self._limit * unit
        self._K = np.stack([gate.K.T for gate in gates])
        layers = zip(*(zip(network.weights, network.biases, strict=True) for network in networks), strict=True)
        self._layers = [
            (np.stack([A.T for A, _ in layer]), np.stack([b for _, b in layer])[:, None]) for layer in layers
        ]

    def __len__(self) -> int:
        return len(self._K)

    def __call__(self, data: Array) -> Array:
        """The outputs ``(m, n, k)`` at inputs ``(m, n, d)``."""
        z = (data - self._mean) * self._slope
        far = np.square(z @ self._K).sum(axis=2, keepdims=True)
        for A, b in self._layers:
            a = z @ A + b
            z = a / np.sqrt(1.0 + a * a)
        return np.asarray(self._limit * z / (1.0 + far**4))


def finer(mpc: MPC, x: Array, u: Array) -> MPC:
    """An MPC whose model takes as many substeps as states twice as far out as the logged ones ask for.

    The model's own are enough where the log was. Simulations go on from there, and what is faster there blows up though
    the plant does not. It stays as it is where the user has said how it is integrated.

    Args:
        mpc: The MPC.
        x: Logged states of the plant, ``(N, n)``.
        u: What acted on them, ``(N, m)``.
    """
    model = mpc.model
    if model.integrator != "auto" or model.ode is None or model.scheme is None or model.scheme.kind == "exact":
        return mpc
    some = np.linspace(0, len(x) - 1, min(len(x), _FAR_ROWS)).astype(np.intp)
    far, u = x.mean(axis=0) + _FARTHER * (x[some] - x.mean(axis=0)), u[some]
    flow, now = Flow(model.ode, model.dt, model.space.theta), model.scheme.substeps
    reached = flow(far, u, flow.most)
    known = np.isfinite(reached).all(axis=1)
    if not known.any():
        return mpc
    needed = choice_on(flow, far[known], u[known], reached[known], now).substeps
    return mpc.replace(model=model.with_scheme(Scheme("rk4", max(now, min(needed, _FINEST)))))


def moved_parameters(
    problem: OneStepProblem, table: TransitionTable, count: int, rng: np.random.Generator
) -> list[Array]:
    """Parameters identified from resampled episodes, and moved at random; none for a model without parameters.

    In all directions by as much as changes the prediction by what the identified model misses, and by at least 2 % of
    an increment.

    Args:
        problem: One-step prediction on the table, theta_0 being what was identified.
        table: What episodes are drawn from.
        count: How many.
        rng: Draws.
    """
    if not len(problem.free):
        return []
    z_0, thetas = np.zeros(len(problem.free)), []
    error = float(np.sqrt(np.mean(np.minimum(problem.linearised(z_0)[0] ** 2, 1.0))))
    for _ in range(count):
        rows = _resampled(table, rng)
        resampled = problem.on(Rows(*(part[rows] for part in problem.rows)))
        try:
            z = resampled.descend(z_0, max(error**2, _WEAKEST_PRIOR) / len(rows), _ITERATIONS).z
        except InvalidDataError:  # the model makes nothing of these rows
            z = z_0
        thetas.append(problem.theta(_perturbed(resampled, z, error, rng)))
    return thetas


def _resampled(table: TransitionTable, rng: np.random.Generator) -> NDArray[np.intp]:
    """Rows of episodes drawn with replacement: as many as there are, or some thousand; single ones of few episodes."""
    wanted = min(len(table), _ROWS)
    ids, first, length = table.episodes
    if len(ids) < _FEW_EPISODES:
        return rng.integers(len(table), size=wanted)
    drawn = rng.integers(len(ids), size=1 + int(2 * wanted / length.mean()))
    return np.concatenate([first[k] + np.arange(length[k]) for k in drawn])[:wanted]


def _perturbed(problem: OneStepProblem, z: Array, error: float, rng: np.random.Generator) -> Array:
    """Moved in all directions by as much as changes the prediction by what the model misses."""
    jacobian = problem.linearised(z)[1]
    information = np.einsum("nip,niq->pq", jacobian, jacobian, optimize=True) / jacobian[..., 0].size
    strengths, directions = np.linalg.eigh(information)
    size = max(error, _LEAST_MOVE)
    sigma = size / np.sqrt(np.maximum(strengths, (size / _FARTHEST) ** 2))
    move = directions @ (sigma * rng.standard_normal(len(z))) / np.sqrt(len(z))
    return np.asarray(np.clip(z + move, problem.low, problem.high))
