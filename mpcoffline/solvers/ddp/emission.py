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
        return _function(name, arguments, _statements(name, program, len(program)), [*pointers, "out"], attribute)
    work, pieces, calls = f"vd w[{function.sz_w()}];", [], []
    statements = _statements(name, program, _PIECE)
    for k, start in enumerate(range(0, len(program), _PIECE)):
        lines = statements[start : start + _PIECE]
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


def _statements(name: str, program: list[Instruction], piece: int) -> list[str]:
    """One C statement an instruction; values that a later piece reads go through the array ``w`` of all pieces.

    Divisions multiply by reciprocals, as a model's derivatives divide by the same few numbers again and again. Powers
    of quarters are products of the base and its roots: lanes share an instruction for these, none for ``pow``.
    """
    value_in: dict[int, int] = {}  # by place in the work vector: the instruction whose value is there
    read: list[dict[int, int]] = []  # of each instruction: the places that it reads, and whose values they are
    last_read: dict[int, int] = {}
    for k, (op, sources, targets, _) in enumerate(program):
        read.append({} if op in (ca.OP_INPUT, ca.OP_CONST) else {place: value_in[place] for place in sources})
        last_read.update(dict.fromkeys(read[-1].values(), k))
        if op != ca.OP_OUTPUT:
            value_in[targets[0]] = k
    statements = []
    reciprocals: set[tuple[int, int]] = set()  # those that are known: piece, number of the divisor
    roots: set[tuple[int, str, int]] = set()  # likewise: piece, half or quarter power, number of the base
    for k, (op, sources, targets, constant) in enumerate(program):
        start = k - k % piece
        first = ""
        names = [
            f"v{read[k][place]}" if read[k][place] >= start else f"w[{place}]" for place in sources if place in read[k]
        ]
        if op == ca.OP_OUTPUT:
            statements.append(f"out[{targets[1]}] = {names[0]};")
            continue
        if op == ca.OP_CONST:
            result = f"V({literal(constant)})"
        elif op == ca.OP_INPUT:
            result = f"i{sources[0]}[{sources[1]}]"
        elif op in _INFIX:
            result = f"{names[0]} {_INFIX[op]} {names[1]}"
        elif op in (ca.OP_DIV, ca.OP_INV):
            divisor = read[k][sources[-1]]
            if (start, divisor) not in reciprocals:
                reciprocals.add((start, divisor))
                first = f"const vd r{divisor} = 1.0 / {names[-1]}; "
            result = " * ".join([*names[:-1], f"r{divisor}"])
        elif op in (ca.OP_POW, ca.OP_CONSTPOW) and (power := _rooted(program[read[k][sources[1]]])) is not None:
            base = read[k][sources[0]]
            for root, of in (("h", names[0]), ("q", f"h{base}"))[: _roots_of(power)]:
                if (start, root, base) not in roots:
                    roots.add((start, root, base))
                    first += f"const vd {root}{base} = vd_sqrt({of}); "
            result = _product(power, names[0], base)
        elif op in _FORMATS:
            result = _FORMATS[op].format(*names)
        else:
            raise InvalidArgumentError(name, expected="operations that C has", actual=f"CasADi operation {op}")
        kept = f" w[{targets[0]}] = v{k};" if last_read.get(k, k) >= start + piece else ""
        statements.append(f"{first}const vd v{k} = {result};{kept}")
    return statements


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
