"""Models that the log does not tell from the plant: where they disagree about a controller, so may the plant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.estimation.identification import OneStepIdentification, OneStepProblem, Rows, without_jumps
from mpcoffline.estimation.plant import plant_rows
from mpcoffline.mpc import MPC
from mpcoffline.mpc.torch_twin import TorchTwin

_BOOTSTRAP_ROWS = 3_000
_N_FEATURES = 100
_RESIDUAL_RIDGE = 1e-3
_LEAST_PERTURBATION = 0.02  # of the increments' spread
_FARTHEST = 0.3  # in scaled coordinates
_FEW_EPISODES = 5
_ITERATIONS = 20
_WEAKEST_PRIOR = 1e-8


class _Residual(NamedTuple):
    """What a member adds to the model: a function of (x, u) that explains a part of what the model misses."""

    features: RandomFeatures
    regression: Ridge
    limit: Array  # the largest it was fitted to; it says no more outside the data, (nx,)

    def __call__(self, x: Array, u: Array) -> Array:
        return np.clip(self.regression(self.features(np.hstack([x, u]))), -self.limit, self.limit)


class Ensemble:
    """The identified model and variations of it, stepped together.

    * member 0: the identified model;
    * then ``n_perturbed`` models identified from resampled episodes, with parameters moved at random by as much as
      changes the prediction by what the identified model misses (at least 2 % of an increment);
    * then ``n_residual`` models identified from resampled episodes, with a random-feature regression of what they miss.

    Args:
        mpc: The MPC whose model it is.
        table: The transitions of its states, past inputs included; smoothed, where they were noisy.
        identification: The identified model.
        n_perturbed: See above.
        n_residual: See above.
        seed: Seeds the resampling.
    """

    def __init__(
        self,
        mpc: MPC,
        table: TransitionTable,
        identification: OneStepIdentification,
        *,
        n_perturbed: int = 5,
        n_residual: int = 5,
        seed: int = 0,
    ) -> None:
        self._twin, self._layout = TorchTwin(mpc.plant_function), mpc.layout
        table = plant_rows(mpc, table)
        rng = np.random.default_rng(seed)
        problem = _problem_of(mpc.with_theta(identification.theta), table, identification)
        episodes = _Episodes(table)
        thetas = [identification.theta]
        self._residuals: list[_Residual | None] = [None] * (1 + n_perturbed)
        for i in range(n_perturbed + n_residual):
            resampled = problem.on(episodes.resampled(problem.rows, rng))
            z = _reidentified(resampled, identification.error_after)
            if i < n_perturbed:
                z = _perturbed(resampled, z, identification.error_after, rng)
            else:
                self._residuals.append(_missed(resampled, z, rng))
            thetas.append(np.clip(resampled.theta(z), mpc.space.low, mpc.space.high))
        self.thetas = np.stack(thetas)

    def __len__(self) -> int:
        """Number of members."""
        return len(self.thetas)

    def step(self, x: Array, u: Array) -> Array:
        """The successors of states ``(members, starts, nx)`` under inputs ``(members, starts, nu)``, each its own."""
        states, acting = self._layout.split(x, u)
        with torch.no_grad():
            theta = torch.from_numpy(self.thetas[:, None])
            reached: Array = self._twin(*(torch.from_numpy(np.array(v)) for v in (states, acting)), theta).numpy()
        for i, residual in enumerate(self._residuals):
            if residual is not None:
                reached[i] += residual(states[i], acting[i])
        return self._layout.joined(reached, x, u)


class _Episodes:
    """The episodes of a table, to be drawn with replacement; single rows where there are hardly any episodes."""

    def __init__(self, table: TransitionTable) -> None:
        self._n_rows = len(table)
        ids, self._first, self._length = table.episodes
        if len(ids) < _FEW_EPISODES:
            self._first, self._length = np.arange(len(table)), np.ones(len(table), dtype=np.int64)

    def resampled(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """As many rows as there are, or some thousand."""
        wanted = min(self._n_rows, _BOOTSTRAP_ROWS)
        drawn = rng.integers(len(self._first), size=1 + int(2 * wanted / self._length.mean()))
        pieces = [np.arange(self._first[k], self._first[k] + self._length[k]) for k in drawn]
        chosen = np.concatenate(pieces)[:wanted]
        return Rows(*(part[chosen] for part in rows))


def _problem_of(mpc: MPC, table: TransitionTable, identification: OneStepIdentification) -> OneStepProblem:
    """One-step prediction on the whole table, wrapped angles without jumps."""
    columns = table.values()
    rows = Rows(columns.observations, columns.actions, columns.next_observations)
    centre = table.centring.centre[: table.ny]
    problem = OneStepProblem(mpc, rows, centre)
    if not identification.unwrapped:
        return problem
    return OneStepProblem(mpc, without_jumps(rows, problem.errors(mpc.theta) * problem.scale)[0], centre)


def _reidentified(problem: OneStepProblem, error: float) -> Array:
    """The parameters that fit these rows best, near the identified ones where they do not matter."""
    start = np.zeros(len(problem.free))
    if not len(start):
        return start
    found = problem.descend(start, max(error**2, _WEAKEST_PRIOR) / len(problem.rows.x), _ITERATIONS)
    return np.asarray(found.z)


def _perturbed(problem: OneStepProblem, z: Array, error: float, rng: np.random.Generator) -> Array:
    """Moved at random, in all directions by as much as changes the prediction by what the model misses."""
    if not len(z):
        return z
    jacobian = problem.linearised(z)[1]
    information = np.einsum("nip,niq->pq", jacobian, jacobian, optimize=True) / jacobian[..., 0].size
    strengths, directions = np.linalg.eigh(information)
    size = max(error, _LEAST_PERTURBATION)
    sigma = size / np.sqrt(np.maximum(strengths, (size / _FARTHEST) ** 2))
    move = directions @ (sigma * rng.standard_normal(len(z))) / np.sqrt(len(z))
    return np.asarray(np.clip(z + move, problem.low, problem.high))


def _missed(problem: OneStepProblem, z: Array, rng: np.random.Generator) -> _Residual:
    """A regression of what the model misses on these rows."""
    rows = problem.rows
    missed = -problem.errors(problem.theta(z)) * problem.scale
    inputs = np.hstack([rows.x, rows.u])
    features = RandomFeatures(inputs, _N_FEATURES, rng, multiplied=0)
    regression = Ridge.fit(features(inputs), missed, _RESIDUAL_RIDGE)
    return _Residual(features, regression, np.quantile(np.abs(missed), 0.999, axis=0))
