"""A learning problem in other units: what an engineer who measures in mm, kW and minutes would have written.

A study of whether units matter: the same plant, log and MPC in other numbers, and closed loops with what is learned.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.control.evaluation import evaluate
from mpcoffline.core.tables import Table
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.mpc import MPC, Block, Model, NormCost, Parameter, ParameterSpace, QuadraticCost
from mpcoffline.mpc.expression_cost import ExpressionCost
from mpcoffline.plants import nominal_mpc


@dataclass(frozen=True)
class Units:
    """New numbers are the old ones times these; the cost has an offset besides.

    Attributes:
        states: ``(nx,)``, or one number.
        inputs: ``(nu,)``, or one number.
        cost: Positive.
        offset: Added to the logged cost, in the old unit.
        time: Of an ODE's.
    """

    states: ArrayLike = 1.0
    inputs: ArrayLike = 1.0
    cost: float = 1.0
    offset: float = 0.0
    time: float = 1.0

    def table(self, table: TransitionTable) -> TransitionTable:
        """The log."""
        s, a, cost, reached, ended = table.values()
        x, u = np.asarray(self.states), np.asarray(self.inputs)
        costs = self.cost * (cost + self.offset)
        return TransitionTable.from_arrays(x * s, u * a, costs, x * reached, ended, episode_ids=table.episode_ids)

    def mpc(self, mpc: MPC) -> MPC:
        """The MPC: the same model parameters, the cost's weights in the new units."""
        x, u = self.of(mpc)
        model, space = mpc.model, mpc.model.space
        discrete = self.time == 1.0 or model.ode is None
        function: Any = model.function if discrete else model.ode

        def dynamics(state: Any, action: Any, p: dict[str, Any]) -> Any:
            flat = ca.vertcat(*(block.flat(p[block.name]) for block in space))
            return x * function(state / x, action / u, flat) / (1.0 if discrete else self.time)

        parameters = {b.name: Parameter(b.value, b.low.reshape(b.shape), b.high.reshape(b.shape)) for b in space}
        integrator = "auto" if discrete else model.integrator
        return MPC(
            model=Model(
                dynamics,
                mpc.nx,
                mpc.nu,
                model.dt * self.time,
                parameters,
                discrete=discrete,
                integrator=integrator,
            ),
            stage_cost=self._cost(mpc.stage_cost, x, u),
            terminal_cost=self._cost(mpc.terminal_cost, x, u),
            horizon=mpc.horizon,
            discount=mpc.discount,
            action_low=u * np.asarray(mpc.action_low),
            action_high=u * np.asarray(mpc.action_high),
        )

    def of(self, mpc: MPC) -> tuple[Array, Array]:
        """Those of each state and input, ``(nx,)`` and ``(nu,)``."""
        return np.broadcast_to(self.states, mpc.nx), np.broadcast_to(self.inputs, mpc.nu)

    def _cost(self, cost: Any, x: Array, u: Array) -> Any:
        if type(cost) is NormCost:  # which has no weights that could take the units
            space = ParameterSpace([Block.free("x_ref", x * cost.values["x_ref"], "reference")])
            state, reference = ca.SX.sym("x", len(x)), ca.SX.sym("p", len(x))
            norm = ca.sqrt(ca.sumsqr((state - reference) / x) + cost.eps**2) - cost.eps
            return ExpressionCost(ca.Function("norm", [state, reference], [self.cost * norm]), space, convex=True)
        if not isinstance(cost, QuadraticCost):
            return cost
        old = cost.values
        parts: dict[str, Any] = {"W": self.cost * cost.W / np.outer(x, x), "x_ref": x * old["x_ref"]}
        if cost.nu:
            parts |= {"R": self.cost * cost.R / np.outer(u, u), "u_ref": u * old["u_ref"]}
        return QuadraticCost(constant=self.cost * float(old["constant"]), **parts)


class _Foreign:
    """A policy of other units for a plant in its own, with SB3's ``predict``."""

    def __init__(self, policy: Any, units: Units, mpc: MPC) -> None:
        self._policy, (self._x, self._u) = policy, units.of(mpc)

    def predict(self, observation: Any, state: Any = None, *rest: Any, **named: Any) -> tuple[Any, Any]:
        """The action for an observation, both in the plant's units."""
        action, state = self._policy.predict(np.asarray(observation, np.float64) * self._x, state, *rest, **named)
        return (np.asarray(action, np.float64) / self._u).astype(np.float32), state


PLANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "linear": ("mpcoffline/LinearTracking-v0", {}),
    "pendulum": ("mpcoffline/PendulumSwingUp-v0", {"alpha": 1.0, "seed": 0}),
    "cartpole": ("mpcoffline/CartPoleSwingUp-v0", {"alpha": 1.0, "seed": 0}),
    "quadrotor": ("mpcoffline/PlanarQuadrotor-v0", {"alpha": 1.0, "seed": 0}),
}
SEEDS = 5  # whose spread is what units may change a closed loop by
#: Other units by name; offsets of the cost in spreads of it.
CHANGES: dict[str, dict[str, float]] = {
    "cost x 1e-6": {"cost": 1e-6},
    "cost x 1e6": {"cost": 1e6},
    "cost - 1e6 spreads": {"offset": -1e6},
    "cost + 1e6 spreads": {"offset": 1e6},
    "states x 1e-6": {"states": 1e-6},
    "states x 1e6": {"states": 1e6},
    "inputs x 1e-6": {"inputs": 1e-6},
    "inputs x 1e6": {"inputs": 1e6},
    "time x 1e-6": {"time": 1e-6},
    "time x 1e6": {"time": 1e6},
}
#: A short fit: what is compared is the same fit in other units.
_SHORT: dict[str, Any] = {
    "value_n_steps": 500,
    "value_batch_size": 256,
    "hidden": (32,),
    "fit_n_steps": 0,
    "horizon": 15,
}
#: The plants for which that is too short to fly; their logs are not cut either.
_WHOLE = ("quadrotor",)
_ROWS, _STARTS, _FIRST_START = 4_000, 10, 1_000
_ALIKE = 0.01  # of the cost, or the spread of the seeds if that is more


@dataclass(frozen=True)
class Trial:
    """A fit and its closed loops, a line of the results.

    Attributes:
        plant: Its name.
        change: A key of :data:`CHANGES`, or ``"seed k"`` in the plant's own units.
        cost: Mean cost of an episode in the plant's own units.
    """

    plant: str
    change: str
    cost: float


def cases(plants: Sequence[str]) -> Iterator[tuple[str, str]]:
    """What is to be done, a plant and a change at a time."""
    for plant in plants:
        yield from ((plant, change) for change in [*(f"seed {k}" for k in range(SEEDS)), *CHANGES])


def tried(plant: str, change: str) -> Trial:
    """Learns in other units, or with another seed, and measures on the plant."""
    env_id, options = PLANTS[plant]
    table = TransitionTable.from_minari(f"mpcoffline/{plant}/ddpg-v0")
    ids = np.random.default_rng(0).permutation(table.episodes.ids)
    count = len(ids) if plant in _WHOLE else max(1, len(ids) * _ROWS // len(table))
    table = table.take(np.flatnonzero(np.isin(table.episode_ids, ids[:count])))
    named = dict(CHANGES.get(change, {}))
    named["offset"] = named.get("offset", 0.0) * float(np.std(table.costs, dtype=np.float64))
    units, mpc = Units(**named), nominal_mpc(env_id, **options)
    seed = int(change.split()[1]) if change.startswith("seed") else 0
    learner = OfflineMPCLearner(units.mpc(mpc), seed=seed, **({} if plant in _WHOLE else _SHORT))
    learner.fit(units.table(table), show_progress=False)
    result = evaluate(_Foreign(learner.policy, units, mpc), env_id, _STARTS, _FIRST_START)
    return Trial(plant, change, float(result.cost.mean()))


def read(path: Path) -> list[Trial]:
    """The results so far; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [Trial(row["plant"], row["change"], float(row["cost"])) for row in csv.DictReader(file)]


def run(path: Path, plants: Sequence[str], done: Callable[[Trial], None]) -> list[Trial]:
    """All trials that are not in the file yet, each appended when it is done."""
    known = {(trial.plant, trial.change) for trial in read(path)}
    for plant, change in cases(plants):
        if (plant, change) in known:
            continue
        trial, new = tried(plant, change), not path.exists()
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [each.name for each in fields(Trial)])
            if new:
                writer.writeheader()
            writer.writerow(asdict(trial))
        done(trial)
    return read(path)


def page(trials: Sequence[Trial]) -> str:
    """A table in Markdown: how far each change moves the closed loop's cost, beside what seeds move it by."""
    costs = {(trial.plant, trial.change): trial.cost for trial in trials}
    plants = [plant for plant in PLANTS if all((plant, f"seed {k}") in costs for k in range(SEEDS))]
    base = {plant: costs[plant, "seed 0"] for plant in plants}
    spread = {p: float(np.ptp([costs[p, f"seed {k}"] for k in range(SEEDS)])) / abs(base[p]) for p in plants}

    def moved(plant: str, change: str) -> str:
        if (plant, change) not in costs:
            return "-"
        by = costs[plant, change] / base[plant] - 1.0
        return f"{by:+.2%}" + ("" if abs(by) <= max(_ALIKE, spread[plant]) else " !")

    rows = [
        ["cost of an episode", *(f"{base[plant]:.4g}" for plant in plants)],
        ["spread over five seeds", *(f"{spread[plant]:.2%}" for plant in plants)],
        *([change, *(moved(plant, change) for plant in plants)] for change in CHANGES),
    ]
    return Table(["", *plants], rows, align="lr").markdown()
