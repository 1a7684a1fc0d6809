"""The log of a loop: a row a period, as a CSV that plants read again."""

from __future__ import annotations

import csv
import datetime
import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import IO, Self

from mpcoffline.core.errors import StorageError
from mpcoffline.core.files import check_regular
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.labels import Label

#: What decided: the policy, the policy with what ran before blended in, the input before, the fall-back input.
DECIDED = ("policy", "transfer", "hold", "fallback")
DECIDED_BY = "decided_by"  #: The column that says so.


_MILLISECONDS, _SLOW = 3, 1.0  # digits of a second; seconds of a period for which they suffice


class DecisionLog:
    """Writes a row a period: time, measurements, inputs as they were applied, and how it came to them.

    ``mpcoffline retune`` and :meth:`mpcoffline.Plant.read` take the file; what was lost is an empty cell. An existing
    log of the same columns goes on. Each row is handed to the system at once.

    Args:
        path: The file.
        mpc: What acts, for names and units.
        measured: Names and units of what is measured; by default those of the MPC's observations.

    Raises:
        StorageError: If the file is something else, of other columns, or cannot be written.
    """

    def __init__(self, path: str | PathLike[str], mpc: MPC, measured: Sequence[Label] | None = None) -> None:
        self._path, layout = Path(path), mpc.layout
        self._digits = _MILLISECONDS if mpc.model.dt >= _SLOW else 2 * _MILLISECONDS
        clocks = {column for signal in layout.signals if signal.period is not None for column in signal.columns}
        later = {column for signal in layout.signals for column in signal.columns[1:]}
        measured = layout.y_labels if measured is None else measured
        self._values = [label for label in measured if label.name not in clocks | later]
        self._inputs = list(layout.u_labels)
        wanted = [Label(f"wanted {label.name}", label.unit) for label in self._inputs]
        labels = (*self._values, *self._inputs)
        self._header = ["time", *map(str, (*labels, *wanted)), DECIDED_BY, "late_s", "solve_s", "note"]
        try:
            exists = self._path.exists()
            if exists:
                check_regular(self._path)
                self._check_header()
            self._file: IO[str] = self._path.open("a", newline="", encoding="utf-8")
            self._writer = csv.writer(self._file)
            if not exists or not self._path.stat().st_size:
                self._write(self._header)
        except OSError as error:
            raise StorageError.of(path, error) from error

    def _check_header(self) -> None:
        with self._path.open(newline="", encoding="utf-8", errors="replace") as file:
            first = next(csv.reader([file.readline(1 << 16)]), [])
        if first and first != self._header:
            hint = "Name another file, or move that one away."
            raise StorageError(str(self._path), expected="a log of the same columns", actual="another file", hint=hint)

    def row(
        self,
        epoch: float,
        values: Mapping[str, float],
        applied: Array,
        wanted: Array | None,
        decided_by: str,
        late: float,
        solving: float,
        note: str,
    ) -> None:
        """Writes a row.

        Args:
            epoch: Begin of the period, in s since 1970.
            values: What was measured, by name; what is missing stays empty.
            applied: The inputs that act, ``(nu,)``.
            wanted: What the policy asked for; None where it was not asked, or gave no answer.
            decided_by: One of ``"policy"``, ``"transfer"``, ``"hold"``, ``"fallback"``.
            late: Seconds from the begin of the period to the writing of the inputs.
            solving: Seconds that the policy took.
            note: What went wrong; empty where nothing did.

        Raises:
            StorageError: If it cannot be written.
        """
        at = datetime.datetime.fromtimestamp(round(epoch, self._digits), datetime.UTC)
        stamp = at.isoformat(timespec="milliseconds" if self._digits == _MILLISECONDS else "microseconds")
        measured = [_cell(values.get(label.name, math.nan)) for label in self._values]
        asked = [_cell(v) for v in wanted] if wanted is not None else [""] * len(self._inputs)
        cells = [stamp, *measured, *map(_cell, applied), *asked, decided_by, f"{late:.6f}", f"{solving:.6f}", note]
        self._write(cells)

    def _write(self, cells: Sequence[str]) -> None:
        try:
            self._writer.writerow(cells)
            self._file.flush()
        except OSError as error:
            raise StorageError.of(self._path, error) from error

    def close(self) -> None:
        """Ends it."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""
