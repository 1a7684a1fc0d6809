"""Where controllers meet: a task or a plant file, its logs of any size, its MPCs, its closed loops."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from mpcoffline.control.evaluation import Predictor, evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.types import Array
from mpcoffline.datasets import load_dataset
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.envs.episode import DISCOUNT
from mpcoffline.mpc import MPC
from mpcoffline.studies.plant_files import Loops, PlantFile
from mpcoffline.studies.setups import setup_of

ALPHA = 1.0  # the model error of the tasks' MPC_1
FIRST_START, TRIED_START = 50_000, 700_000  # seeds of the tasks' starts: of the comparison, and of a search
_TRIED = 5_000  # added to a seed: a plant's starts of a search
_LAST = 50


class Behaviour(NamedTuple):
    """What the controllers that made a log cost.

    Attributes:
        loops: Their episodes.
        said: How they came about.
    """

    loops: Loops
    said: str = ""


class Arena(Protocol):
    """A plant with logs and MPCs.

    Attributes:
        learn: What is learned there, see :class:`mpcoffline.OfflineMPCLearner`.
    """

    learn: Any

    def log(self, size: int, seed: int) -> TransitionTable:
        """The fewest whole episodes that hold ``size`` transitions."""

    def rough(self, seed: int) -> MPC:
        """MPC_1: the model that a user has."""

    def truth(self) -> MPC | None:
        """The MPC with the true model, where there is one."""

    def plain(self, mpc: MPC) -> MPC:
        """An MPC as one would run it that has a good model and learns nothing else."""

    def policy(self, mpc: MPC) -> MPCPolicy:
        """The policy of an MPC."""

    def bounds(self, table: TransitionTable) -> tuple[Array, Array]:
        """Least and largest actions, ``(nu,)`` each; of the log where the plant has none."""

    def behaviour(self, seed: int, n_starts: int) -> Behaviour:
        """What the controllers of the log cost."""

    def loops(self, policy: Predictor, seed: int, n_starts: int, *, tried: bool = False) -> Loops:
        """Closed loops from the starts of the comparison, or, ``tried``, from those of a search."""


def arena_of(name: str, path: str) -> Arena:
    """The arena of a plant file, or of a task where there is no path."""
    return PlantArena(PlantFile.load(Path(path))) if path else TaskArena(name)


def whole_episodes(table: TransitionTable, size: int, rng: np.random.Generator) -> TransitionTable:
    """As few whole episodes, drawn at random, as hold ``size`` transitions, in the order that they have; or all."""
    _, firsts, lengths = table.episodes
    order = rng.permutation(len(firsts))
    n = int(np.searchsorted(np.cumsum(lengths[order]), size)) + 1
    return table.take(np.concatenate([np.arange(firsts[e], firsts[e] + lengths[e]) for e in np.sort(order[:n])]))


class TaskArena:
    """One of the registered tasks with its shipped log, and MPC_1 with a model error of alpha = 1.

    Logs are episodes drawn from all of the shipped one, which its agent made from the first try to the last.
    """

    learn = "cost+model"

    def __init__(self, name: str) -> None:
        self._name, self._setup = name, setup_of(name, ALPHA, 0)
        self._env = self._setup.make_env()

    def log(self, size: int, seed: int) -> TransitionTable:
        """See :class:`Arena`."""
        whole = TransitionTable.of(load_dataset(self._setup.dataset_id))
        return whole_episodes(whole, size, np.random.default_rng([size, seed]))

    def rough(self, seed: int) -> MPC:
        """MPC_1; another model error a seed."""
        return setup_of(self._name, ALPHA, seed).nominal

    def truth(self) -> MPC:
        """True model; the plan is not discounted, as J is not, but where the optimum is known as it is."""
        reference = self._setup.reference
        return reference if self._setup.env_kwargs else self.plain(reference)

    def plain(self, mpc: MPC) -> MPC:
        """Undiscounted, as J: the tasks' own discount of 0.9 is a short sight."""
        return mpc.replace(discount=1.0)

    def policy(self, mpc: MPC) -> MPCPolicy:
        """See :class:`Arena`."""
        observations, actions = (cast("spaces.Box", s) for s in (self._env.observation_space, self._env.action_space))
        return MPCPolicy(mpc, observation_space=observations, action_space=actions)

    def bounds(self, table: TransitionTable) -> tuple[Array, Array]:
        """See :class:`Arena`."""
        box = cast("spaces.Box", self._env.action_space)
        return _finite(box.low, box.high, table)

    def behaviour(self, seed: int, n_starts: int) -> Behaviour:
        """All logged episodes, from their own starts and with exploration: the agent itself is not in the log."""
        table = TransitionTable.of(load_dataset(self._setup.dataset_id))
        places = table.episodes
        costs = [table.take(places.rows(k)).costs.astype(np.float64) for k in range(len(places.ids))]
        cost = np.array([each.sum() for each in costs])
        discounted = np.array([each @ DISCOUNT ** np.arange(len(each)) for each in costs])
        unknown = np.full(len(cost), np.nan)
        last = f"{len(cost)} logged episodes from their own starts; the last {_LAST}: J {cost[-_LAST:].mean():.5g}"
        return Behaviour(Loops(cost, unknown, unknown, discounted), last)

    def loops(self, policy: Predictor, seed: int, n_starts: int, *, tried: bool = False) -> Loops:
        """The same starts for all seeds; a third of a swing-up's is hanging."""
        options = [{"start": start} for start in self._setup.starts(n_starts)]
        first = TRIED_START if tried else FIRST_START
        done = evaluate(policy, self._setup.make_env(), n_starts, first, discount=DISCOUNT, options=options)
        success = done.success if done.knows_success else np.full(n_starts, np.nan)
        return Loops(done.cost, success, np.full(n_starts, np.nan), done.discounted_cost)


