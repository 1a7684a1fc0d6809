"""CasADi functions as plain lists of scalar instructions: what files hold, and what the torch twin replays.

CasADi's own serialisation is not used in files: reading it can load a compiled library that the text names, that is,
run foreign code. A list of arithmetic instructions cannot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core import limits
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.limits import check_limit

from .tables import as_arithmetic

_UNARY = (  # noqa: SIM905 -- one per line would fill the page
    "acos acosh asin asinh atan atanh ceil cos cosh erf erfinv exp expm1 fabs floor inv log log1p neg not sign sin sinh"
    " sq sqrt tan tanh twice"
).split()
_BINARY = (  # noqa: SIM905
    "add and atan2 constpow copysign div eq fmax fmin fmod hypot if_else_zero le lt mul ne or pow remainder sub"
).split()
_STEPS = "and ceil eq floor fmod le lt ne not or remainder sign".split()  # noqa: SIM905
_CODES: dict[str, int] = {name: getattr(ca, f"OP_{name.upper()}") for name in (*_UNARY, *_BINARY)}
_NAMES = {code: name for name, code in _CODES.items()}
_BINARY_CODES = {_CODES[name] for name in _BINARY}


class Instruction(NamedTuple):
    """One scalar instruction of an SX function.

    Attributes:
        op: CasADi's operation code.
        sources: Places in the work vector that it reads; for an input the pair (input, element).
        targets: The place that it writes; for an output the pair (output, element).
        constant: The number of a constant.
    """

    op: int
    sources: list[int]
    targets: list[int]
    constant: float


def expanded(function: ca.Function) -> ca.Function:
    """The function as one SX function of columns, with dense outputs and common subexpressions shared.

    Raises:
        InvalidArgumentError: If CasADi cannot expand it.
    """
    try:
        symbols = [ca.SX.sym(f"i{i}", function.numel_in(i)) for i in range(function.n_in())]
        shaped = [ca.reshape(s, *function.size_in(i)) for i, s in enumerate(symbols)]
        outputs = function.expand().call(shaped) if not function.is_a("SXFunction") else function.call(shaped)
        return ca.Function(function.name(), symbols, [ca.densify(ca.cse(ca.vec(y))) for y in outputs])
    except RuntimeError as error:
        raise InvalidArgumentError(
            function.name(), expected="a function that CasADi can expand to SX", actual=str(error)[:200]
        ) from error


def numbers_of(function: ca.Function, op: int) -> list[int]:
    """Which instructions of an SX function are such operations: a quarter of what it takes to list them all."""
    return [k for k in range(function.n_instructions()) if function.instruction_id(k) == op]


def instructions(function: ca.Function) -> Iterator[Instruction]:
    """The instructions of an SX function in order."""
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        constant = function.instruction_constant(k) if op == ca.OP_CONST else 0.0
        yield Instruction(op, function.instruction_input(k), function.instruction_output(k), constant)


def traced(name: str, function: ca.Function) -> ca.Function:
    """The SX function, its look-up tables as arithmetic (:mod:`mpcoffline.mpc.tables`).

    It is refused where tracing lost an expression: ``math.sin(x)`` of a symbol is silently NaN.

    Raises:
        InvalidArgumentError: If a constant of the function is NaN, or it has more operations than can be solved with.
    """
    function = without_tables(function)
    check_limit(name, "operations", function.n_instructions(), limits.EXPRESSION_NODES, error=InvalidArgumentError)
    if any(np.isnan(function.instruction_constant(k)) for k in numbers_of(function, ca.OP_CONST)):
        raise InvalidArgumentError(
            name,
            expected="a function of CasADi SX expressions",
            actual="one with a constant NaN",
            hint="Use casadi.sin ... instead of math.sin, which turns symbols into NaN.",
        )
    return function


def is_affine(function: ca.Function, n: int = 2) -> bool:
    """Whether the first output is affine in the first ``n`` inputs, whatever the others are.

    Steps, as ``sign(x)`` or ``x > 1``, have zero derivatives and are not affine.
    """
    symbols = [ca.SX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    z = ca.vertcat(*(ca.vec(symbol) for symbol in symbols[:n]))
    if ca.depends_on(ca.jacobian(ca.vec(function.call(symbols)[0]), z), z):
        return False
    varying: set[int] = set()
    for op, sources, targets, _ in instructions(expanded(function)):
        if op in (ca.OP_CONST, ca.OP_INPUT):
            varies = op == ca.OP_INPUT and sources[0] < n
        elif op != ca.OP_OUTPUT:
            varies = not varying.isdisjoint(sources if _NAMES.get(op) not in _UNARY else sources[:1])
            if varies and _NAMES.get(op) in _STEPS:
                return False
        if op != ca.OP_OUTPUT:
            (varying.add if varies else varying.discard)(targets[0])
    return True


def scalar(name: str, expression: Callable[[], ca.SX], nx: int, nu: int) -> ca.SX:
    """Evaluates a cost expression, turning CasADi's dimension errors into one that says what is expected.

    Raises:
        InvalidArgumentError: For an expression that fails, or is no scalar.
    """
    try:
        cost = ca.densify(ca.SX(expression()))
    except (InvalidArgumentError, RuntimeError) as error:
        raise InvalidArgumentError(
            name, expected=f"a cost for nx = {nx}, nu = {nu}", actual=str(error).splitlines()[-1]
        ) from error
    if cost.shape != (1, 1):
        raise InvalidArgumentError(name, expected="a scalar", actual=f"shape {cost.shape}")
    return cost


def without_tables(function: ca.Function) -> ca.Function:
    """An SX function with the tables that it calls as arithmetic; calls of other functions stay."""
    called = numbers_of(function, ca.OP_CALL)
    if not called:
        return function
    program = list(instructions(function))
    listing = function.instructions_sx()
    functions = {k: listing[k].which_function() for k in called}
    tables = {k: as_arithmetic(of) for k, of in functions.items()}
    if not any(tables.values()):
        return function
    symbols = [ca.SX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    work: dict[int, ca.SX] = {}
    outputs: list[dict[int, ca.SX]] = [{} for _ in range(function.n_out())]
    for k, (op, sources, targets, constant) in enumerate(program):
        if op == ca.OP_OUTPUT:
            outputs[targets[0]][targets[1]] = work[sources[0]]
        elif op == ca.OP_CONST:
            work[targets[0]] = ca.SX(constant)
        elif op == ca.OP_INPUT:
            work[targets[0]] = symbols[sources[0]].nz[sources[1]]
        elif op == ca.OP_CALL:
            found = _called(tables[k] or functions[k], [work[source] for source in sources])
            work.update({place: result for place, result in zip(targets, found, strict=True) if place >= 0})
        else:
            a, *rest = (work[source] for source in sources)
            work[targets[0]] = ca.SX.binary(op, a, rest[0]) if op in _BINARY_CODES else ca.SX.unary(op, a)
    results = []
    for i, elements in enumerate(outputs):
        result = ca.SX(function.sparsity_out(i))
        for element, value in elements.items():
            result.nz[element] = value
        results.append(result)
    return ca.Function(function.name(), symbols, results, function.name_in(), function.name_out(), {"cse": True})


def _called(function: ca.Function, elements: list[ca.SX]) -> list[ca.SX]:
    """The elements of a function's outputs, of the elements of its inputs."""
    arguments, start = [], 0
    for i in range(function.n_in()):
        argument = ca.SX(function.sparsity_in(i))
        for element in range(argument.nnz()):
            argument.nz[element] = elements[start + element]
        start += argument.nnz()
        arguments.append(argument)
    return [result.nz[k] for result in function.call(arguments) for k in range(result.nnz())]


