"""One C function of an expression: a statement an operation."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc.expressions import Instruction, expanded

from .elimination import arithmetic

_INFIX = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*"}
_FORMATS = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_FABS: "vd_abs({0})",
    ca.OP_SIGN: "vd_bool({0} > 0.0) - vd_bool({0} < 0.0)",
    ca.OP_NOT: "vd_bool({0} == 0.0)",
    ca.OP_FMIN: "vd_min({0}, {1})",
    ca.OP_FMAX: "vd_max({0}, {1})",
    ca.OP_POW: "vd_pow({0}, {1})",
    ca.OP_CONSTPOW: "vd_pow({0}, {1})",
    ca.OP_ATAN2: "vd_atan2({0}, {1})",
    ca.OP_HYPOT: "vd_hypot({0}, {1})",
    ca.OP_FMOD: "vd_fmod({0}, {1})",
    ca.OP_REMAINDER: "vd_remainder({0}, {1})",
    ca.OP_COPYSIGN: "vd_copysign({0}, {1})",
    ca.OP_LT: "vd_bool({0} < {1})",
    ca.OP_LE: "vd_bool({0} <= {1})",
    ca.OP_EQ: "vd_bool({0} == {1})",
    ca.OP_NE: "vd_bool({0} != {1})",
    ca.OP_AND: "vd_bool(({0} != 0.0) & ({1} != 0.0))",
    ca.OP_OR: "vd_bool(({0} != 0.0) | ({1} != 0.0))",
    ca.OP_IF_ELSE_ZERO: "vd_select({0} != 0.0, {1}, V(0.0))",
} | {
    getattr(ca, f"OP_{name.upper()}"): f"vd_{name}({{0}})"
    for name in (
        "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil erf".split()  # noqa: SIM905
    )
}


# GCC's effort grows with the square of a function's length. Only functions of costs that are networks are so long.
_LONGEST = 2500
_PIECE = 500
_LARGEST_POWER = 4 * 6  # in quarters
_LEAST, _MOST = 1e-290, 1e290  # of what vd_rsqrt takes


def emit(name: str, inputs: list[ca.SX], output: ca.SX, attribute: str = "") -> str:
    """One C function ``name(i0, i1, ..., out)`` of vectors of doubles; a long one calls pieces of itself in turn.

    The attribute stands in front of it, e.g. ``"NOINLINE "``.

    Raises:
        InvalidArgumentError: For an operation without a counterpart in C.
    """
    function = expanded(ca.Function(name, inputs, [output]))
    program = arithmetic(function)
    pointers = [f"i{k}" for k in range(len(inputs))]
    arguments = "".join(f"const vd *{pointer}, " for pointer in pointers) + "vd *out"
    if len(program) <= _LONGEST:
        statements = _Statements(name, program, len(program), function.sz_w()).texts
        return _function(name, arguments, statements, [*pointers, "out"], attribute)
    written = _Statements(name, program, _PIECE, function.sz_w())
    work, pieces, calls = f"vd w[{written.size}];", [], []
    for k, start in enumerate(range(0, len(program), _PIECE)):
        lines = written.texts[start : start + _PIECE]
        pieces.append(
            _function(f"{name}_{k}", f"{arguments}, vd *RESTRICT w", lines, [*pointers, "out", "w"], "NOINLINE ")
        )
        calls.append(f"{name}_{k}({', '.join(pointers)}, out, w);")
    return "\n\n".join([*pieces, _function(name, arguments, [work, *calls], [])])


def _function(name: str, arguments: str, statements: list[str], unused: list[str], attribute: str = "") -> str:
    """A C function; of ``unused``, those that the statements do not name are marked so."""
    named = set(re.findall(r"\b(?:i\d+|out|w)\b", " ".join(statements)))
    marks = [f"(void){argument};" for argument in unused if argument not in named]
    lines = [f"    {line}" for line in (*marks, *statements)]
    return "\n".join([f"{attribute}static void {name}({arguments}) {{", *lines, "}"])


class _Statements:
    """One C statement an instruction; values that a later piece reads go through the array ``w`` of all pieces.

    Divisions multiply by reciprocals, as a model's derivatives divide by the same few numbers again and again; each is
    computed where its divisor is. That of a root of what is positive for sure, as in ``a / sqrt(1 + a^2)``, takes
    neither root nor division. Powers of quarters are products of the base and its roots: lanes share an instruction for
    these, none for ``pow``.

    Args:
        name: Of the function, for errors.
        program: Its instructions.
        piece: How many make a piece.
        size: How many places its work vector has.

    Attributes:
        texts: The statements.
        size: How many places the array ``w`` needs.

    Raises:
        InvalidArgumentError: For an operation without a counterpart in C.
    """

    def __init__(self, name: str, program: list[Instruction], piece: int, size: int) -> None:
        self._name, self._program, self._piece, self.size = name, program, piece, size
        # Of each instruction: the places that it reads, and whose values they are.
        self._read: list[dict[int, int]] = []
        value_in: dict[int, int] = {}  # by place in the work vector: the instruction whose value is there
        for k, (op, sources, targets, _) in enumerate(program):
            own = op in (ca.OP_INPUT, ca.OP_CONST)
            self._read.append({} if own else {place: value_in[place] for place in sources})
            if op != ca.OP_OUTPUT:
                value_in[targets[0]] = k
        self._floors = self._positive()
        self._divided, self._last_read = self._readers()
        self._places: dict[int, int] = {}  # of reciprocals that a later piece reads
        # Roots that are known: piece, half or quarter power, number of the base.
        self._roots: set[tuple[int, str, int]] = set()
        self.texts: list[str] = [self._text(k) for k in range(len(program))]

    def _positive(self) -> list[float]:
        """A number that each value is at least, where that is zero or more for sure; else -1."""
        floors: list[float] = []
        for k, (op, sources, _, constant) in enumerate(self._program):
            of = [floors[self._read[k][place]] for place in sources if place in self._read[k]]
            floor = -1.0
            if op == ca.OP_CONST:
                floor = constant if constant >= 0.0 else -1.0
            elif op == ca.OP_ADD:
                floor = sum(of) if min(of) >= 0.0 else -1.0
            elif op in (ca.OP_SQ, ca.OP_FABS):
                floor = 0.0
            floors.append(floor)
        return floors

    def _readers(self) -> tuple[dict[int, int], dict[int, int]]:
        """The last instruction that divides by each divisor, and the last that reads each value otherwise."""
        divided, last = dict[int, int](), dict[int, int]()
        for k, (op, sources, _, _) in enumerate(self._program):
            reads = [self._read[k][place] for place in sources if place in self._read[k]]
            if op in (ca.OP_DIV, ca.OP_INV):
                divided[reads.pop()] = k
            last.update(dict.fromkeys(reads, k))
        for k in sorted(divided):
            if (half := self._rooted_half(k)) is not None:
                divided[half] = max(divided.get(half, k), k)
        return divided, last

    def _operand(self, k: int, which: int = 0) -> int:
        """Whose value an instruction reads."""
        return self._read[k][self._program[k].sources[which]]

    def _is_root(self, k: int) -> bool:
        """Whether it is the root of a value that is no less than a normal number, which is none too large either."""
        return self._program[k].op == ca.OP_SQRT and _LEAST < self._floors[self._operand(k)] < _MOST

    def _rooted_half(self, k: int) -> int | None:
        """The root, of twice such a root: CasADi's derivative of a root divides by that."""
        twice = self._program[k].op == ca.OP_TWICE
        return half if twice and self._is_root(half := self._operand(k)) else None

    def _start(self, k: int) -> int:
        return k - k % self._piece

    def _value(self, k: int, of: int) -> str:
        """A value, where instruction k reads it."""
        return f"v{of}" if of >= self._start(k) else f"w[{self._program[of].targets[0]}]"

    def _reciprocal(self, k: int, of: int) -> str:
        """One over a value, where instruction k reads it."""
        return f"r{of}" if of >= self._start(k) else f"w[{self._places[of]}]"

    def _text(self, k: int) -> str:
        """The statement of an instruction."""
        op, _, targets, _ = self._program[k]
        if op == ca.OP_OUTPUT:
            return f"out[{targets[1]}] = {self._value(k, self._operand(k))};"
        end = self._start(k) + self._piece
        if k in self._divided and self._is_root(k):
            of = self._value(k, self._operand(k))
            value = f" const vd v{k} = {of} * r{k};" if k in self._last_read else ""
            text = f"const vd r{k} = vd_rsqrt({of});{value}"
        else:
            first, result = self._result(k)
            text = f"{first}const vd v{k} = {result};"
            if k in self._divided:
                half = self._rooted_half(k)
                one_over = f"1.0 / v{k}" if half is None else f"0.5 * {self._reciprocal(k, half)}"
                text += f" const vd r{k} = {one_over};"
        if self._last_read.get(k, k) >= end:
            text += f" w[{targets[0]}] = v{k};"
        if self._divided.get(k, k) >= end:
            self._places[k] = self.size
            text += f" w[{self.size}] = r{k};"
            self.size += 1
        return text

    def _result(self, k: int) -> tuple[str, str]:
        """What has to stand before an instruction's value, and the value."""
        op, sources, _, constant = self._program[k]
        if op == ca.OP_CONST:
            return "", f"V({literal(constant)})"
        if op == ca.OP_INPUT:
            return "", f"i{sources[0]}[{sources[1]}]"
        if op in (ca.OP_DIV, ca.OP_INV):
            *factors, divisor = (self._read[k][place] for place in sources)
            return "", " * ".join([*(self._value(k, of) for of in factors), self._reciprocal(k, divisor)])
        names = [self._value(k, self._read[k][place]) for place in sources]
        if op in _INFIX:
            return "", f"{names[0]} {_INFIX[op]} {names[1]}"
        if op in (ca.OP_POW, ca.OP_CONSTPOW) and (power := _rooted(self._program[self._operand(k, 1)])) is not None:
            return self._power(k, power, names[0])
        if op in _FORMATS:
            return "", _FORMATS[op].format(*names)
        raise InvalidArgumentError(self._name, expected="operations that C has", actual=f"CasADi operation {op}")

    def _power(self, k: int, quarters: int, named: str) -> tuple[str, str]:
        """A power of quarters: roots of the base that are not known in this piece, and their product."""
        base, first = self._operand(k), ""
        for root, of in (("h", named), ("q", f"h{base}"))[: _roots_of(quarters)]:
            if (self._start(k), root, base) not in self._roots:
                self._roots.add((self._start(k), root, base))
                first += f"const vd {root}{base} = vd_sqrt({of}); "
        return first, _product(quarters, named, base)


def _rooted(exponent: Instruction) -> int | None:
    """How many quarters an exponent is; None where it is no number, of no quarters, or a large one."""
    op, _, _, constant = exponent
    quarters = 4.0 * constant if op == ca.OP_CONST else np.nan
    return int(quarters) if 0.0 < abs(quarters) <= _LARGEST_POWER and quarters == round(quarters) else None


def _roots_of(quarters: int) -> int:
    """How many roots in a row a power needs: of none, of the base, of that root, too."""
    return 2 if quarters % 2 else quarters % 4 // 2


def _product(quarters: int, base: str, number: int) -> str:
    """The power as a product of the base and its roots."""
    whole, rest = divmod(abs(quarters), 4)
    factors = [base] * whole + [f"h{number}"] * (rest >= 2) + [f"q{number}"] * (rest % 2)
    product = " * ".join(factors)
    return product if quarters > 0 else f"1.0 / ({product})"


def literal(value: float) -> str:
    """A number in C."""
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))
