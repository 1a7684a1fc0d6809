"""C of a model with layers: loops over constant matrices, with the scalar arithmetic between them as it is.

Derivatives by (x, u) go forward through the layers. A product with a matrix, a map of results, or a run of scalar
operations each reads results of earlier steps and their derivatives, and appends its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc.layer_steps import Dense, Map, Scalars
from mpcoffline.mpc.layers import Layered

from .elimination import Graph, applied
from .emission import emit, literal

_PAD = 4  # layers.c takes rows of matrices by fours


@dataclass(frozen=True)
class _Run:
    """A run of scalar operations: what it gives, what it reads of other steps, and the derivatives between them.

    Attributes:
        targets: Results that others read, or whose derivatives are computed one by one.
        values: Expressions of them, in the symbols of ``sources``.
        sources: The symbols of other steps' results, by number.
        edges: Numbers of target and source, a derivative each; first those by states and inputs themselves.
        n_by_states: How many these are.
        slopes: These derivatives.
    """

    targets: list[int]
    values: ca.SX
    sources: dict[int, ca.SX]
    edges: list[tuple[int, int]]
    n_by_states: int
    slopes: ca.SX


class LayeredCode:
    """The functions ``model_values(x, u, p, out)`` and ``model_slopes(x, u, p, out)`` of a model, in C.

    Both write x+ ``[NX]``; the second the Jacobian by (x, u) behind it, row by row.

    Args:
        structure: The model as steps, a function of x, u and theta.
        nx: Number of states.
        nu: Number of inputs.
        theta: Symbols of the parameters.

    Attributes:
        functions: Expressions that have to be emitted as C functions first: by name, their input besides the
            parameters, and the output.
        n_scalars: Operations that are in no layer.
    """

    def __init__(self, structure: Layered, nx: int, nu: int, theta: ca.SX) -> None:
        self._tables: dict[tuple[str, str], str] = {}  # by type and content: the name
        self.n_scalars: int = structure.n_scalars
        self._steps, self._outputs, self._nodes = structure.steps, structure.outputs, structure.nodes
        self._theta = theta
        self._states, self._nz = dict(_states(structure, nx)), nx + nu
        exported = self._exported()
        runs = {k: self._run(step.nodes, exported) for k, step in enumerate(self._steps) if isinstance(step, Scalars)}
        self._runs = {k: run for k, run in runs.items() if run.targets}
        self._slots, self._size = self._allocated(self._nz)
        self._constant = self._constant_slopes()
        v = ca.SX.sym("v", self._size)
        self.functions: dict[str, tuple[ca.SX, ca.SX]] = {}
        for k, run in self._runs.items():
            symbols, places = ca.vertcat(*run.sources.values()), [self._slots[source] for source in run.sources]
            in_slots = ca.vertcat(*(v[place] for place in places))
            slopes = ca.vertcat(run.values, run.slopes)
            values, slopes = ca.substitute([run.values, slopes], [symbols], [in_slots])
            self.functions[f"run{k}_values"], self.functions[f"run{k}_slopes"] = (v, values), (v, slopes)

    def _exported(self) -> set[int]:
        """The results that are read outside of the run of scalars that gives them; states and inputs are none."""
        run_of = {k: i for i, step in enumerate(self._steps) if isinstance(step, Scalars) for k in step.nodes}
        read = set(self._outputs)
        for i, step in enumerate(self._steps):
            if isinstance(step, Scalars):
                for k in step.nodes:
                    if self._nodes[k].op != ca.OP_INPUT:
                        read |= {o for o in self._nodes[k].operands if run_of.get(o) != i and self._known(o) is None}
            else:
                read.update(step.sources)
        return (read & run_of.keys()) - self._states.keys()

    def _allocated(self, first: int) -> tuple[dict[int, int], int]:
        """A slot for each result that is kept, and how many there are; slots are used again behind the last reader."""
        last: dict[int, int] = dict.fromkeys(self._outputs, len(self._steps))
        for i, step in enumerate(self._steps):
            for source in self._runs[i].sources if i in self._runs else getattr(step, "sources", ()):
                last[source] = max(i, last.get(source, i))
        slots, size, free = dict(self._states), first, [(first, 1 << 30)]
        busy: list[tuple[int, int, int]] = []  # until which step, from where, how many
        for i, step in enumerate(self._steps):
            groups = [self._runs[i].targets] if i in self._runs else []
            if not isinstance(step, Scalars):
                groups = [step.targets] if isinstance(step, Dense) else step.targets
            for group in groups:
                n = _padded(len(group))
                hole = next(hole for hole in free if hole[1] >= n)
                free[free.index(hole)] = hole[0] + n, hole[1] - n
                slots.update({k: hole[0] + j for j, k in enumerate(group)})
                busy.append((max(last.get(k, i) for k in group), hole[0], n))
                size = max(size, hole[0] + n)
            free = _merged([*free, *((start, n) for until, start, n in busy if until <= i)])
            busy = [entry for entry in busy if entry[0] > i]
        return slots, size

    def _constant_slopes(self) -> dict[int, Array]:
        """Results whose derivatives by states and inputs are numbers, and these ``(nx + nu,)``."""
        found = dict(zip(self._states, np.eye(self._nz)[list(self._states.values())], strict=True))
        for run in self._runs.values():
            rows, varying = {k: np.zeros(self._nz) for k in run.targets}, set[int]()
            for (k, source), slope in zip(run.edges, ca.vertsplit(run.slopes), strict=True):
                if source in found and slope.is_constant():
                    rows[k] += float(slope) * found[source]
                else:
                    varying.add(k)
            found |= {k: row for k, row in rows.items() if k not in varying}
        return found

    def _known(self, k: int) -> ca.SX | None:
        """A result that needs no slot where scalar operations read it: a constant or a parameter."""
        node = self._nodes[k]
        if node.op == ca.OP_CONST:
            return ca.SX(node.constant)
        if node.op == ca.OP_INPUT and k not in self._states:
            return self._theta[node.operands[1]]
        return None

    def _run(self, numbers: list[int], exported: set[int]) -> _Run:
        """The values of a run's results, and the derivatives between them.

        Operations through which there are few paths are eliminated; the others' derivatives by (x, u) are computed in C
        one by one, or eliminated, too, where that takes fewer multiplications: a step of RK4 has a thousand operations
        and a Jacobian of a hundred entries.
        """
        graph, place, sources = Graph(), dict[int, int](), dict[int, ca.SX]()
        varying: set[int] = set()

        def enter(k: int) -> int:
            if k not in place:
                known = self._known(k)
                if known is None:
                    known = sources[k] = ca.SX.sym(f"r{k}")
                    varying.add(len(graph.values))
                place[k] = graph.add(known)
            return place[k]

        own = [k for k in numbers if k not in self._states and (self._known(k) is None or k in exported)]
        for k in own:
            if self._known(k) is not None:
                enter(k)
                continue
            operands = [enter(operand) for operand in self._nodes[k].operands]
            place[k] = applied(graph, self._nodes[k].op, operands, varying)
            if not varying.isdisjoint(operands):
                varying.add(place[k])
        inner = [place[k] for k in own if k not in exported and graph.into[place[k]]]
        graph.eliminate_all(inner, growing=False)

        def multiplications(graph: Graph) -> int:
            return len(self._states) * sum(len(graph.into[place[k]]) for k in own)

        whole, most = graph.copy(), multiplications(graph)
        taken = whole.eliminate_all([k for k in inner if graph.into[k]], most=most)
        if taken + multiplications(whole) < most:
            graph = whole
        number = {at: k for k, at in place.items()}
        targets = [k for k in own if k in exported or graph.into[place[k]]]
        edges = [(k, number[source], slope) for k in targets for source, slope in graph.into[place[k]].items()]
        edges.sort(key=lambda edge: edge[1] not in self._states)
        n_by_states = sum(source in self._states for _, source, _ in edges)
        values = ca.vertcat(*(graph.values[place[k]] for k in targets))
        slopes = ca.vertcat(*(slope for *_, slope in edges))
        return _Run(targets, values, sources, [(k, source) for k, source, _ in edges], n_by_states, slopes)

    def maps(self) -> list[str]:
        """The C functions of the layers' maps: of a source and constants the results, and their derivatives."""
        parts = []
        for k, step in enumerate(self._steps):
            if isinstance(step, Map):
                source, constants, results = _mapped(step)
                slopes = ca.vertcat(*(ca.jacobian(result, source) for result in ca.vertsplit(results)))
                parts.append(emit(f"map{k}_values", [source, constants], results))
                parts.append(emit(f"map{k}_slopes", [source, constants], ca.densify(ca.vertcat(results, slopes))))
        return parts

    def drivers(self) -> str:
        """The two functions, and the numbers of the layers; behind what they call."""
        functions = []
        for kind in ("values", "slopes"):
            slopes = kind == "slopes"
            body = [f"vd v[{self._size}];", *([f"vd d[{self._size} * NZ];"] if slopes else []), "(void)p;"]
            body.append("for (int i = 0; i < NX; ++i) v[i] = x[i];")
            body.append("for (int i = 0; i < NU; ++i) v[NX + i] = u[i];")
            if slopes:
                body.append("for (int i = 0; i < NZ * NZ; ++i) d[i] = V(i % (NZ + 1) ? 0.0 : 1.0);")
            for k, step in enumerate(self._steps):
                if isinstance(step, Dense):
                    body += self._dense(step, slopes=slopes)
                elif isinstance(step, Map):
                    body += self._map(k, step, slopes=slopes)
                elif k in self._runs:
                    body += self._scalars(k, slopes=slopes)
            at = self._integers([self._slots[k] for k in self._outputs])
            body.append(f"layer_gather({at}, NX, v, out);")
            if slopes:
                body.append(f"layer_gather_slopes({at}, NX, d, out + NX);")
            head = f"static NOINLINE void model_{kind}(const vd *x, const vd *u, const vd *p, vd *out) {{"
            functions.append("\n".join([head, *(f"    {line}" for line in body), "}"]))
        tables = [f"static const {content[0]} {name}[] = {{{content[1]}}};" for content, name in self._tables.items()]
        return "\n\n".join(["\n".join(tables), *functions])

    def _table(self, kind: str, content: str) -> str:
        """The name of a table of numbers; equal ones are one, as the layers of an RK4 step's four stages."""
        return self._tables.setdefault((kind, content), f"table{len(self._tables)}")

    def _numbers(self, values: Array) -> str:
        return self._table("double", ", ".join(literal(float(value)) for value in values))

    def _integers(self, values: Sequence[int]) -> str:
        return self._table("int", ", ".join(map(str, values)))

    def _dense(self, step: Dense, *, slopes: bool) -> list[str]:
        rows, columns = step.matrix.shape
        padding = _padded(rows) - rows
        by_fours = np.pad(step.matrix, ((0, padding), (0, 0))).reshape(-1, _PAD, columns).transpose(0, 2, 1)
        matrix, bias = self._numbers(by_fours.ravel()), self._numbers(np.pad(step.bias, (0, padding)))
        first, to = self._span(step.sources), self._slots[step.targets[0]]
        shape, source, slope_source, lines = f"{rows + padding}, {columns}", f"v + {first}", f"d + {first} * NZ", []
        at = ""
        if first is None:
            at = self._integers([self._slots[k] for k in step.sources])
            source = slope_source = "in"
            lines = [f"vd in[{columns}{' * NZ' if slopes else ''}];", f"layer_gather({at}, {columns}, v, in);"]
        lines.append(f"layer_values({matrix}, {bias}, {shape}, {source}, v + {to});")
        if slopes and self._constant.keys() >= set(step.sources):
            by_states = step.matrix @ np.stack([self._constant[k] for k in step.sources])
            padded = np.pad(by_states, ((0, padding), (0, 0)))
            lines.append(f"layer_constants({self._numbers(padded.ravel())}, {rows + padding}, d + {to} * NZ);")
        elif slopes:
            lines += [f"layer_gather_slopes({at}, {columns}, d, in);"] if at else []
            lines.append(f"layer_slopes({matrix}, {shape}, {slope_source}, d + {to} * NZ);")
        return ["{", *(f"    {line}" for line in lines), "}"]

    def _map(self, k: int, step: Map, *, slopes: bool) -> list[str]:
        n, results, varying = len(step.sources), len(step.results), _varying(step)
        first = self._span(step.sources)
        at = f"{first} + i" if first is not None else f"{self._integers([self._slots[o] for o in step.sources])}[i]"
        lines = [f"vd g[{results * (1 + slopes)}], c[{max(1, len(varying))}];"]
        lines += [f"c[{i}] = V({self._numbers(step.constants[c])}[i]);" for i, c in enumerate(varying)]
        lines += ["(void)c;"] if not varying else []
        lines += [f"int at = {at};", f"map{k}_{'slopes' if slopes else 'values'}(v + at, c, g);"]
        for j, targets in enumerate(step.targets):
            to = self._slots[targets[0]]
            lines.append(f"v[{to} + i] = g[{j}];")
            if slopes:
                lines.append(f"layer_scaled(g[{results + j}], d + at * NZ, d + ({to} + i) * NZ);")
        return [f"for (int i = 0; i < {n}; ++i) {{", *(f"    {line}" for line in lines), "}"]

    def _scalars(self, k: int, *, slopes: bool) -> list[str]:
        run = self._runs[k]
        to, n, n_edges = self._slots[run.targets[0]], len(run.targets), len(run.edges)
        if not slopes:
            return [f"run{k}_values(v, p, v + {to});"]
        lines = [f"vd g[{n + n_edges}];", f"run{k}_slopes(v, p, g);"]
        lines.append(f"for (int i = 0; i < {n}; ++i) v[{to} + i] = g[i];")
        lines.append(f"for (int i = {to} * NZ; i < {to + n} * NZ; ++i) d[i] = V(0.0);")
        if run.n_by_states:
            by_states = run.edges[: run.n_by_states]
            places = self._integers([self._slots[k] * self._nz + self._slots[o] for k, o in by_states])
            lines.append(f"for (int e = 0; e < {run.n_by_states}; ++e) d[{places}[e]] += g[{n} + e];")
        if others := run.edges[run.n_by_states :]:
            to_slots, from_slots = ([self._slots[o] for o in side] for side in zip(*others, strict=True))
            source, target = self._integers(from_slots), self._integers(to_slots)
            lines.append(f"for (int e = 0; e < {len(others)}; ++e)")
            first = n + run.n_by_states
            lines.append(f"    layer_added(g[{first} + e], d + {source}[e] * NZ, d + {target}[e] * NZ);")
        return ["{", *(f"    {line}" for line in lines), "}"]

    def _span(self, numbers: list[int]) -> int | None:
        """The slot of the first of these results, if they lie one behind the other."""
        slots = [self._slots[number] for number in numbers]
        return slots[0] if slots == list(range(slots[0], slots[0] + len(slots))) else None


