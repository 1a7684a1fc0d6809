"""The steps of a function with layers: what they are, which maps there are, and in which order all is computed."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array

ROWS = 4  # of a matrix or a map, at least


@dataclass(frozen=True)
class Node:
    """One result: an operation on earlier results, by number; an input's operands are (input, element)."""

    op: int
    operands: tuple[int, ...]
    constant: float


@dataclass(frozen=True)
class Dense:
    """targets = matrix @ sources + bias, of results by number."""

    matrix: Array
    bias: Array
    sources: list[int]
    targets: list[int]


@dataclass(frozen=True)
class Map:
    """targets[k, i] = the k-th result of a small program of sources[i] and constants[:, i].

    Attributes:
        program: Operations; an operand is -1 for the source, ``-2 - c`` for constant c, else an earlier operation.
        results: The operations whose results are the targets.
        constants: One a row, and a source.
        sources: Numbers of results.
        targets: A list of numbers for each of ``results``.
    """

    program: list[tuple[int, tuple[int, ...]]]
    results: list[int]
    constants: Array
    sources: list[int]
    targets: list[list[int]]


@dataclass(frozen=True)
class Scalars:
    """Operations one by one: numbers of results, in order."""

    nodes: list[int]


def _sources(nodes: Sequence[Node], k: int, makers: Mapping[int, Dense | Map]) -> Sequence[int]:
    """What has to be known before a result is."""
    if k in makers:
        return makers[k].sources
    return () if nodes[k].op == ca.OP_INPUT else nodes[k].operands


def readers_of(nodes: Sequence[Node], outputs: list[int], makers: Mapping[int, Dense | Map]) -> dict[int, set[int]]:
    """Of each result that the outputs need: the scalar operations that read it, and -1 for layers and outputs."""
    readers: dict[int, set[int]] = {}
    stack = [(output, -1) for output in outputs]
    while stack:
        k, reader = stack.pop()
        known = k in readers
        readers.setdefault(k, set()).add(reader)
        if not known:
            stack.extend((source, -1 if k in makers else k) for source in _sources(nodes, k, makers))
    return readers


def common_map(
    nodes: Sequence[Node], sources: list[int], readers: Mapping[int, set[int]], makers: Mapping[int, Dense | Map]
) -> Map | None:
    """What happens to each of a layer's results alone, where it is the same for many of them."""
    alike: dict[tuple[Any, Any], list[tuple[int, list[int], list[float]]]] = {}
    for source in sources:
        family = _family(nodes, source, readers, makers)
        results = sorted(k for k in family if not readers[k] <= family)
        if results:
            program, places, constants = _program(nodes, source, results)
            alike.setdefault((tuple(program), tuple(places)), []).append((source, results, constants))
    if not alike:
        return None
    key, rows = max(alike.items(), key=lambda item: len(item[1]))
    if len(rows) < ROWS:
        return None
    program, places = key
    constants_of = np.array([constants for *_, constants in rows]).T
    targets = [[results[i] for _, results, _ in rows] for i in range(len(places))]
    return Map(list(program), list(places), constants_of, [source for source, *_ in rows], targets)


def _family(
    nodes: Sequence[Node], source: int, readers: Mapping[int, set[int]], makers: Mapping[int, Dense | Map]
) -> set[int]:
    """The operations that read nothing but one result, constants, and each other."""
    family: set[int] = set()
    queue = sorted(readers.get(source, ()))
    while queue:
        k = queue.pop(0)
        if k < 0 or k in family or k in makers:
            continue
        if all(o == source or o in family or nodes[o].op == ca.OP_CONST for o in nodes[k].operands):
            family.add(k)
            queue.extend(sorted(readers[k]))
    return family


def _program(
    nodes: Sequence[Node], source: int, results: list[int]
) -> tuple[list[tuple[int, tuple[int, ...]]], list[int], list[float]]:
    """A small program as :class:`Map` has it, the places of the results in it, and its constants."""
    program: list[tuple[int, tuple[int, ...]]] = []
    constants: list[float] = []
    place = {source: -1}

    def visit(k: int) -> int:
        if nodes[k].op == ca.OP_CONST:
            constants.append(nodes[k].constant)
            return -1 - len(constants)
        if k not in place:
            operands = tuple(visit(operand) for operand in nodes[k].operands)
            program.append((nodes[k].op, operands))
            place[k] = len(program) - 1
        return place[k]

    return program, [visit(k) for k in results], constants


def scheduled(
    nodes: Sequence[Node], outputs: list[int], makers: Mapping[int, Dense | Map]
) -> list[Dense | Map | Scalars]:
    """All that the outputs need, in an order in which it can be computed, scalars in as few runs as possible."""
    needed = readers_of(nodes, outputs, makers)
    waiting = {k: set(_sources(nodes, k, makers)) for k in needed if k not in makers}
    layers = {id(makers[k]): makers[k] for k in needed if k in makers}
    missing = {name: set(step.sources) for name, step in layers.items()}
    waiters: dict[int, list[int]] = {}  # by number: the scalars that wait for it
    for k, sources in waiting.items():
        for source in sources:
            waiters.setdefault(source, []).append(k)
    steps: list[Dense | Map | Scalars] = []
    known: set[int] = set()
    ready = [k for k, sources in waiting.items() if not sources]
    while ready or layers:
        run = []
        while ready:
            k = ready.pop()
            run.append(k)
            known.add(k)
            ready += _released(waiting, waiters, k)
        if run:
            steps.append(Scalars(run))
        name = next((name for name in layers if missing[name] <= known), None)
        if name is None:
            break
        step = layers.pop(name)
        steps.append(step)
        targets = step.targets if isinstance(step, Dense) else list(itertools.chain.from_iterable(step.targets))
        known.update(targets)
        for target in targets:
            ready += _released(waiting, waiters, target)
    return steps


def _released(waiting: dict[int, set[int]], waiters: Mapping[int, list[int]], k: int) -> list[int]:
    """The scalars that waited for nothing but k."""
    released = []
    for waiter in waiters.get(k, ()):
        waiting[waiter].discard(k)
        if not waiting[waiter]:
            released.append(waiter)
    return released