class PlantArena:
    """A plant file; its own controllers make logs of any size."""

    def __init__(self, plant: PlantFile) -> None:
        self._plant = plant
        self.learn = getattr(plant.module, "LEARN", "cost+model")

    def log(self, size: int, seed: int) -> TransitionTable:
        """See :class:`Arena`."""
        return self._plant.log(seed, size)

    def rough(self, seed: int) -> MPC:
        """MPC_1 of the seed."""
        mpc: MPC = self._plant.module.mpc(seed)
        return mpc

    def truth(self) -> MPC | None:
        """The plant file's yardstick."""
        mpc: MPC | None = self._plant.module.truth()
        return mpc

    def plain(self, mpc: MPC) -> MPC:
        """As it is."""
        return mpc

    def policy(self, mpc: MPC) -> MPCPolicy:
        """See :class:`Arena`."""
        return MPCPolicy(mpc)

    def bounds(self, table: TransitionTable) -> tuple[Array, Array]:
        """Those of MPC_1."""
        mpc = self.rough(0)
        return _finite(mpc.action_low, mpc.action_high, table)

    def behaviour(self, seed: int, n_starts: int) -> Behaviour:
        """Other controllers of the same kind, from the starts of the comparison."""
        return Behaviour(self._plant.closed_loops(None, seed, n_starts))

    def loops(self, policy: Predictor, seed: int, n_starts: int, *, tried: bool = False) -> Loops:
        """See :class:`Arena`."""
        return self._plant.closed_loops(policy, seed + _TRIED * tried, n_starts)


def _finite(low: ArrayLike, high: ArrayLike, table: TransitionTable) -> tuple[Array, Array]:
    actions = np.asarray(table.values().actions, np.float64)
    least, most = (np.broadcast_to(np.asarray(each, np.float64).ravel(), actions.shape[1:]) for each in (low, high))
    return (
        np.where(np.isfinite(least), least, actions.min(axis=0)),
        np.where(np.isfinite(most), most, actions.max(axis=0)),
    )