def _states(structure: Layered, nx: int) -> list[tuple[int, int]]:
    """The numbers of the states and inputs, and their slots."""
    inputs = [(k, node.operands) for k, node in enumerate(structure.nodes) if node.op == ca.OP_INPUT]
    return [(k, element + (nx if which else 0)) for k, (which, element) in inputs if which < 2]


def _merged(holes: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Free ranges (start, length) in order, neighbours joined."""
    merged: list[tuple[int, int]] = []
    for start, n in sorted(hole for hole in holes if hole[1]):
        if merged and sum(merged[-1]) == start:
            merged[-1] = merged[-1][0], merged[-1][1] + n
        else:
            merged.append((start, n))
    return merged


def _padded(n: int) -> int:
    return -(-n // _PAD) * _PAD


def _varying(step: Map) -> list[int]:
    """The constants of a map that are not the same for all."""
    return [c for c, row in enumerate(step.constants) if np.ptp(row) != 0.0]


def _mapped(step: Map) -> tuple[ca.SX, ca.SX, ca.SX]:
    """The source of a map, those of its constants that vary, and its results, as symbols and expressions."""
    varying = _varying(step)
    source, symbols = ca.SX.sym("source"), ca.SX.sym("c", max(1, len(varying)))
    constants = [ca.SX(row[0]) for row in step.constants]
    for i, c in enumerate(varying):
        constants[c] = symbols[i]
    work: list[ca.SX] = []
    for op, operands in step.program:
        a, *rest = (source if o == -1 else constants[-2 - o] if o < 0 else work[o] for o in operands)
        work.append(ca.SX.binary(op, a, rest[0]) if rest else ca.SX.unary(op, a))
    return source, symbols, ca.vertcat(*(work[k] for k in step.results))
