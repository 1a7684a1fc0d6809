"""Models of a log: where they disagree about a controller, so may the plant; and how well each predicts the log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import fit_residuals
from mpcoffline.estimation.identification import OneStepIdentification, OneStepProblem
from mpcoffline.estimation.multi_step import Windows
from mpcoffline.estimation.plant import plant_rows, state_rows
from mpcoffline.estimation.rows import FULL_TURN, Rows, without_jumps
from mpcoffline.estimation.structure import HeldOut
from mpcoffline.estimation.trajectories import Trajectories
from mpcoffline.mpc import MPC
from mpcoffline.mpc.layout import Layout

from .invariants import Invariants
from .members import Members, finer, moved_parameters
from .stops import Stops

STEPS = 15  # that are predicted open loop to judge a model
VOTES = 1.5  # times the error of the best that one with a vote has at most
NEGLIGIBLE = 0.02  # spreads: of errors below, none is better than another

_EXCERPT = 20_000  # rows that models are learned from and judged on
_ROWS = 3_000  # that say what an outlier is
_WINDOWS = 400
_FEWEST = 10  # that are enough to judge by
_STARTS = 3  # windows begin so many times a length
_DIVERGED = 1e2  # spreads
_LOST = 0.05  # share of the windows that diverge, from which on a model does
_CLIPPED = 0.995  # quantile of a member's one-step errors, beyond which a logged one is an outlier


@dataclass(frozen=True)
class LogModels:
    """The identified model and others that the log may mean as well, stepped together; each judged by the log.

    * ``identified``: the identified model;
    * ``moved 1`` and so on: identified from resampled episodes, with parameters moved at random by as much as changes
      the prediction by what the identified model misses (at least 2 % of an increment);
    * ``residual 1`` and so on: the identified model with a small network of what it misses, learned from resampled
      episodes (:func:`~mpcoffline.estimation.fit_residuals`), zero outside the data.

    All are kept on the equations that the states of log and model satisfy, as that of cosine and sine
    (:class:`~mpcoffline.simulation.invariants.Invariants`), and within the stops that the log shows
    (:class:`~mpcoffline.simulation.stops.Stops`).

    A quarter of the episodes is held out of all fits but the identified model's: there each predicts 15 steps open
    loop, from logged states under logged inputs.

    Attributes:
        names: Those of the members, ``(m,)``.
        errors: Root mean square error of these predictions in spreads of the states, ``(m,)``; inf for a model that
            diverges.
        baseline: The same of the best of three that know no physics: the state stays, goes on by the log's mean
            increment, is the log's mean.
        noise: Standard deviation of the measurement noise that a policy would see, in units, ``(n_states,)``; 0 where
            it is negligible or not known.
        members: The maps.
        layout: What the MPC's state is made of.
        wrapped: States that are wrapped angles, and where their turn begins.
    """

    names: tuple[str, ...]
    errors: Array
    baseline: float
    noise: Array
    members: Members
    layout: Layout
    wrapped: tuple[NDArray[np.intp], Array]

    @classmethod
    def of(
        cls,
        mpc: MPC,
        table: TransitionTable,
        found: OneStepIdentification | None,
        *,
        seed: int = 0,
        n_perturbed: int = 5,
        n_residual: int = 5,
        believed: Callable[[TransitionTable], NDArray[np.bool_]] | None = None,
    ) -> LogModels:
        """Builds the members and judges them.

        Args:
            mpc: The MPC with the identified model; with the given one, where it could not be identified.
            table: The transitions of its states, past inputs included; smoothed, where they were noisy.
            found: What was identified; None where nothing could be.
            seed: Seeds draws and networks.
            n_perturbed: Number of moved models; none for a model without parameters.
            n_residual: Number of models with networks; none where the identified one misses nothing.
            believed: Tells the rows of a table in which the plant took the logged input: where it cut that off, a model
                would learn an input that does less than it does. All by default.

        Raises:
            InvalidDataError: If the data have other dimensions than the MPC.
        """
        states, rng = excerpt(state_rows(mpc, table), _EXCERPT, seed), np.random.default_rng(seed)
        rows, held_out = plant_rows(mpc, states), HeldOut.of(states.episode_ids, seed).rows
        mpc = finer(mpc, *(np.asarray(each, dtype=np.float64) for each in (rows.observations, rows.actions)))
        free = np.flatnonzero(~held_out)
        problem, unwrapped = _problem(mpc, rows.take(free))
        x, u, reached = problem.rows
        invariants = Invariants.of(x, u, lambda x, u: problem.model.predict(x, u, mpc.theta), seed)
        usable = np.ones(len(states), dtype=bool) if believed is None else believed(states)
        stops = Stops.of(x, reached, problem.model.predict(x, u, mpc.theta), ~usable[free])
        fitting = usable[free] & ~stops.hit(reached)  # what happens at a stop is no model's business
        if not fitting.all() and fitting.any():
            free = free[fitting]
            problem = _problem(mpc, rows.take(free))[0]
        used = rows.take(free)
        thetas = [mpc.theta, *moved_parameters(problem, used, n_perturbed, rng)]
        residuals = fit_residuals(mpc, states.take(free), seed, count=n_residual)
        networks = [each for each in residuals if each.network is not None]
        names = ["identified" if found is not None else "given", *(f"moved {i}" for i in range(1, len(thetas)))]
        names += [f"residual {i}" for i in range(1, len(networks) + 1)]
        maps = np.stack([*thetas, *[mpc.theta] * len(networks)])
        members = Members(mpc, maps, networks, (invariants.projected, stops.kept))
        judging = held_out & usable
        errors, baseline = _judged(mpc, members, rows, judging if judging.any() else held_out, unwrapped)
        noise = np.zeros(mpc.layout.n_states)
        known = getattr(found, "noise", None)
        if known is not None and not known.negligible:
            noise = np.asarray(known.measurement, dtype=np.float64)
        angles = np.array(unwrapped, dtype=np.intp)
        turning = rows.observations[:, angles].astype(np.float64)
        middle = (turning.min(axis=0) + turning.max(axis=0)) / 2.0
        return cls(
            tuple(names), errors, baseline, noise, members, mpc.layout, (angles, np.asarray(middle) - FULL_TURN / 2.0)
        )

    def __len__(self) -> int:
        """Number of members."""
        return len(self.names)

    @property
    def votes(self) -> NDArray[np.bool_]:
        """Which have a say, ``(m,)``: errors within 1.5 times the smallest, or next to nothing.

        None has, where the smallest is not below the baseline.
        """
        best = float(np.min(self.errors))
        return np.asarray((self.errors <= VOTES * max(best, NEGLIGIBLE)) & (best < self.baseline))

    def asked(self, most: int | None = None, *, identified: bool = True) -> LogModels:
        """Those that have a vote, no more than the best of some number, and the identified one.

        Args:
            most: The number; all by default.
            identified: Whether that one is kept, whatever it predicts. It is where no other one has a vote.
        """
        kept, best = self.votes, np.argsort(self.errors, kind="stable")
        kept[best[len(best) if most is None else most :]] = False
        kept[0] |= identified or not kept.any()
        return self.some(np.flatnonzero(kept))

    def some(self, numbers: NDArray[np.intp]) -> LogModels:
        """Some of them, by number, in their order."""
        kept = np.isin(np.arange(len(self)), numbers)
        names = tuple(name for name, keep in zip(self.names, kept, strict=True) if keep)
        return replace(self, names=names, errors=self.errors[kept], members=self.members.some(kept))

    def step(self, x: Array, u: Array) -> Array:
        """The successors of states ``(m, starts, nx)`` under inputs ``(m, starts, nu)``, each member its own.

        Wrapped angles are wrapped as the log's are.
        """
        reached = self.members(*self.layout.split(x, u))
        angles, begin = self.wrapped
        if len(angles):
            reached[..., angles] = begin + np.mod(reached[..., angles] - begin, FULL_TURN)
        return self.layout.joined(reached, x, u)

    def replayed(
        self,
        table: TransitionTable,
        rows: NDArray[np.intp],
        n_steps: int,
        believed: Callable[[TransitionTable], NDArray[np.bool_]] | None = None,
    ) -> Array:
        """What each member missed in the logged steps from some rows on: added after :meth:`step`, it replays them.

        These are the disturbances that nobody measured, under which the controllers are compared, if the model is
        right; a deterministic error of a wrong one, too. Each is clipped at the 99.5 % quantile of its size, so that
        an outlier in the log is none in a simulation.

        Args:
            table: The transitions of the MPC's states.
            rows: Where the stretches begin, ``(s,)``.
            n_steps: Their length.
            believed: As in :meth:`of`.

        Returns:
            Errors of the plant's states, ``(m, s, n_steps, n_states)``; 0 where an episode ends before, the model's
            prediction is not finite, or a row is not believed.
        """
        ids, length = table.episode_ids, len(table)
        steps = np.asarray(rows)[:, None] + np.arange(n_steps)
        inside = np.minimum(steps, length - 1)
        goes_on = (steps < length) & (ids[inside] == ids[np.asarray(rows)][:, None])
        needed, where = np.unique(inside, return_inverse=True)
        missed, some = self._missed(table.take(needed)), table.sample(_ROWS, 0)
        if believed is not None:
            missed[:, ~believed(table.take(needed))] = 0.0
            some = some.take(np.flatnonzero(kept)) if (kept := believed(some)).any() else some
        limit = np.quantile(np.abs(self._missed(some)), _CLIPPED, axis=1, keepdims=True)
        missed = np.clip(missed, -limit, limit)[:, where.reshape(inside.shape)]
        return np.where(goes_on[:, :, None], missed, 0.0)

    def _missed(self, table: TransitionTable) -> Array:
        """One-step errors s+ - f(s, a) of all members on a table, ``(m, n, n_states)``; 0 where f is not finite."""
        columns, n = table.values(), self.layout.n_states
        shape = (len(self), len(table))
        x, u = (np.broadcast_to(v, (*shape, v.shape[1])) for v in (columns.observations, columns.actions))
        missed = columns.next_observations[:, :n] - self.members(*self.layout.split(x, u))
        angles, _ = self.wrapped
        missed[..., angles] -= FULL_TURN * np.round(missed[..., angles] / FULL_TURN)
        return np.asarray(np.nan_to_num(missed, nan=0.0, posinf=0.0, neginf=0.0))


def _problem(mpc: MPC, table: TransitionTable) -> tuple[OneStepProblem, tuple[int, ...]]:
    """One-step prediction on a table, wrapped angles without jumps; and which these are."""
    columns, centre = table.values(), table.centring.centre[: table.ny]
    rows = Rows(columns.observations, columns.actions, columns.next_observations)
    problem = OneStepProblem(mpc, rows, centre)
    rows, unwrapped = without_jumps(rows, problem.errors(mpc.theta) * problem.scale)
    return (OneStepProblem(mpc, rows, centre) if unwrapped else problem), unwrapped


def _judged(
    mpc: MPC, members: Members, table: TransitionTable, judging: NDArray[np.bool_], unwrapped: tuple[int, ...]
) -> tuple[Array, float]:
    """Errors of the members open loop on some rows, ``(m,)``, and of the best that knows no physics.

    Over fewer steps where hardly any stretch of these rows is as long.
    """
    found = Trajectories.of(mpc, table.take(np.flatnonzero(judging)), unwrapped)
    lengths = found.valid.sum(axis=1)
    ahead = np.arange(1, min(STEPS, int(lengths.max())) + 1)
    many = np.maximum(lengths - ahead[:, None] + 1, 0).sum(axis=1) >= _FEWEST
    steps = int(ahead[many][-1]) if many.any() else int(ahead[-1])
    windows = Windows.of(found, steps, max(1, steps // _STARTS), full=True)
    if len(windows) > _WINDOWS:
        windows = windows.chosen(np.linspace(0, len(windows) - 1, _WINDOWS).astype(np.intp))
    y, scale = windows.y, windows.scale
    x = np.broadcast_to(y[0] * scale, (len(members), *y[0].shape))
    off = np.zeros((steps, len(members), len(windows)))
    for k, u in enumerate(windows.u):
        x = members(x, np.broadcast_to(u, (len(members), *u.shape)))
        missed = np.nan_to_num(x / scale - y[k + 1], nan=np.inf)
        off[k] = np.mean(np.minimum(missed**2, _DIVERGED**2), axis=2)
        x = np.where(np.isfinite(x), x, _DIVERGED * scale)
    errors = np.sqrt(off.mean(axis=(0, 2)))
    diverged = (off[-1] >= _DIVERGED**2 / len(scale)).mean(axis=1) > _LOST
    return np.where(diverged, np.inf, errors), _baseline(found, y)


def _baseline(found: Trajectories, y: Array) -> float:
    """The error of the best guess that knows no physics, on windows ``(H + 1, W, nx)`` in spreads."""
    rows = found.rows()
    drift = ((rows.reached - rows.x) / found.scale).mean(axis=0)
    ahead = np.arange(1, len(y))[:, None, None]
    guesses = (y[0], y[0] + ahead * drift, rows.x.mean(axis=0) / found.scale)
    return min(float(np.sqrt(np.mean((guess - y[1:]) ** 2))) for guess in guesses)
