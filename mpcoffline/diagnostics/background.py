"""What a page says beside the figures of a report: names and units, parameters, the log's columns, where it is from."""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.files import hash_of
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.envs import find_plant
from mpcoffline.estimation import Identification
from mpcoffline.mpc import MPC
from mpcoffline.mpc.layout import Layout
from mpcoffline.mpc.parameters import Block

from .loops import Loop

if TYPE_CHECKING:
    from mpcoffline.learner.learner import OfflineMPCLearner

_PACKAGES = ("mpcoffline", "numpy", "scipy", "casadi", "torch", "gymnasium", "stable-baselines3", "minari")


@dataclass(frozen=True)
class Names:
    """Names, with units, of what figures and tables show; plain text of any alphabet.

    Attributes:
        states: One for each state, then one for each signal's column, ``(ny,)``.
        inputs: One for each input, ``(nu,)``.
        cost: The unit of an episode's cost, e.g. ``"EUR"``; empty where it has none.
        plant: What the log is of.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    cost: str = ""
    plant: str = ""

    @classmethod
    def numbered(cls, layout: Layout) -> Names:
        """Where nothing is known: ``"state 1"``; signals have names."""
        states = tuple(f"state {i + 1}" for i in range(layout.n_states))
        signals = tuple(
            signal.name if signal.size == 1 else f"{signal.name}, {k} steps ahead"
            for signal in layout.signals
            for k in range(signal.size)
        )
        return cls((*states, *signals), tuple(f"input {i + 1}" for i in range(layout.nu)))


@dataclass(frozen=True)
class ParameterLine:
    """A number of theta, in its natural form.

    Attributes:
        name: With its place, where it is an entry of an array.
        group: ``"model"``, ``"cost"``, ``"terminal"`` or ``"reference"``.
        unit: Its unit.
        before: Of MPC_1; NaN where that has none of the name.
        found: By the log alone: what predicts it best; NaN where that is not asked.
        deviation: One standard deviation of it.
        after: Of the MPC that is proposed.
        open: Whether the log does not determine it.
    """

    name: str
    group: str
    unit: str
    before: float
    found: float
    deviation: float
    after: float
    open: bool


@dataclass(frozen=True)
class ColumnLine:
    """A column of the log.

    Attributes:
        low: Its least value.
        mean: Its mean.
        high: Its largest.
        spread: Its standard deviation.
    """

    low: float
    mean: float
    high: float
    spread: float


@dataclass(frozen=True)
class Background:
    """What a page shows beside a report's own figures.

    Attributes:
        names: Names and units.
        dt: Sampling time, in the model's unit of time.
        loops: Closed loops from a few starts.
        parameters: Those of the MPC.
        columns: Of the log: states and signals, inputs, the cost.
        episodes: Shortest, median and longest length, and how many ended by themselves.
        made_by: Versions, seeds, hashes, by what they are of.
    """

    names: Names
    dt: float
    loops: tuple[Loop, ...] = field(repr=False)
    parameters: tuple[ParameterLine, ...] = field(repr=False)
    columns: tuple[ColumnLine, ...] = field(repr=False)
    episodes: tuple[int, int, int, int]
    made_by: tuple[tuple[str, str], ...]

    def named(self, names: Names | None) -> Background:
        """With other names.

        Raises:
            InvalidArgumentError: For fewer or more of them than there are columns.
        """
        if names is None:
            return self
        for what in ("states", "inputs"):
            n, given = len(getattr(self.names, what)), len(getattr(names, what))
            if n != given:
                raise InvalidArgumentError(f"names.{what}", expected=f"{n} names", actual=f"{given}")
        return replace(self, names=names)


def names_of(dataset: Any, mpc: MPC) -> Names:
    """Those that the model carries, else those of the task that a data set is of, where it is known here.

    MPC_1 of a task carries the task's names; the symbols of figures are nearer to the equations.
    """
    layout, numbered = mpc.layout, Names.numbered(mpc.layout)
    spec = getattr(getattr(dataset, "spec", None), "env_spec", None)
    plant = None if spec is None else find_plant(str(spec.id))
    named = bool(layout.labels.states or layout.labels.inputs)
    if named and (plant is None or layout.labels.states != plant.entries):
        return Names(tuple(map(str, layout.y_labels)), tuple(map(str, layout.u_labels)))
    if spec is None or plant is None or (len(plant.observations), len(plant.inputs)) != (mpc.ny, mpc.nu):
        return numbered
    inputs = tuple(_plain(each.label) for each in plant.inputs)
    return Names(tuple(map(_plain, plant.observations)), inputs, plant=str(spec.id))


def _plain(label: str) -> str:
    """A label with formulas as text of any alphabet."""
    label = re.sub(r"\\dot\s*(\\?\w+)", "\\1\N{COMBINING DOT ABOVE}", label)
    label = re.sub(r"\\(cos|sin)", r"\1 ", label)
    for name, letter in {"\\varphi": "φ", "\\tau": "τ", "$": "", "_": ""}.items():
        label = label.replace(name, letter)
    return label


def parameter_lines(nominal: MPC, learned: MPC, found: Identification) -> tuple[ParameterLine, ...]:
    """All numbers of the proposed MPC; the entries of a symmetric matrix once."""
    before = {block.name: block for block in nominal.space}
    index = {name: i for i, name in enumerate(nominal.space.names)}
    left = {part for text in found.undetermined for part in text.split(" with ")}
    lines = []
    for block in learned.space:
        was = before.get(block.name)
        same = was is not None and was.shape == block.shape and was.kind == block.kind
        old = was.value if same and was is not None else np.full(block.shape, np.nan)
        for name, at in _entries(block):
            k = index.get(name) if block.group == "model" and block.kind == "free" and same else None
            known = k is not None and found.deviation[k] > 0.0
            numbers = (
                (float(found.theta[k]), float(found.deviation[k])) if known and k is not None else (np.nan, np.nan)
            )
            parts = float(old[at]), *numbers, float(block.value[at])
            lines.append(ParameterLine(name, block.group, block.unit, *parts, open=name in left))
    return tuple(lines)


def _entries(block: Block) -> list[tuple[str, tuple[int, ...]]]:
    """Name and place of each number of a parameter."""
    if block.kind == "psd":
        lower = [(i, j) for i in range(block.shape[0]) for j in range(i + 1)]
        return [(f"{block.name}[{i},{j}]", (i, j)) for i, j in lower]
    return list(zip(block.coordinate_names, np.ndindex(*block.shape), strict=True))


def column_lines(table: TransitionTable, layout: Layout) -> tuple[ColumnLine, ...]:
    """The range of each column of the log: states and signals, inputs, the cost."""
    columns = table.values()
    parts: Sequence[Array] = (columns.observations[:, : layout.ny], columns.actions, columns.costs.reshape(-1, 1))
    return tuple(
        ColumnLine(*(float(of(column)) for of in (np.min, np.mean, np.max, np.std)))
        for part in parts
        for column in part.T
    )


def episode_line(table: TransitionTable) -> tuple[int, int, int, int]:
    """See :attr:`Background.episodes`."""
    lengths, ended = table.episodes.lengths, int((np.asarray(table.terminations) > 0.0).sum())
    return int(lengths.min()), int(np.median(lengths)), int(lengths.max()), ended


def made_by(learner: OfflineMPCLearner, table: TransitionTable, seed: int) -> tuple[tuple[str, str], ...]:
    """What is needed to make the same report again, and to see whether two are of the same fit."""
    theta = np.ascontiguousarray(learner.mpc.theta, dtype="<f8")
    how = f"method {type(learner.method).__name__}" if learner.preset is None else f"preset {learner.preset}"
    return (
        ("fit", f"learn={learner.learn}, {how}"),
        ("seed of the fit", str(learner.seed)),
        ("seed of this diagnosis", str(seed)),
        ("SHA-256 of the learned theta", hashlib.sha256(theta.data).hexdigest()),
        ("SHA-256 of the log", hash_of(table)),
        ("Python", platform.python_version()),
        *((name, version(name)) for name in _PACKAGES),
    )
