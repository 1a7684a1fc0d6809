"""The learned controllers against what there was before, over model errors, data sets and disturbances."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import casadi as ca
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mpcoffline.control.evaluation import evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.datasets import load_dataset
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.envs import PLANTS
from mpcoffline.envs.episode import DISCOUNT
from mpcoffline.estimation.smoothing import with_measurement_noise
from mpcoffline.gallery.collection import starting_states
from mpcoffline.learner.learner import Learn, OfflineMPCLearner
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC, Model, NormCost, Parameter

from .references import best_known_costs
from .setups import Setup, setup_of

Condition = Literal["clean", "noise", "mismatch"]

NOISE = 0.05  # of each coordinate's standard deviation
FIRST_START = 50_000  # seeds of the starts; nothing was tuned on them


@dataclass(frozen=True)
class CaseGroup:
    """Cases of one task that share the data, and so the value functions, which are learned in the first case.

    Attributes:
        task: Short name of the plant.
        data_seed: Seed of the agent that made the data; 0 is the shipped set.
        condition: ``"clean"``; ``"noise"``: 5 % measurement noise on s and s+ independently; ``"mismatch"``: a model
            that cannot become the plant.
        cases: ``(alpha, seed of the model error)``; where alpha is the plant's, there is one.
    """

    task: str
    data_seed: int
    condition: Condition
    cases: tuple[tuple[float, int], ...]

    @property
    def alpha_is_the_plants(self) -> bool:
        """Whether alpha changes the plant, and not the model of MPC_1."""
        return PLANTS[self.task].max_alpha is not None

    @property
    def name(self) -> str:
        """A short name, which is also that of a file."""
        plant = f"-alpha{self.cases[0][0]:g}" if self.alpha_is_the_plants else ""
        return f"{self.task}-data{self.data_seed}-{self.condition}{plant}"

    @property
    def recipe(self) -> Recipe:
        """How the data are made."""
        recipe = Recipe.load(self.task).vary(seed=self.data_seed)
        return recipe.vary(alpha=self.cases[0][0]) if self.alpha_is_the_plants else recipe


@dataclass(frozen=True)
class Row:
    """One controller in one case: means over the starts.

    Attributes:
        group: Name of the :class:`CaseGroup`.
        alpha: Size of the model error, or of the linear plant's.
        seed: Seed of the model error.
        controller: Its name.
        cost: Undiscounted cost J.
        discounted_cost: Jd, with gamma = 0.9.
        up: Share of the episodes that end in success; None where that was not looked at.
        failures: MPCs whose solution was not accepted.
        fit_time: Seconds of the fit, without (VALUE) where that was shared; None where nothing was learned.
    """

    group: str
    alpha: float
    seed: int
    controller: str
    cost: float
    discounted_cost: float
    up: float | None
    failures: int = 0
    fit_time: float | None = None


@dataclass
class _Arena:
    """Where controllers meet: a setup and its starts."""

    group: CaseGroup
    setup: Setup
    n_episodes: int
    actions: list[NDArray[np.float64]] = field(default_factory=list)

    @property
    def starts(self) -> list[str]:
        return self.setup.starts(self.n_episodes)

    def row(self, name: str, mpc: MPC, fit_time: float | None = None) -> Row:
        """Runs a controller from all starts."""
        env = self.setup.make_env()
        observations, actions = (cast("spaces.Box", s) for s in (env.observation_space, env.action_space))
        policy = MPCPolicy(mpc, observation_space=observations, action_space=actions)
        options = [{"start": start} for start in self.starts]
        loop = evaluate(policy, env, self.n_episodes, FIRST_START, discount=DISCOUNT, options=options)
        self.actions.append(np.stack(loop.actions))
        failures = policy.solver_stats.n_failures
        return self._row(name, loop.cost.mean(), loop.discounted_cost.mean(), loop.success.mean(), failures, fit_time)

    def best_known(self) -> Row:
        """The best costs of whole episodes, from the actions of the controllers that ran here among others."""
        states = starting_states(self.setup.make_env(), self.starts, FIRST_START)
        costs = [best_known_costs(self.group.task, states, self.actions, gamma).mean() for gamma in (1.0, DISCOUNT)]
        return self._row("best known", *costs, None)

    def _row(self, name: str, cost: float, discounted: float, up: float | None, *rest: Any) -> Row:
        case = self.group.name, self.setup.alpha, self.setup.seed
        return Row(*case, name, float(cost), float(discounted), None if up is None else float(up), *rest)


def run_group(group: CaseGroup, n_episodes: int) -> list[Row]:
    """Learns and runs all controllers in all cases of a group.

    Args:
        group: The cases.
        n_episodes: Starts of each case; a third of a swing-up's is hanging.
    """
    table = TransitionTable.from_minari(load_dataset(group.recipe.dataset_id))
    if group.condition == "noise":
        table = with_measurement_noise(table, NOISE, seed=group.data_seed)
    rows: list[Row] = []
    values: dict[str, ValueFunction] = {}
    arenas = [_Arena(group, setup_of(group.task, alpha, seed), n_episodes) for alpha, seed in group.cases]
    for arena in arenas:
        run = _linear_rows if group.alpha_is_the_plants else _swing_up_rows
        rows += run(arena, table, values)
    if not group.alpha_is_the_plants and group.condition == "clean":
        arenas[0].actions = [actions for arena in arenas for actions in arena.actions]
        rows.append(arenas[0].best_known())
    return rows


def _learned(
    nominal: MPC, table: TransitionTable, values: dict[str, ValueFunction], name: str, learn: Learn, **options: Any
) -> tuple[OfflineMPCLearner, float]:
    """A learner with its whole fit, and its seconds; value functions of the same name are learned once."""
    learner = OfflineMPCLearner(nominal, learn, candidate="full", seed=0, value_function=values.get(name), **options)
    start = time.perf_counter()
    learner.fit(table, show_progress=False)
    if learner.value_function is not None:
        values[name] = learner.value_function
    return learner, time.perf_counter() - start


def _swing_up_rows(arena: _Arena, table: TransitionTable, values: dict[str, ValueFunction]) -> Iterator[Row]:
    setup = arena.setup
    nominal, mismatch = setup.nominal, PLANTS[setup.task].mismatch
    if arena.group.condition == "mismatch" and mismatch is not None:
        nominal = without(nominal, *mismatch)
    yield arena.row("MPC_1", nominal)
    for name, learn in (("MPC_2 (paper)", "cost"), ("MPC_3 (paper)", "cost+model")):
        learner, seconds = _learned(nominal, table, values, "paper", cast("Learn", learn), preset="paper")
        yield arena.row(name, learner.mpc, seconds)
    yield from _identified_rows(arena, nominal, table, values)
    learner, seconds = _learned(nominal, table, values, "default", "cost+model", preset="default")
    yield arena.row("default", learner.mpc, seconds)
    fast, fast_seconds = _learned(nominal, table, values, "default", "cost+model", preset="fast")
    yield arena.row("fast", fast.mpc, fast_seconds)
    best, best_seconds = _learned(nominal, table, values, "best", "cost+model", preset="best")
    yield arena.row("best", best.mpc, best_seconds)


def _identified_rows(
    arena: _Arena, nominal: MPC, table: TransitionTable, values: dict[str, ValueFunction]
) -> Iterator[Row]:
    """The model identified, the stage cost nominal; with the nominal terminal cost and horizon, and with default's."""
    learner, _ = _learned(nominal, table, values, "default", "cost+model", preset="default", fit_n_steps=0)
    identified = learner.mpc.replace(stage_cost=nominal.stage_cost)
    terminal_cost = NormCost(nominal.values["stage_cost.x_ref"])
    yield arena.row("identified", identified.replace(terminal_cost=terminal_cost, horizon=nominal.horizon))
    yield arena.row("identified, T from V", identified)


