"""Plant files: a true plant, the controller of its log and a rough MPC in one Python file, and closed loops on them."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.evaluation import Predictor
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import InvalidDataError, MPCOfflineError, StorageError
from mpcoffline.core.types import Array
from mpcoffline.datasets import load_dataset
from mpcoffline.datasets.table.transitions import TransitionTable

_MUST_HAVE = ("DT", "STEPS", "DISCOUNT", "N_EPISODES", "Plant", "behaviour", "mpc", "truth")
_LOG, _BEHAVIOUR, _TRIAL, _STARTS = 7, 5, 11, 900


class MissingPackageError(MPCOfflineError):
    """A plant file needs a third-party package that is not installed; the plant can be left out."""


@dataclass(frozen=True)
class PlantFile:
    """A plant file, loaded.

    Attributes:
        name: Name of the plant: its file's, without ``.py``.
        module: What the file defines: ``DT``, ``STEPS``, ``DISCOUNT``, ``N_EPISODES``, ``Plant``, ``behaviour``,
            ``mpc``, ``truth``, perhaps ``LEARN``, ``DATASET`` (the id of one, of which some episodes are the log) and
            ``OUTPUTS`` (places of the states that are measured where some are hidden); its ``Plant`` perhaps
            ``violations``.
    """

    name: str
    module: ModuleType

    @classmethod
    def load(cls, path: Path) -> PlantFile:
        """Runs a plant file, and resets its plant once, to see that what it needs is there.

        Raises:
            MissingPackageError: If a package that it imports is not installed.
            InvalidDataError: If it defines too little, or raises an error.
            StorageError: If it cannot be read.
        """
        try:
            missing = _missing_packages(ast.parse(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise StorageError(str(path), expected="a plant file", actual=str(error)) from error
        except (SyntaxError, ValueError) as error:
            raise InvalidDataError(str(path), expected="a Python file", actual=str(error)) from error
        if missing:
            raise MissingPackageError(path.stem, expected=f"{', '.join(missing)} to be installed", actual="none")
        spec = importlib.util.spec_from_file_location(f"plant_file_{path.stem}", path)
        assert spec is not None  # noqa: S101 -- of a .py it never is; narrows the type
        assert spec.loader is not None  # noqa: S101
        module = importlib.util.module_from_spec(spec)
        sys.modules[module.__name__] = module
        try:
            spec.loader.exec_module(module)
            if absent := [name for name in _MUST_HAVE if not hasattr(module, name)]:
                raise InvalidDataError(path.stem, expected=f"definitions of {', '.join(absent)}", actual="none of them")
            module.Plant().reset(np.random.default_rng(0))
        except MPCOfflineError:
            raise
        except Exception as error:  # whatever a user's program raises
            wanted = isinstance(error, ImportError) or type(error).__name__ == "DependencyNotInstalled"
            kind = MissingPackageError if wanted else InvalidDataError
            actual = f"{type(error).__name__}: {error}"
            raise kind(path.stem, expected="a plant that can be loaded and reset", actual=actual) from error
        return cls(path.stem, module)

    def log(self, seed: int, size: int | None = None) -> TransitionTable:
        """The log that the plant's own controllers make, another controller each episode; or some of its data set.

        Args:
            seed: Of the episodes.
            size: The fewest episodes that hold so many transitions, all of a smaller data set; ``N_EPISODES`` by
                default.
        """
        if (dataset := getattr(self.module, "DATASET", None)) is not None:
            table = TransitionTable.of(load_dataset(dataset))
            rng, (_, firsts, lengths) = np.random.default_rng([_LOG, seed]), table.episodes
            order = rng.permutation(len(firsts))
            enough = None if size is None else int(np.searchsorted(np.cumsum(lengths[order]), size)) + 1
            some = np.sort(order[: self.module.N_EPISODES if enough is None else enough])
            return table.take(np.concatenate([np.arange(firsts[e], firsts[e] + lengths[e]) for e in some]))
        episodes = range(self.module.N_EPISODES) if size is None else count()
        rngs = (np.random.default_rng([_LOG, seed, episode]) for episode in episodes)
        return self._recorded(rngs, self.module.behaviour, size)

    def trial(self, policy: MPCPolicy, seed: int, n_episodes: int) -> TransitionTable:
        """The log of a trial of a policy, from starts that neither the log nor the closed loops hold."""

        def controller(_: np.random.Generator) -> Callable[[Array, int], Array]:
            states: list[Any] = [None]

            def act(observation: Array, k: int) -> Array:
                action, states[0] = policy.predict(observation, state=states[0])
                return np.asarray(action)

            return act

        return self._recorded([np.random.default_rng([_TRIAL, seed, e]) for e in range(n_episodes)], controller)

    def _recorded(
        self,
        rngs: Iterable[np.random.Generator],
        controller: Callable[[np.random.Generator], Any],
        size: int | None = None,
    ) -> TransitionTable:
        """Episodes, each with draws and a controller of its own, until there are ``size`` transitions."""
        rows: dict[str, list[Any]] = {name: [] for name in ("s", "a", "cost", "s_next", "end", "episode")}
        for episode, rng in enumerate(rngs):
            plant, observation = self._started(rng)
            act = controller(rng)
            for k in range(self.module.STEPS):
                action = np.atleast_1d(np.asarray(act(observation, k), np.float64))
                reached, cost, ended = plant.step(action)
                row = (observation, action, cost, observation := np.asarray(reached, np.float64), ended, episode)
                for column, value in zip(rows.values(), row, strict=True):
                    column.append(value)
                if ended:
                    break
            if size is not None and len(rows["s"]) >= size:
                break
        s, a, cost_, s_next, end, ids = map(np.array, rows.values())
        return TransitionTable.from_arrays(s, a, cost_, s_next, end, ids)

    def closed_loops(self, controller: Predictor | None, seed: int, n_starts: int, *, logged: bool = False) -> Loops:
        """Episodes from starts that the log does not hold: the same starts for each controller of a seed.

        The plants move one after the other, the MPCs of all episodes that still run are solved in one batch.

        Args:
            controller: A policy; None for the plant's own controllers, another one each episode.
            seed: Of the starts.
            n_starts: Number of episodes.
            logged: Whether they begin as those of the log of this seed did, though they are disturbed otherwise; there
                are no more than the log has.
        """
        of = [_LOG, seed] if logged else [_STARTS + seed]
        n_starts = min(n_starts, self.module.N_EPISODES) if logged else n_starts
        started = [self._started(np.random.default_rng([*of, e])) for e in range(n_starts)]
        plants, observations = [plant for plant, _ in started], [observation for _, observation in started]
        act = self._behaviours(seed, n_starts) if controller is None else _Batched(controller)
        cost, running = np.zeros(n_starts), np.arange(n_starts)
        over, steps, discounted = np.zeros(n_starts), np.zeros(n_starts), np.zeros(n_starts)
        for k in range(self.module.STEPS):
            actions = act(np.stack([observations[e] for e in running]), running, k)
            goes_on = np.ones(len(running), dtype=bool)
            for i, e in enumerate(running):
                reached, stage_cost, ended = plants[e].step(np.asarray(actions[i], np.float64))
                observations[e], goes_on[i] = np.asarray(reached, np.float64), not ended
                cost[e] += stage_cost
                discounted[e] += self.module.DISCOUNT**k * stage_cost
                over[e], steps[e] = over[e] + _violates(plants[e]), steps[e] + 1
            running = running[goes_on]
            if not len(running):
                break
        success = np.array([bool(plant.success()) for plant in plants])
        return Loops(cost, success, over / np.maximum(steps, 1), discounted)

    def _started(self, rng: np.random.Generator) -> tuple[Any, Array]:
        plant = self.module.Plant()
        return plant, np.asarray(plant.reset(rng), np.float64)

    def _behaviours(self, seed: int, n: int) -> Act:
        controllers = [self.module.behaviour(np.random.default_rng([_BEHAVIOUR, seed, e])) for e in range(n)]

        def act(observations: Array, running: NDArray[np.int_], k: int) -> Array:
            return np.stack([np.atleast_1d(controllers[e](y, k)) for e, y in zip(running, observations, strict=True)])

        return act


Act = Callable[[Array, NDArray[np.int_], int], Array]


class Loops(NamedTuple):
    """Closed loops.

    Attributes:
        cost: Of each episode, ``(n,)``.
        success: Whether it ended well, ``(n,)``.
        violated: In which share of its steps it violated a limit, ``(n,)``; NaN where the plant has none.
        discounted: Discounted cost of each episode, by the plant file's ``DISCOUNT``, ``(n,)``.
    """

    cost: Array
    success: NDArray[Any]
    violated: Array
    discounted: Array


def _violates(plant: Any) -> float:
    """Whether the step before violated a limit; NaN where the plant has none."""
    violations = getattr(plant, "violations", None)
    return float("nan") if violations is None else float(any(amount > 0.0 for amount in violations().values()))


class _Batched:
    """A policy on those episodes that still run; what it remembers of the others is dropped."""

    def __init__(self, policy: Predictor) -> None:
        self._policy = policy
        self._state: Any = None
        self._running: NDArray[np.int_] | None = None

    def __call__(self, observations: Array, running: NDArray[np.int_], k: int) -> Array:
        state = self._state
        if state is not None and self._running is not None and len(running) < len(self._running):
            kept = np.isin(self._running, running)
            state = tuple(np.asarray(part)[kept] for part in state)
        self._running = running
        first = np.full(len(running), k == 0)
        actions, self._state = self._policy.predict(observations, state=state, episode_start=first)
        return np.asarray(actions)


def find_plant_files(folders: Sequence[Path]) -> dict[str, Path]:
    """The plant files of some folders by name; of two of the same name the one in the earlier folder counts.

    Files whose names begin with ``_`` are none. In place of a folder one that holds it as ``plants/`` will do.

    Raises:
        StorageError: For a folder that is not there, or that holds no plant files.
    """
    found: dict[str, Path] = {}
    for folder in folders:
        inner = folder / "plants" if (folder / "plants").is_dir() else folder
        files = [path for path in sorted(inner.glob("*.py")) if not path.name.startswith("_")]
        if not files:
            raise StorageError(str(folder), expected="a folder of plant files (*.py)", actual="none in it")
        for path in files:
            found.setdefault(path.stem, path.resolve())
    return dict(sorted(found.items()))


def _missing_packages(tree: ast.AST) -> list[str]:
    """Top-level packages that a program imports, or asks ``find_spec`` for, and that are not installed."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "find_spec":
            names |= {arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)}
    tops = {name.split(".")[0] for name in names}
    return sorted(top for top in tops if top not in sys.modules and importlib.util.find_spec(top) is None)
