"""Layers in a function's arithmetic: matrix products and maps of their results, found again in scalar instructions.

A network of 64 x 64 units is 10,000 scalar instructions, and an RK4 step of it 40,000. Neither a compiler nor torch has
to see them: the sums of products that share their factors are a product with a constant matrix, and what happens to
each of its results alone is one small function of all of them. How the network was written does not matter, nor how
often it is called.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from .expressions import Instruction, expanded, instructions
from .layer_steps import ROWS, Dense, Map, Node, Scalars, common_map, readers_of, scheduled

_LINEAR = (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_TWICE, ca.OP_MUL, ca.OP_DIV)
_ENTRIES = 64
_DENSITY = 0.4  # of a matrix, at least: what is sparser has its zeros left out as scalar code
_TERMS = 3  # of a sum, at least


@dataclass(frozen=True)
class Layered:
    """A function as steps that each read results of earlier ones.

    Attributes:
        nodes: All results by number.
        steps: What to compute, in order.
        outputs: The numbers of the function's outputs.
    """

    nodes: list[Node]
    steps: list[Dense | Map | Scalars]
    outputs: list[int]

    @property
    def n_scalars(self) -> int:
        """Operations that are in no layer."""
        return sum(len(step.nodes) for step in self.steps if isinstance(step, Scalars))


def may_be_layered(flat: ca.Function) -> bool:
    """Whether an SX function has as many different numbers as the sparsest matrix of a layer has entries.

    That is soon counted: derivatives of a plant's model have thousands of operations and a dozen numbers, and whether
    they have layers takes a tenth of a second to find out. A guess for who only wants to be fast: weights of three
    values make layers, too, which :func:`layered` finds.

    Args:
        flat: An SX function.
    """
    found: set[float] = set()
    for k in range(flat.n_instructions()):
        if flat.instruction_id(k) == ca.OP_CONST:
            found.add(flat.instruction_constant(k))
            if len(found) >= _DENSITY * _ENTRIES:
                return True
    return False


def layered(function: ca.Function) -> Layered | None:
    """The layers of a function's first output, or None if it has none.

    A layer's matrix holds at least 64 numbers, which are constants; weights that are parameters stay scalar arithmetic.

    Raises:
        InvalidArgumentError: If CasADi cannot expand the function to SX.
    """
    nodes, outputs = _results(instructions(expanded(function)))
    blocks = _blocks(_sums(nodes, outputs))
    if not blocks:
        return None
    dense = [block.dense(nodes) for block in blocks]
    makers: dict[int, Dense | Map] = {target: step for step in dense for target in step.targets}
    readers = readers_of(nodes, outputs, makers)
    for step in dense:
        if (of_all := common_map(nodes, step.targets, readers, makers)) is not None:
            makers.update({target: of_all for row in of_all.targets for target in row})
    return Layered(nodes, scheduled(nodes, outputs, makers), outputs)


def _results(program: Iterable[Instruction]) -> tuple[list[Node], list[int]]:
    """Every result by number, and the numbers of the first output's elements."""
    nodes: list[Node] = []
    outputs: dict[int, int] = {}
    latest: dict[int, int] = {}  # by place in the work vector
    for op, sources, targets, constant in program:
        if op == ca.OP_OUTPUT:
            if targets[0] == 0:
                outputs[targets[1]] = latest[sources[0]]
            continue
        if op == ca.OP_INPUT:
            operands = tuple(sources)
        elif op == ca.OP_CONST:
            operands = ()
        else:
            operands = tuple(latest[source] for source in sources)
        latest[targets[0]] = len(nodes)
        nodes.append(Node(op, operands, constant))
    return nodes, [outputs[i] for i in range(len(outputs))]


@dataclass
class _Sum:
    """bias + sum of factors times results."""

    terms: dict[int, float]
    bias: float = 0.0

    def scaled(self, factor: float) -> _Sum:
        if factor == 1.0:
            return self
        return _Sum({k: factor * c for k, c in self.terms.items()}, factor * self.bias)

    def plus(self, other: _Sum) -> _Sum:
        """Their sum, made of the longer one."""
        longer, shorter = (self, other) if len(self.terms) >= len(other.terms) else (other, self)
        for k, c in shorter.terms.items():
            longer.terms[k] = longer.terms.get(k, 0.0) + c
        longer.bias += shorter.bias
        return longer


