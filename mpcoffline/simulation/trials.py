"""Controllers tried on the models of a log: the same starts, the same models, so that differences are paired."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.course import Course
from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.sensors import Sensors
from mpcoffline.mpc.layout import Layout
from mpcoffline.mpc.outputs import shown
from mpcoffline.solvers import Plan

from .episodes import Controller, Episodes, iterations_of
from .logged_cost import LoggedCost
from .models import LogModels
from .starts import cheapest_step, returns_along, signals_along

_ARRAYS = {
    "votes": "b",
    "cost": "f",
    "second": "f",
    "lost": "b",
    "rows": "i",
    "returns": "f",
    "begun": "b",
    "judged": "b",
    "n_steps": "i",
}
_NOISE = 7
_SURE = 2.0  # standard errors
_ROUNDING = 1e-12  # of what an episode costs
_RUN_AWAY = 30.0  # spreads of the data: a state this far out has left what any model of them knows


@dataclass(frozen=True)
class Trials:
    """Costs of controllers in closed loop with models of a log, ``(controllers, models, starts)``.

    Attributes:
        names: Of the controllers; the first one is ``"MPC_1"``.
        models: Names of the models; in a diagnosis the first one is the identified one.
        votes: Which models predict the log well enough to be asked, ``(models,)``.
        cost: Undiscounted cost of each episode, in the unit of the logged costs; NaN where it was not tried.
        second: The same with another regression of the logged cost.
        lost: Whether the state ran away, or the episode ended, but at a goal.
        rows: The row of the log that each start is, ``(starts,)``.
        returns: What the log itself cost from there over as many steps, ``(starts,)``; NaN where it ends before.
        begun: The starts at which an episode of the log began, ``(starts,)``.
        judged: The starts that had no part in the choice among the controllers, ``(starts,)``.
        n_steps: Length of an episode.
        least: What the cheapest step cost, logged or simulated by a model with a vote, ``(1,)``; minus infinity where
            nobody has looked, as in files.
    """

    names: tuple[str, ...]
    models: tuple[str, ...]
    votes: NDArray[np.bool_]
    cost: Array
    second: Array
    lost: NDArray[np.bool_]
    rows: NDArray[np.intp]
    returns: Array
    begun: NDArray[np.bool_]
    judged: NDArray[np.bool_]
    n_steps: int
    least: Array = field(default_factory=lambda: np.full(1, -np.inf))

    @classmethod
    def none(cls, names: Sequence[str], around: Surroundings) -> Trials:
        """Before the first; nothing is chosen by them yet."""
        shape = len(names), len(around.models), len(around.rows)
        cost, second, lost = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
        models, rows, returns = around.models, around.rows, around.returns
        judged = np.ones(len(around.rows), dtype=bool)
        parts = cost, second, lost, rows, returns, around.begun, judged, around.n_before + around.n_steps
        return cls(tuple(names), models.names, models.votes, *parts, np.array([around.least]))

    def fill(
        self, controllers: Mapping[str, Controller], around: Surroundings, starts: slice, kept: int = 0
    ) -> dict[str, Episodes]:
        """Adds what controllers do from some of the starts; ``kept`` as :meth:`Surroundings.act` has it."""
        done = dict(zip(controllers, around.act(list(controllers.values()), starts, kept), strict=True))
        self.put(done, around, starts)
        return done

    def put(self, done: Mapping[str, Episodes], around: Surroundings, starts: slice) -> None:
        """Adds what controllers have done from some of the starts, by name."""
        for name, episodes in done.items():
            k, before = self.names.index(name), around.before[starts]
            self.cost[k, :, starts], self.second[k, :, starts] = episodes.cost + before, episodes.second + before
            self.lost[k, :, starts] = episodes.lost
            self.least[0] = episodes.least[self.votes].min(initial=self.least[0])

    @property
    def floor(self) -> float:
        """What an episode costs at least: as much as if each of its steps were the cheapest one."""
        return self.n_steps * float(self.least[0])

    def with_names(self, more: Sequence[str]) -> Trials:
        """With further controllers, not tried yet."""
        if not more:
            return self
        shape = len(more), *self.cost.shape[1:]
        cost, second = (np.concatenate([costs, np.full(shape, np.nan)]) for costs in (self.cost, self.second))
        lost = np.concatenate([self.lost, np.zeros(shape, dtype=bool)])
        return replace(self, names=(*self.names, *more), cost=cost, second=second, lost=lost)

    def judged_from(self, first: int) -> Trials:
        """With the starts that were tried, of which those from some on had no part in the choice."""
        count = int((~np.isnan(self.cost).all(axis=(0, 1))).sum())
        kept: dict[str, Any] = {name: getattr(self, name)[..., :count] for name in ("cost", "second", "lost")}
        kept |= {name: getattr(self, name)[:count] for name in ("rows", "returns", "begun")}
        return replace(self, **kept, judged=np.arange(count) >= first)

    def of(self, name: str) -> Array:
        """The costs of a controller, ``(models, starts)``."""
        return np.asarray(self.cost[self.names.index(name)])

    def differences(self, name: str, *, second: bool = False) -> Array:
        """Costs of a controller less those of MPC_1, ``(models, starts)``."""
        costs = self.second if second else self.cost
        return np.asarray(costs[self.names.index(name)] - costs[0])

    def improves(self, name: str, than: str | None = None) -> bool:
        """Whether it costs no more than MPC_1, or another, on the median model, by both regressions.

        From all starts; those that had no part in the choice may not say otherwise beyond two standard errors.
        Where there is no difference at all, what was identified predicts the log better, and is taken.
        """
        none = _ROUNDING * float(np.abs(self.of(self.names[0])[self.votes]).mean())
        for second in (False, True):
            other = 0.0 if than is None else self.differences(than, second=second)
            gains = (self.differences(name, second=second) - other)[self.votes]
            middle = int(np.argsort(gains.mean(axis=1), kind="stable")[len(gains) // 2])
            fresh = gains[middle][self.judged]
            error = fresh.std() / np.sqrt(len(fresh)) if len(fresh) else 0.0
            if not gains[middle].mean() <= none or (len(fresh) and fresh.mean() > none + _SURE * error):
                return False
        return True

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The numbers; the names are not among them."""
        return {name: np.asarray(getattr(self, name)) for name in _ARRAYS}

    @classmethod
    def from_arrays(cls, names: tuple[str, ...], models: tuple[str, ...], arrays: Mapping[str, NDArray[Any]]) -> Trials:
        """The inverse of :meth:`to_arrays`.

        Raises:
            FileFormatError: For arrays that are missing, or of other shapes or types.
        """
        n = np.size(arrays.get("rows", ()))
        shapes: dict[str, tuple[int, ...]] = {name: (len(names), len(models), n) for name in ("cost", "second", "lost")}
        shapes |= {"votes": (len(models),), "n_steps": ()} | dict.fromkeys(("rows", "returns", "begun", "judged"), (n,))
        for name, kind in _ARRAYS.items():
            array = arrays.get(name)
            if array is None or array.shape != shapes[name] or array.dtype.kind != kind:
                actual = "none" if array is None else f"{array.dtype} {array.shape}"
                raise FileFormatError(f"trials/{name}", expected=f"shape {shapes[name]}, kind {kind}", actual=actual)
        parts = {name: arrays[name] for name in _ARRAYS if name != "n_steps"}
        return cls(names=names, models=models, n_steps=int(arrays["n_steps"]), **parts)


