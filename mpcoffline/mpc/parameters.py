"""theta: the parameters of an MPC as one named, flat, bounded float64 vector.

A *block* is one parameter with a name and a natural shape (a mass, a weight matrix). Its coordinates in theta are
chosen such that every theta within the bounds gives a well-posed MPC: a positive semidefinite matrix W = C C' is
represented by its lower-triangular factor C. The same numbers enter CasADi as NLP parameters and torch as a tensor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core import limits
from mpcoffline.core.checks import check_number
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.text import LONGEST, check_name, check_unit
from mpcoffline.core.types import Array

from .psd import psd_factor

Kind = Literal["free", "psd"]
Group = Literal["model", "cost", "terminal", "reference"]
Varies = Literal["episode"]

_ROUNDING = 1e-12  # of a coordinate's size, by which it may lie beyond a bound
_PREFIX = 20  # characters that an MPC puts in front of a name


@dataclass(frozen=True)
class Parameter:
    """A number or array that may be learned, with its bounds.

    Args:
        value: Initial value; any shape of at most two dimensions.
        low: Lower bound, a number or an array of the value's shape.
        high: Upper bound, likewise.
        unit: Physical unit, for people, of the characters that names may have.
        varies: ``"episode"`` where a model's parameter is another one in every logged episode, as a load or a feed.
            Identification then finds its values, their mean, which the MPC takes, and their spread
            (:class:`~mpcoffline.estimation.EpisodeSpread`).
        spread: By what share of itself the plant's may differ, 0.3 for 30 %; simulated plants are drawn with it, an
            MPC does not use it.

    Raises:
        InvalidArgumentError: If the value is not finite or lies outside the bounds, the unit has other characters, or
            it varies with something else.
    """

    value: ArrayLike
    low: ArrayLike = -np.inf
    high: ArrayLike = np.inf
    unit: str = ""
    varies: Varies | None = None
    spread: float = 0.0

    def __post_init__(self) -> None:
        check_number("Parameter spread", self.spread, 0.0, 1.0, open_low=False)
        check_unit("Parameter unit", self.unit)
        _check_varies("Parameter varies", self.varies)
        value, low, high = (np.asarray(v, dtype=np.float64) for v in (self.value, self.low, self.high))
        if not np.isfinite(value).all() or value.ndim > 2:
            raise InvalidArgumentError(
                "Parameter value", expected="finite numbers, at most 2 dimensions", actual=str(self.value)
            )
        if not ((low <= value) & (value <= high)).all():
            raise InvalidArgumentError(
                "Parameter value", expected=f"a value from {self.low} to {self.high}", actual=str(self.value)
            )


@dataclass(frozen=True)
class Block:
    """One named parameter inside theta.

    Attributes:
        name: Name, dotted once it is part of an MPC (``"model.m"``); letters of any script, digits, blanks and
            ``_-.,^*/()[]+%°µ·²³``, up to 100.
        shape: Natural shape: ``()``, ``(n,)`` or ``(n, m)``.
        theta: Its coordinates, ``(size,)``: the entries in row-major order, or for ``kind="psd"`` the lower triangle
            of C in ``W = C C'``, row by row.
        low: Lower bounds of the coordinates, ``(size,)``.
        high: Upper bounds, ``(size,)``.
        kind: ``"free"`` or ``"psd"``.
        group: What it belongs to; learning selects by group.
        unit: Physical unit, for people; of the same characters.
        varies: ``"episode"`` where the log has another value in every episode, which a model's parameter may.

    Raises:
        InvalidArgumentError: For a name, unit, kind or group that is none, or another group's parameter that varies.
    """

    name: str
    shape: tuple[int, ...]
    theta: Array = field(repr=False)
    low: Array = field(repr=False)
    high: Array = field(repr=False)
    kind: Kind = "free"
    group: Group = "cost"
    unit: str = ""
    varies: Varies | None = None

    def __post_init__(self) -> None:
        check_name("parameter name", self.name, longest=LONGEST + _PREFIX)
        check_unit(f"unit of {self.name}", self.unit)
        for what, given, known in (("kind", self.kind, Kind), ("group", self.group, Group)):
            if given not in get_args(known):
                raise InvalidArgumentError(
                    f"{what} of {self.name}",
                    expected=f"one of {', '.join(get_args(known))}",
                    actual=repr(given)[:LONGEST],
                )
        _check_varies(f"varies of {self.name}", self.varies)
        if self.varies and (self.group, self.kind) != ("model", "free"):
            raise InvalidArgumentError(
                f"varies of {self.name}", expected="a parameter of the model", actual=f"one of group {self.group!r}"
            )

    @classmethod
    def free(cls, name: str, parameter: Parameter | ArrayLike, group: Group) -> Block:
        """A block whose coordinates are its entries."""
        spec = parameter if isinstance(parameter, Parameter) else Parameter(parameter)
        check_name("parameter name", name)
        value = np.asarray(spec.value, dtype=np.float64)
        low, high = (np.broadcast_to(np.asarray(b, np.float64), value.shape) for b in (spec.low, spec.high))
        return cls(name, value.shape, value.ravel(), low.ravel(), high.ravel(), "free", group, spec.unit, spec.varies)

    @classmethod
    def psd(cls, name: str, matrix: ArrayLike, group: Group) -> Block:
        """A positive semidefinite ``(n, n)`` block, represented by its lower-triangular factor.

        Raises:
            InvalidArgumentError: If the matrix is not square, symmetric, finite and positive semidefinite.
        """
        check_name("parameter name", name)
        value = np.atleast_2d(np.asarray(matrix, dtype=np.float64))
        factor = psd_factor(value, name)
        rows, columns = np.tril_indices(len(value))
        low = np.where(rows == columns, 0.0, -np.inf)
        return cls(name, value.shape, factor[rows, columns], low, np.full(len(rows), np.inf), "psd", group)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.theta)

    @property
    def value(self) -> Array:
        """The parameter in its natural shape."""
        return self.natural(self.theta)

    @property
    def coordinate_names(self) -> list[str]:
        """A name for each coordinate, e.g. ``"stage_cost.W[1,0]"``."""
        if self.kind == "psd":
            return [f"{self.name}[{i},{j}]" for i, j in zip(*np.tril_indices(self.shape[0]), strict=True)]
        if not self.shape:
            return [self.name]
        return [f"{self.name}[{','.join(map(str, index))}]" for index in np.ndindex(*self.shape)]

    def natural(self, theta: Array) -> Array:
        """The parameter in its natural shape, from coordinates ``(size,)``."""
        if self.kind == "psd":
            factor = np.zeros(self.shape)
            factor[np.tril_indices(self.shape[0])] = theta
            return factor @ factor.T
        return theta.reshape(self.shape).copy()

    def coordinates(self, value: ArrayLike) -> Array:
        """Coordinates ``(size,)`` of a parameter given in its natural shape.

        Raises:
            InvalidArgumentError: If it has another shape, or a PSD block gets a matrix that is not PSD.
        """
        array = np.asarray(value, dtype=np.float64)
        if array.shape != self.shape:
            raise InvalidArgumentError(self.name, expected=f"shape {self.shape}", actual=f"shape {array.shape}")
        if self.kind == "psd":
            return psd_factor(array, self.name)[np.tril_indices(self.shape[0])]
        return array.ravel().copy()

    def symbolic(self, theta: ca.SX) -> ca.SX:
        """The parameter as CasADi matrix from symbolic coordinates; a PSD block gives its *factor* C."""
        rows = self.shape[0] if self.shape else 1
        columns = self.shape[1] if len(self.shape) == 2 else 1
        if self.kind == "psd":
            factor = ca.SX.zeros(rows, rows)
            for k, (i, j) in enumerate(zip(*np.tril_indices(rows), strict=True)):
                factor[int(i), int(j)] = theta[k]
            return factor
        return ca.reshape(theta, columns, rows).T  # CasADi is column-major

    def flat(self, matrix: ca.SX) -> ca.SX:
        """The inverse of :meth:`symbolic`: coordinates ``(size, 1)``."""
        if self.kind == "psd":
            rows, columns = np.tril_indices(self.shape[0])
            return ca.vertcat(*(matrix[int(i), int(j)] for i, j in zip(rows, columns, strict=True)))
        return ca.vec(matrix.T)

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; infinite bounds become null."""
        return {
            "name": self.name,
            "shape": list(self.shape),
            "theta": self.theta.tolist(),
            "low": [None if np.isinf(v) else v for v in self.low.tolist()],
            "high": [None if np.isinf(v) else v for v in self.high.tolist()],
            "kind": self.kind,
            "group": self.group,
            "unit": self.unit,
        } | ({"varies": self.varies} if self.varies else {})

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Block:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If sizes or kinds do not belong together, or coordinates are out of bounds.
        """
        theta = np.array(data["theta"], dtype=np.float64)
        low = np.array([-np.inf if v is None else v for v in data["low"]], dtype=np.float64)
        high = np.array([np.inf if v is None else v for v in data["high"]], dtype=np.float64)
        shape = tuple(data["shape"])
        if len(shape) > 2 or any(type(n) is not int or not 0 <= n <= limits.PARAMETERS for n in shape):
            raise FileFormatError("parameter shape", expected="at most 2 sizes", actual=repr(data["shape"])[:LONGEST])
        name = check_name("parameter name", data["name"], error=FileFormatError)
        try:
            block = cls(name, shape, theta, low, high, data["kind"], data["group"], data["unit"], data.get("varies"))
        except InvalidArgumentError as error:
            raise FileFormatError(f"parameter {name}", expected=error.expected, actual=error.actual) from error
        n = shape[0] if shape else 1
        size = n * (n + 1) // 2 if block.kind == "psd" else int(np.prod(shape))
        square = block.kind == "free" or (block.kind == "psd" and shape == (n, n))
        if not square or not theta.shape == low.shape == high.shape == (size,):
            raise FileFormatError(f"parameter {block.name}", expected=f"{size} coordinates", actual=str(data)[:300])
        try:
            ParameterSpace([block]).checked(theta)
        except InvalidArgumentError as error:
            raise FileFormatError(f"parameter {block.name}", expected=error.expected, actual=error.actual) from error
        return block


class ParameterSpace(Sequence[Block]):
    """The blocks of an MPC in order: packs them into theta, unpacks theta, knows bounds and names.

    Args:
        blocks: The blocks; names must be unique.

    Raises:
        InvalidArgumentError: If a name occurs twice, or there are more coordinates than files may hold.
    """

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks: tuple[Block, ...] = tuple(blocks)
        self.slices: dict[str, slice] = {}
        start = 0
        for block in self.blocks:
            if block.name in self.slices:
                raise InvalidArgumentError("parameter names", expected="unique names", actual=f"{block.name} twice")
            self.slices[block.name] = slice(start, start + block.size)
            start += block.size
        check_limit("parameters", "coordinates", start, limits.PARAMETERS, error=InvalidArgumentError)
        self.size = start

    def __repr__(self) -> str:
        """Its class, its blocks, and the size of theta."""
        return f"{type(self).__name__}({', '.join(block.name for block in self)}; size {self.size})"

    def __len__(self) -> int:
        return len(self.blocks)

    def __getitem__(self, index: Any) -> Any:
        return self.blocks[index]

    def __iter__(self) -> Iterator[Block]:
        return iter(self.blocks)

    @property
    def theta(self) -> Array:
        """The current parameter vector, ``(size,)``."""
        return self._concatenated([block.theta for block in self.blocks])

    @property
    def low(self) -> Array:
        """Lower bounds, ``(size,)``."""
        return self._concatenated([block.low for block in self.blocks])

    @property
    def high(self) -> Array:
        """Upper bounds, ``(size,)``."""
        return self._concatenated([block.high for block in self.blocks])

    @property
    def names(self) -> list[str]:
        """One name a coordinate."""
        return [name for block in self.blocks for name in block.coordinate_names]

    def mask(self, groups: Sequence[str]) -> NDArray[np.bool_]:
        """Which coordinates belong to one of the groups, ``(size,)``."""
        parts = [np.full(block.size, block.group in groups) for block in self.blocks]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=bool)

    @property
    def varying(self) -> NDArray[np.bool_]:
        """Which coordinates are others in every logged episode, ``(size,)``."""
        return np.array([block.varies is not None for block in self for _ in range(block.size)], dtype=bool)

    def unpack(self, theta: Array) -> dict[str, Array]:
        """The parameters by name in their natural shapes, from theta ``(size,)``."""
        return {block.name: block.natural(theta[self.slices[block.name]]) for block in self.blocks}

    def pack(self, values: Mapping[str, ArrayLike]) -> Array:
        """Theta ``(size,)`` with the named parameters (natural shapes) replaced.

        Raises:
            UnknownIdError: For a name that no block has.
            InvalidArgumentError: For a wrong shape, a matrix that is not PSD, or a value out of bounds.
        """
        theta = self.theta
        by_name = {block.name: block for block in self.blocks}
        for name, value in values.items():
            if name not in by_name:
                raise UnknownIdError.of("parameter", name, by_name)
            theta[self.slices[name]] = by_name[name].coordinates(value)
        return self.checked(theta)

    def along(self, values: Mapping[str, ArrayLike], n: int) -> Array:
        """One theta a stage, ``(n + 1, size)``, from values by name; see :meth:`mpcoffline.MPC.theta_along`."""
        shapes = {block.name: block.shape for block in self}
        along: dict[str, Array] = {}
        for name, value in values.items():
            array, shape = np.asarray(value, dtype=np.float64), shapes.get(name, np.shape(value))
            if array.shape == (n, *shape):
                array = np.concatenate([array, array[-1:]])
            elif array.shape == shape:
                array = np.broadcast_to(array, (n + 1, *shape))
            if array.shape != (n + 1, *shape):
                raise InvalidArgumentError(
                    name, expected=f"shape {shape}, {(n, *shape)} or {(n + 1, *shape)}", actual=f"shape {array.shape}"
                )
            along[name] = array
        return np.stack([self.pack({name: array[k] for name, array in along.items()}) for k in range(n + 1)])

    def checked(self, theta: ArrayLike) -> Array:
        """Theta as float64 ``(size,)``, refused when of the wrong shape, not finite or, beyond rounding, out of bounds.

        Raises:
            InvalidArgumentError: Names the coordinate, its bounds and its value.
        """
        array = np.asarray(theta, dtype=np.float64)
        if array.shape != (self.size,):
            raise InvalidArgumentError("theta", expected=f"shape ({self.size},)", actual=f"shape {array.shape}")
        sizes = np.abs(np.stack([array, self.low, self.high]))
        slack = _ROUNDING * np.where(np.isfinite(sizes), sizes, 0.0).max(axis=0)
        bad = ~((array >= self.low - slack) & (array <= self.high + slack) & np.isfinite(array))
        if bad.any():
            k = int(np.flatnonzero(bad)[0])
            raise InvalidArgumentError(
                f"theta[{k}] ({self.names[k]})",
                expected=f"a finite number from {self.low[k]} to {self.high[k]}",
                actual=str(array[k]),
            )
        return array

    def symbols(self, theta: ca.SX) -> dict[str, ca.SX]:
        """The parameters by name as CasADi matrices (PSD blocks as factors), from symbolic theta."""
        return {block.name: block.symbolic(theta[self.slices[block.name]]) for block in self.blocks}

    def with_theta(self, theta: Array) -> ParameterSpace:
        """The same blocks with other values."""
        return ParameterSpace([replace(block, theta=np.array(theta[self.slices[block.name]])) for block in self.blocks])

    @staticmethod
    def _concatenated(parts: list[Array]) -> Array:
        return np.concatenate(parts) if parts else np.zeros(0)


def _check_varies(what: str, given: object) -> None:
    if given not in (None, *get_args(Varies)):
        raise InvalidArgumentError(what, expected="'episode', or None", actual=repr(given)[:LONGEST])
