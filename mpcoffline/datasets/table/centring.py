"""Rows of float32 for numbers of more digits: what is small against its offset is packed without it.

float32 holds seven digits. Of a position at 1e6 m it keeps steps of 6 cm, and the increments, of which all learning is
made, are gone. So a column that would lose by it is packed as the difference from its mean, which is kept beside the
rows in float64; s+ then as the increment s+ - s, again without its mean. All other columns, so nearly all data, are
packed as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .math import Columns, Moments, split

Floats = NDArray[np.float64]

#: Rounding that is left as it is, as share of the spread of the values, and of that of their increments.
NEGLIGIBLE = 1e-5
#: The same where the mean is more than :data:`FAR` spreads from zero: there is much to gain.
NEGLIGIBLE_FAR, FAR = 1e-6, 4.0


class Centring(NamedTuple):
    """What the packed rows of a table lack, and how to give it back.

    Attributes:
        centre: What each column is packed without, ``(2 ny + nu + 2,)``; zero where a column is packed as it is.
        increments: Whether s+ of a coordinate is packed as s+ - s, ``(ny,)``.
    """

    centre: Floats
    increments: NDArray[np.bool_]

    @classmethod
    def none(cls, ny: int, nu: int) -> Centring:
        """Rows that are packed as they are."""
        return cls(np.zeros(2 * ny + nu + 2), np.zeros(ny, dtype=bool))

    @property
    def is_none(self) -> bool:
        """Whether all rows are packed as they are."""
        return not (self.centre.any() or self.increments.any())

    def columns(self, block: Any) -> Columns:
        """The columns of packed rows in their units: views where nothing is centred, else copies in float64.

        Args:
            block: ``(B, 2 ny + nu + 2)``, a numpy array or a torch tensor.
        """
        ny, nu = len(self.increments), len(self.centre) - 2 * len(self.increments) - 2
        return split(block if self.is_none else self.values(block), ny, nu)

    def values(self, block: Any) -> Any:
        """Packed rows ``(B, 2 ny + nu + 2)`` in their units, a copy in float64."""
        ny, plain = len(self.increments), self.is_none
        wide: Any
        centre: Any = self.centre
        increments: Any = self.increments.astype(np.float64)
        if isinstance(block, np.ndarray):
            wide = block.astype(np.float64)
        else:
            import torch

            wide = block.to(torch.float64, copy=True)
            centre, increments = (torch.from_numpy(v).to(wide.device) for v in (centre, increments))
        if not plain:
            wide += centre
            wide[:, -1 - ny : -1] += increments * wide[:, :ny]
        return wide

    def states(self, block: NDArray[np.float32]) -> tuple[Any, Any]:
        """The states s and s+ of packed rows, ``(B, ny)`` each, from the centre of s."""
        ny = len(self.increments)
        s: Any = block[:, :ny]
        s_next: Any = block[:, -1 - ny : -1]
        if self.increments.any():
            s_next = s_next + self.increments * (s + self.centre[-1 - ny : -1])
        return s, s_next

    def goes_on(self, rows: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether a row's s+ is the s of the next, ``(n - 1,)``; where centred, but for rounding."""
        s, s_next = self.states(rows)
        if not self.increments.any():
            return np.asarray((s_next[:-1] == s[1:]).all(axis=1))
        size = self.increments * 2.0 * np.finfo(np.float32).eps * (np.abs(s[:-1]) + np.abs(s[1:]))
        return np.asarray((np.abs(s_next[:-1] - s[1:]) <= size).all(axis=1))

    def packed(self, values: Floats) -> NDArray[np.float32]:
        """The inverse of :meth:`values`; what float32 cannot hold becomes inf."""
        ny, wide = len(self.increments), values - self.centre
        wide[:, -1 - ny : -1] -= self.increments * values[:, :ny]
        with np.errstate(over="ignore"):
            return np.asarray(wide.astype(np.float32))

    @classmethod
    def common(cls, centrings: Sequence[Centring], lengths: Sequence[int]) -> Centring:
        """One for the rows of several tables: that of all of them, or else the mean of those that centre a column."""
        first = centrings[0]
        if all(other.equals(first) for other in centrings):
            return first
        weights = np.asarray(lengths)[:, None] * (np.stack([c.centre for c in centrings]) != 0.0)
        centre = (weights * np.stack([c.centre for c in centrings])).sum(axis=0) / np.maximum(weights.sum(axis=0), 1)
        return cls(centre, np.any([c.increments for c in centrings], axis=0))

    def repacked(self, rows: NDArray[np.float32], old: Centring) -> NDArray[np.float32]:
        """Rows ``(B, 2 ny + nu + 2)`` packed by another centring, packed by this one."""
        return rows if old.equals(self) else self.packed(old.values(rows))

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""
        return {"centre": self.centre.tolist(), "increments": self.increments.tolist()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Centring:
        """The inverse of :meth:`to_json`.

        Raises:
            ValueError: For what are no finite numbers of a table's width.
        """
        centre, increments = np.array(data["centre"], dtype=np.float64), np.array(data["increments"], dtype=bool)
        if centre.ndim != 1 or increments.ndim != 1 or not np.isfinite(centre).all():
            raise ValueError("a centre that is none")
        return cls(centre, increments)

    def equals(self, other: Centring) -> bool:
        """Whether rows of both mean the same."""
        return all(np.array_equal(a, b) for a, b in zip(self, other, strict=True))


class _Losses:
    """Spread of some columns, and what rounding to float32 did to them."""

    def __init__(self, size: int) -> None:
        self.moments, self._squares = Moments(size), np.zeros(size)

    def add(self, values: Floats, errors: Floats) -> None:
        self.moments.add(values)
        self._squares += np.einsum("ij,ij->j", errors, errors)

    @property
    def far(self) -> NDArray[np.bool_]:
        """Where the values are small against their offset."""
        return np.asarray(np.abs(self.moments.mean) * np.sqrt(self.moments.count) > FAR * np.sqrt(self.moments.squares))

    def too_large(self, far: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where it took too much; a column that is one number must be that number exactly."""
        negligible = np.where(far, NEGLIGIBLE_FAR, NEGLIGIBLE)
        return np.asarray(np.sqrt(self._squares) > negligible * np.sqrt(self.moments.squares))


class Digits:
    """Finds, block by block, the columns that float32 is too coarse for.

    Args:
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
    """

    def __init__(self, ny: int, nu: int) -> None:
        self._ny, self._nu = ny, nu
        self._values, self._increments, self._costs = _Losses(ny + nu), _Losses(ny), _Losses(1)

    def add(self, values: Floats, rows: NDArray[np.float32]) -> None:
        """Looks at a block of values ``(B, 2 ny + nu + 2)`` and at what it became, packed as it is."""
        ny, end = self._ny, self._ny + self._nu
        errors = rows - values
        self._values.add(values[:, :end], errors[:, :end])
        self._increments.add(*(part[:, end + 1 : -1] - part[:, :ny] for part in (values, errors)))
        self.add_costs(values[:, end], rows[:, end])

    def add_costs(self, values: Floats, packed: NDArray[np.float32]) -> None:
        """The same of costs ``(B,)`` alone, where all else was float32 before."""
        self._costs.add(values[:, None], (packed - values)[:, None])

    @property
    def centring(self) -> Centring:
        """How the rows should be packed."""
        ny, found = self._ny, Centring.none(self._ny, self._nu)
        far = self._values.far
        lost = self._values.too_large(far)
        lost[:ny] |= self._increments.too_large(far[:ny])
        found.increments[:] = lost[:ny]
        parts = [
            np.where(lost, self._values.moments.mean, 0.0),
            np.where(self._costs.too_large(self._costs.far), self._costs.moments.mean, 0.0),
            np.where(lost[:ny], self._increments.moments.mean, 0.0),
        ]
        found.centre[:-1] = np.concatenate(parts)
        return found