class Surroundings:
    """All that happens to a controller in a trial but for what it does itself: the same for all controllers.

    Args:
        models: The models of the log.
        cost: The logged cost as a function.
        table: Transitions of the models' states, past inputs included.
        rows: Where in the table the episodes begin, ``(starts,)``.
        n_steps: Their length.
        layout: Of the models' states.
        seed: Of the measurement noise.
        spare: How many of the rows, the last ones, are for where the others decide nothing.
        before: What the log cost from the begin of an episode to a row, ``(starts,)``, which is the same for every
            controller; 0 by default.
        n_before: In how many steps.
        logged: The transitions as they were logged, where ``table`` is smoothed; its rows are those of the table.
        fresh: Whether a controller is not told which inputs were applied before an episode of the table begins.
        sensors: What MPCs see in place of states, through an observer, which begins with the episode.
    """

    models: LogModels
    cost: LoggedCost
    rows: NDArray[np.intp]
    n_steps: int
    table: TransitionTable
    usual: int
    n_before: int
    fresh: bool
    least: float

    def __init__(
        self,
        models: LogModels,
        cost: LoggedCost,
        table: TransitionTable,
        rows: NDArray[np.intp],
        n_steps: int,
        layout: Layout,
        seed: int = 0,
        spare: int = 0,
        before: Array | None = None,
        n_before: int = 0,
        logged: TransitionTable | None = None,
        fresh: bool = False,
        sensors: Sensors | None = None,
    ) -> None:
        self.logged: TransitionTable = table if logged is None else logged
        self.models, self.cost, self.rows, self.n_steps, self._layout = models, cost, rows, n_steps, layout
        self.table, self.usual, self.n_before, self.fresh = table, len(rows) - spare, n_before, fresh
        self.before: Array = np.zeros(len(rows)) if before is None else before
        columns = table.values()
        self.starts: Any = columns.observations[rows]
        self.signals: Array = signals_along(table, rows, n_steps, layout)
        self.disturbances: Array = models.replayed(table, rows, n_steps, cost.as_applied)
        rng = np.random.default_rng([seed, _NOISE])
        self.noise: Array = models.noise * rng.standard_normal((n_steps, len(rows), layout.n_states))
        self.sensors = sensors
        if sensors is not None:
            self.output_noise: Array = sensors.noise * rng.standard_normal((n_steps, len(rows), sensors.n_outputs))
        paid = table if cost.limits is None else cost.limits.whole(table)
        self.returns: Array = returns_along(paid, rows, n_steps) + self.before
        self.begun: NDArray[np.bool_] = np.isin(rows, table.episodes.firsts)
        self.at_work: NDArray[np.bool_] = np.zeros(len(rows), dtype=bool)
        states = columns.observations
        self._middle, spread = states.mean(axis=0), states.std(axis=0)
        reach = np.abs(states - self._middle).max(axis=0) + _RUN_AWAY * spread
        self._reach = np.where((spread > 0.0) & (np.arange(len(reach)) < layout.n_states), reach, np.inf)
        self._dearest = float((columns if paid is table else paid.values()).costs.max())
        self.least = cheapest_step(paid)

    def on(self, models: NDArray[np.intp]) -> Surroundings:
        """The same with some of the models, by number."""
        other = copy.copy(self)
        other.models, other.disturbances = self.models.some(models), self.disturbances[models]
        return other

    def reordered(self, order: NDArray[np.intp]) -> Surroundings:
        """The same with its starts in another order, ``(starts,)``."""
        other = copy.copy(self)
        for name in ("rows", "before", "starts", "signals", "returns", "begun", "at_work"):
            setattr(other, name, getattr(self, name)[order])
        other.disturbances, other.noise = self.disturbances[:, order], self.noise[:, order]
        if self.sensors is not None:
            other.output_noise = self.output_noise[:, order]
        return other

    def seeing(self, policy: MPCPolicy) -> Controller:
        """What acts on what sensors show: the policy itself where that is the state."""
        if self.sensors is None:
            return policy
        return OutputFeedbackPolicy(policy, self.sensors.suited(policy.mpc, self.table).observer(policy.mpc))

    def begun_at(self, starts: Array, signals: Array, at_work: NDArray[np.bool_] | None = None) -> Surroundings:
        """The same models and disturbances from other starts, under other signals.

        Args:
            starts: States of the models, ``(starts, nx)``, as many as there are.
            signals: One after each step, ``(starts, n_steps, ny - n_states)``.
            at_work: At which of these observers have been at work for long, ``(starts,)``; nowhere by default.
        """
        other = copy.copy(self)
        other.starts, other.signals, other.fresh = starts, signals, False
        other.at_work = np.zeros(len(starts), dtype=bool) if at_work is None else at_work
        return other

    def act(self, controllers: Sequence[Controller], starts: slice = slice(None), kept: int = 0) -> list[Episodes]:
        """Closed loops of controllers on all models from all starts; all decisions of one in a step are one batch.

        A state that runs away stays where it was and costs as much as the dearest logged transition from then on; an
        episode that ends as those of the log do costs nothing more.

        Args:
            controllers: What acts, each by itself.
            starts: From which starts; all by default.
            kept: Of how many of them, the first ones, states and inputs are kept with every model.
        """
        ny, n, m, c = self._layout.ny, self._layout.n_states, len(self.models), len(controllers)
        begun, signals, noise = self.starts[starts], self.signals[starts], self.noise[:, starts]
        disturbances, shape = self.disturbances[:, starts], (m, c, len(begun))  # a row of states for each
        x = np.broadcast_to(begun, (*shape, begun.shape[1])).copy()
        lost, over, good = (np.zeros(shape, dtype=bool) for _ in range(3))
        total, second, states, actions = np.zeros(shape), np.zeros(shape), [x[0].copy()], []
        least = np.full(shape[:2], np.inf)
        states_kept, actions_kept = [x[:, :, :kept].copy()], []
        acted = np.full((*shape, len(self._layout.acting)), np.nan)  # nothing, yet
        courses = [self._course(controller, x[:, i], starts) for i, controller in enumerate(controllers)]
        before = [iterations_of(controller) for controller in controllers]
        for k in range(self.n_steps):
            seen, u = x[..., :ny].copy(), np.empty((*shape, self._layout.nu))
            seen[..., :n] += noise[k]
            outputs = self._outputs(x, acted, starts, k)
            for i, controller in enumerate(controllers):
                given = outputs if isinstance(controller, OutputFeedbackPolicy) else seen
                found, courses[i] = controller.predict(given[:, i].reshape(-1, given.shape[-1]), state=courses[i])
                u[:, i] = np.asarray(found, dtype=np.float64).reshape(m, len(begun), -1)
            acted = self._layout.split(x, u)[1]
            flat = x.reshape(-1, x.shape[-1]), u.reshape(-1, u.shape[-1])
            reached = self.models.step(*(each.reshape(m, -1, each.shape[-1]) for each in (x, u))).reshape(x.shape)
            reached[..., :n] += disturbances[:, None, :, k]
            reached[..., n:ny] = signals[:, k]
            steps = *flat, reached.reshape(flat[0].shape)
            priced = self.cost(*steps)
            for costs, each in ((total, priced), (second, priced if self.cost.alike else self.cost.second(*steps))):
                now = np.where(over, 0.0, np.where(lost, self._dearest, each.reshape(shape)))
                costs += now
                np.minimum(least, now.min(axis=2), out=least)
            ended = self.cost.ended(*steps).reshape(shape) & ~lost & ~over
            if ended.any():
                paid = self.cost.ends.paid(reached[ended])
                total[ended] += paid
                second[ended] += paid
                least = np.minimum(least, min(0.0, float(paid.min())))
                good[ended] = paid < self.cost.ends.good_below
            over |= ended
            lost |= ~(np.abs(reached - self._middle) < self._reach).all(axis=-1) & ~over
            x = np.where((lost | over)[..., None], x, reached)
            x[..., n:ny] = signals[:, k]
            states.append(x[0].copy())
            actions.append(u[0])
            states_kept.append(x[:, :, :kept].copy())
            actions_kept.append(u[:, :, :kept].copy())
        lost |= over & ~good
        seen, done = np.stack(states, axis=2), np.stack(actions, axis=2)
        kept_states, kept_actions = np.stack(states_kept, axis=3), np.stack(actions_kept, axis=3)
        return [
            Episodes(
                *(total[:, i], second[:, i], lost[:, i], seen[i], done[i]),
                *(kept_states[:, i], kept_actions[:, i], least[:, i], iterations_of(controller) - before[i]),
            )
            for i, controller in enumerate(controllers)
        ]

    def _outputs(self, x: Array, acted: Array, starts: slice, k: int) -> Array:
        """Outputs with noise and signals of states ``(..., starts, nx)`` in step k; nothing where states are seen."""
        if self.sensors is None:
            return x
        n, ny = self._layout.n_states, self._layout.ny
        y = shown(self.sensors.outputs, x[..., :n], acted) + self.output_noise[k, starts]
        return np.concatenate([y, x[..., n:ny]], axis=-1)

    def _course(self, controller: Controller, x: Array, starts: slice) -> tuple[NDArray[Any], ...] | None:
        """What a controller knows of the time before, at states ``(models, starts, nx)``.

        In midst of an episode it is the inputs that were applied; where one begins, what the controller takes for them.
        """
        if isinstance(controller, OutputFeedbackPolicy):
            return self._estimated(controller, x, self.at_work[starts])
        mpc, ny = getattr(controller, "mpc", None), self._layout.ny
        if mpc is None or not mpc.nx == x.shape[2] > ny:
            return None
        fresh = self.begun[starts, None] & self.fresh
        past = np.where(fresh, mpc.layout.filled(mpc.usual_input), x[..., ny:]).reshape(-1, x.shape[2] - ny)
        plan = Plan.none(len(past), mpc)
        return Course(plan.x, plan.u, past, plan.multipliers)

    def _estimated(
        self, policy: OutputFeedbackPolicy, x: Array, at_work: NDArray[np.bool_]
    ) -> tuple[NDArray[Any], ...] | None:
        """What an observer knows of states ``(models, starts, nx)``: where it has been at work, nearly all."""
        if not at_work.any():
            return None
        observer, mpc, n = policy.observer, policy.mpc, self._layout.n_states
        flat, known = x.reshape(-1, x.shape[-1]), observer.begin(x.shape[0] * x.shape[1])
        z = np.hstack([flat[:, : mpc.ny], np.tile(mpc.layout.filled(mpc.usual_input), (len(flat), 1))])
        acting = mpc.layout.split(z, np.tile(mpc.usual_input, (len(flat), 1)))[1]
        usual = observer.at_work(flat[:, :n], acting)
        values, axes = np.linalg.eigh(usual.P)
        drawn = np.sqrt(np.fmax(values, 0.0)) * np.random.default_rng(_NOISE).standard_normal(values.shape)
        off, rows = np.einsum("bij,bj->bi", axes, drawn), np.tile(at_work, len(x))
        known.x[rows], known.P[rows] = (usual.x + off)[rows], usual.P[rows]
        plan: tuple[NDArray[Any], ...] = Plan.none(len(flat), mpc)
        if mpc.layout.n_memory:
            own = flat[:, mpc.ny :] if mpc.nx == flat.shape[1] else z[:, mpc.ny :]
            plan = Course(plan[0], plan[1], np.where(rows[:, None], own, z[:, mpc.ny :]))
        return (*known, np.full(acting.shape, np.nan), *plan)