def function_to_json(function: ca.Function) -> dict[str, Any]:
    """A CasADi function of one output as JSON-able instructions.

    Raises:
        InvalidArgumentError: If the function is no scalar arithmetic (it calls a compiled or interpolating function).
    """
    flat = expanded(function)
    program: list[list[Any]] = []
    for op, sources, targets, constant in instructions(flat):
        if op == ca.OP_CONST:
            program.append(["const", targets[0], constant if np.isfinite(constant) else repr(constant)])
        elif op == ca.OP_INPUT:
            program.append(["input", targets[0], *sources])
        elif op == ca.OP_OUTPUT:
            program.append(["output", targets[1], *sources])
        elif op in _NAMES:
            n = 1 if _NAMES[op] in _UNARY else 2
            program.append([_NAMES[op], targets[0], *sources[:n]])
        else:
            raise InvalidArgumentError(
                function.name(), expected="a function of plain arithmetic", actual=f"CasADi operation {op}"
            )
    return {
        "inputs": [flat.numel_in(i) for i in range(flat.n_in())],
        "output": flat.numel_out(0),
        "instructions": program,
    }


def function_from_json(data: Any, name: str, *, inputs: tuple[int, ...], output: int | None = None) -> ca.Function:
    """The inverse of :func:`function_to_json`; evaluates nothing but arithmetic, whatever the data hold.

    Args:
        data: What :func:`function_to_json` returned.
        name: What the function is, for messages.
        inputs: Expected sizes of its inputs.
        output: Expected size of its output; any when None.

    Raises:
        FileFormatError: If the data are damaged or describe a function of other sizes.
    """
    try:
        sizes, n_out, program = tuple(data["inputs"]), data["output"], data["instructions"]
        if sizes != inputs or output not in (None, n_out):
            raise FileFormatError(
                name,
                expected=f"inputs of sizes {inputs}, {output or 'any'} outputs",
                actual=f"inputs of sizes {sizes}, {n_out} outputs",
            )
        check_limit(name, "operations", len(program), limits.EXPRESSION_NODES)
        symbols = [ca.SX.sym(f"i{i}", size) for i, size in enumerate(inputs)]
        results = _replayed(program, [dict(enumerate(ca.vertsplit(symbol))) for symbol in symbols])
        column = ca.vertcat(*(results[k] for k in range(n_out)))
    except (KeyError, IndexError, TypeError, ValueError, NotImplementedError, RuntimeError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(
            name, expected="a list of instructions", actual=f"{type(error).__name__}: {error}"[:200]
        ) from error
    return ca.Function(name, symbols, [ca.densify(column)])


def _replayed(program: list[list[Any]], inputs: list[dict[int, ca.SX]]) -> dict[int, ca.SX]:
    """The outputs by element, from running the program on symbols."""
    work: dict[int, ca.SX] = {}
    outputs: dict[int, ca.SX] = {}
    for op, target, *arguments in program:
        if op == "const":
            (value,) = arguments
            number = float(value)
            if np.isnan(number):
                raise ValueError("a constant NaN")
            work[target] = ca.SX(number)
        elif op == "input":
            i, element = arguments
            work[target] = inputs[i][element]
        elif op == "output":
            (source,) = arguments
            outputs[target] = work[source]
        elif op in _UNARY:
            (source,) = arguments
            work[target] = ca.SX.unary(_CODES[op], work[source])
        else:
            left, right = arguments
            work[target] = ca.SX.binary(_CODES[op], work[left], work[right])
    return outputs
