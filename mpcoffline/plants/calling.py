"""Calling the functions of a description: by the names of their arguments, with errors that name file and line."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca

from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError, UnknownIdError

from .quantities import Values

#: What each argument of a function holds.
MEANINGS = {
    "x": "states",
    "y": "outputs",
    "u": "inputs",
    "d": "signals",
    "p": "parameters",
    "du": "changes of the inputs since the step before",
}


def place_of(function: Callable[..., Any], line: int | None = None) -> str:
    """Where a function is written: file and line; empty where that is not known."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    if code is None:
        return ""
    return f"{Path(code.co_filename).name}, line {code.co_firstlineno if line is None else line}"


def arguments_of(what: str, function: object, allowed: Sequence[str]) -> tuple[str, ...]:
    """Which of the arguments a function asks for, by their names.

    Args:
        what: What the function is, for messages.
        function: What the user gave.
        allowed: Out of ``x``, ``u``, ``d``, ``p``, ``du``.

    Raises:
        InvalidArgumentError: For what is no function, or one of other arguments.
    """
    expected = f"a function of {', '.join(allowed)} (those that it needs, by these names)"
    if not callable(function):
        raise InvalidArgumentError(what, expected=expected, actual=repr(function)[:200])
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(what, expected=expected, actual=str(error)) from error
    needed = tuple(
        p.name for p in parameters if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    )
    if other := [name for name in needed if name not in allowed]:
        hint = "; ".join(f"{name}: {MEANINGS[name]}" for name in allowed) + "."
        where = f"{what} ({place})" if (place := place_of(function)) else what
        raise InvalidArgumentError(where, expected=expected, actual=f"an argument {other[0]!r}", hint=hint)
    return needed


def called(what: str, function: Callable[..., Any], values: Mapping[str, Values]) -> Any:
    """The function's result; whatever it raises becomes an error that names file and line.

    Args:
        what: What the function is, for messages.
        function: What the user gave.
        values: By the names of its arguments.

    Raises:
        InvalidArgumentError: For whatever it raises.
    """
    try:
        return function(**{name: values[name] for name in arguments_of(what, function, tuple(values))})
    except Exception as error:
        if isinstance(error, MPCOfflineError) and error.name.startswith(what):
            raise
        file = getattr(getattr(inspect.unwrap(function), "__code__", None), "co_filename", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        place = place_of(function, lines[-1] if lines else None)
        where = f"{what} ({place})" if place else what
        if isinstance(error, UnknownIdError):
            name = f"{where}, {error.name}"
            raise InvalidArgumentError(name, expected=error.expected, actual=error.actual, hint=error.hint) from error
        raise InvalidArgumentError(
            where,
            expected="arithmetic of CasADi",
            actual=f"{type(error).__name__}: {error}",
            hint="Use casadi.sqrt, casadi.fmax, casadi.if_else ... in place of math, numpy and Python's if.",
        ) from error


def column(what: str, function: Callable[..., Any], result: object, names: Sequence[str]) -> ca.SX:
    """What dynamics returned, as a column in the order of the states.

    Args:
        what: What the function is, for messages.
        function: Where it comes from.
        result: A list, a CasADi column, or a mapping by name.
        names: Of the states.

    Raises:
        InvalidArgumentError: For another number of entries, or other names.
    """
    where = f"{what} ({place})" if (place := place_of(function)) else what
    if isinstance(result, Mapping):
        for name in result:
            if name not in names:
                error = UnknownIdError.of(f"{where}, state", name, names)
                raise InvalidArgumentError(error.name, expected=error.expected, actual=error.actual, hint=error.hint)
        if missing := [name for name in names if name not in result]:
            raise InvalidArgumentError(where, expected="an entry for each state", actual=f"none for {missing[0]!r}")
        result = [result[name] for name in names]
    entries = ca.vertsplit(result) if isinstance(result, ca.SX) and result.numel() else result
    if not isinstance(entries, list | tuple):
        entries = [entries]
    if len(entries) != len(names):
        expected = f"{len(names)} entries, one a state ({', '.join(names)})"
        raise InvalidArgumentError(where, expected=expected, actual=str(len(entries)))
    parts: list[ca.SX] = []
    for name, entry in zip(names, entries, strict=True):
        parts.append(number(f"{where}: {name}", entry))
    return ca.vertcat(*parts)


def number(where: str, value: Any) -> ca.SX:
    """One number or expression.

    Raises:
        InvalidArgumentError: For anything else.
    """
    try:
        found = ca.SX(value)
    except (TypeError, NotImplementedError, RuntimeError) as error:
        actual = f"{type(value).__name__} {value!r}"[:200]
        raise InvalidArgumentError(where, expected="a number or an expression", actual=actual) from error
    if found.shape != (1, 1):
        raise InvalidArgumentError(where, expected="one number", actual=f"shape {found.shape}")
    dense: ca.SX = ca.densify(found)
    return dense