def _linear_rows(arena: _Arena, table: TransitionTable, values: dict[str, ValueFunction]) -> Iterator[Row]:
    setup = arena.setup
    yield arena.row("optimal", setup.reference)
    yield arena.row("MPC_1", setup.nominal)
    for name, learn in (("MPC_2 (paper)", "cost"), ("MPC_3 (paper)", "cost+model")):
        learner, seconds = _learned(setup.nominal, table, values, "paper", cast("Learn", learn), preset="paper")
        yield arena.row(name, learner.mpc, seconds)
    crossed, seconds = _learned(
        setup.nominal, table, values, "low expectile", "cost", preset="paper", value="expectile", **CROSSED
    )
    yield arena.row("MPC_2 with S", crossed.mpc, seconds)
    default, seconds = _learned(setup.nominal, table, values, "default", "cost+model", preset="default")
    yield arena.row("default", default.mpc, seconds)


#: MPC_2 with a cross term: V* is needed here, not the value of the behaviour, and only where the task lives.
CROSSED: dict[str, Any] = {"cross_term": True, "tau": 0.02, "trim": 0.3}


def without(nominal: MPC, name: str, value: float) -> MPC:
    """The MPC with one model parameter fixed at a value that learning cannot change."""
    space, function = nominal.model.space, nominal.model.function
    kept = {block.name: block for block in space if block.name != name}
    parameters = {
        key: Parameter(block.value, low=block.low.reshape(block.shape), high=block.high.reshape(block.shape))
        for key, block in kept.items()
    }

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return function(x, u, ca.vertcat(*(p.get(block.name, ca.SX(value)) for block in space)))

    model = Model(step, nominal.nx, nominal.nu, nominal.model.dt, parameters, discrete=True)
    return nominal.replace(model=model)


def groups(
    data_seeds: Sequence[int] = (0, 1, 2), model_seeds: Sequence[int] = range(5), alphas: Sequence[float] = (0.5, 1.0)
) -> list[CaseGroup]:
    """The cases of the study.

    The swing-ups at alpha = 1.5 for all model errors and data sets, at other alphas, under noise and with a mismatched
    model for the shipped data; the linear task for its plants from 0 to 2, and at alpha = 1 for all data sets.
    """
    first, large = data_seeds[0], tuple((1.5, seed) for seed in model_seeds)
    small = ((0.0, 0), *((alpha, seed) for alpha in alphas for seed in model_seeds[:2]))
    found: list[CaseGroup] = []
    published = [plant for plant in PLANTS.values() if plant.published]
    for task in (plant.name for plant in published if plant.max_alpha is None):
        found += [CaseGroup(task, seed, "clean", large + (small if seed == first else ())) for seed in data_seeds]
        found += [CaseGroup(task, first, "noise", large[:3]), CaseGroup(task, first, "mismatch", large[:3])]
    for task in (plant.name for plant in published if plant.max_alpha is not None):
        found += [CaseGroup(task, first, "clean", ((alpha, 0),)) for alpha in (0.0, 0.5, 1.0, 1.5, 2.0)]
        found += [CaseGroup(task, seed, "clean", ((1.0, 0),)) for seed in data_seeds[1:]]
    return found