def _sums(nodes: Sequence[Node], outputs: Iterable[int]) -> dict[int, _Sum]:
    """The results that are sums of products with constants, except those that only such a sum reads.

    A sum that several read is computed once: it stays a result of its own, so that a product of two matrices is not
    multiplied out.
    """
    uses = [0] * len(nodes)
    for node in nodes:
        if node.op != ca.OP_INPUT:
            for operand in node.operands:
                uses[operand] += 1
    for output in outputs:
        uses[output] += 1
    sums: dict[int, _Sum] = {}

    def taken(k: int) -> _Sum:
        if nodes[k].op == ca.OP_CONST:
            return _Sum({}, nodes[k].constant)
        found = sums.get(k)
        if found is None:
            return _Sum({k: 1.0})
        if uses[k] == 1:
            return sums.pop(k)
        return _Sum(dict(found.terms)) if len(found.terms) == 1 and not found.bias else _Sum({k: 1.0})

    for k, (node, constants) in enumerate(zip(nodes, _constants(nodes), strict=True)):
        if node.op not in _LINEAR or constants is None:
            continue
        first = node.operands[0]
        if node.op in (ca.OP_ADD, ca.OP_SUB):
            second = taken(node.operands[1])
            sums[k] = taken(first).plus(second if node.op == ca.OP_ADD else second.scaled(-1.0))
        elif node.op in (ca.OP_NEG, ca.OP_TWICE):
            sums[k] = taken(first).scaled(-1.0 if node.op == ca.OP_NEG else 2.0)
        else:
            of, factor = constants
            sums[k] = taken(of).scaled(factor)
    return sums


def _constants(nodes: Sequence[Node]) -> Iterable[tuple[int, float] | None]:
    """Of each product: what is multiplied by which constant, or None; anything for other operations."""
    for node in nodes:
        if node.op not in (ca.OP_MUL, ca.OP_DIV):
            yield (-1, 1.0)
            continue
        left, right = node.operands
        if nodes[right].op == ca.OP_CONST and (node.op == ca.OP_MUL or nodes[right].constant != 0.0):
            value = nodes[right].constant
            yield (left, value if node.op == ca.OP_MUL else 1.0 / value)
        elif nodes[left].op == ca.OP_CONST and node.op == ca.OP_MUL:
            yield (right, nodes[left].constant)
        else:
            yield None


@dataclass
class _Block:
    """Sums that share most of what they read; computed where the first of them stands."""

    position: int
    columns: dict[int, int]
    rows: list[tuple[int, _Sum]] = field(default_factory=list)

    def takes(self, terms: dict[int, float], shared: int) -> bool:
        """Whether a sum belongs here, of whose terms so many are columns."""
        return 2 * shared >= max(len(terms), len(self.columns))

    def add(self, k: int, total: _Sum) -> None:
        for source in total.terms:
            if source < self.position:
                self.columns.setdefault(source, len(self.columns))
        self.rows.append((k, total))

    def pays(self) -> bool:
        entries = len(self.rows) * len(self.columns)
        filled = sum(len(total.terms) for _, total in self.rows)
        return len(self.rows) >= ROWS and entries >= _ENTRIES and filled >= _DENSITY * entries

    def dense(self, nodes: list[Node]) -> Dense:
        """The product. A sum that reads something late as well becomes scalar: the product's part of it, and the rest.

        These parts are new results, appended to the nodes.
        """
        matrix = np.zeros((len(self.rows), len(self.columns)))
        targets = []
        for i, (k, total) in enumerate(self.rows):
            targets.append(k)
            late = {}
            for source, c in total.terms.items():
                if source in self.columns:
                    matrix[i, self.columns[source]] = c
                else:
                    late[source] = c
            if late:
                targets[-1] = total_so_far = _added(nodes, ca.OP_PARAMETER)  # its operation is the matrix product
                for source, c in late.items():
                    product = _added(nodes, ca.OP_MUL, source, _added(nodes, ca.OP_CONST, constant=c))
                    total_so_far = _added(nodes, ca.OP_ADD, total_so_far, product)
                nodes[k] = nodes.pop()
        return Dense(matrix, np.array([total.bias for _, total in self.rows]), list(self.columns), targets)


def _added(nodes: list[Node], op: int, *operands: int, constant: float = 0.0) -> int:
    nodes.append(Node(op, operands, constant))
    return len(nodes) - 1


def _blocks(sums: dict[int, _Sum]) -> list[_Block]:
    """The sums that are rows of the same matrices; each is one of the latest that takes it."""
    blocks: list[_Block] = []
    holders: dict[int, list[int]] = {}  # the blocks of which a result is a column, by result
    for k, total in sums.items():
        if len(total.terms) < _TERMS:
            continue
        shared = Counter(i for source in total.terms for i in holders.get(source, ()))
        found = max((i for i, count in shared.items() if blocks[i].takes(total.terms, count)), default=len(blocks))
        if found == len(blocks):
            blocks.append(_Block(k, {}))
        before = len(blocks[found].columns)
        blocks[found].add(k, total)
        for source in list(blocks[found].columns)[before:]:
            holders.setdefault(source, []).append(found)
    return [block for block in blocks if block.pays()]
