"""A fit on disk, so that what was interrupted can go on."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.archive import file_errors, read_archive, write_archive
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.outputs import check_output
from mpcoffline.core.text import check_name
from mpcoffline.learning import METHODS

from .run import Run

History = list[tuple[int, dict[str, float]]]
_KEPT = "kept/"  # in front of the names of what comes after the run


class Checkpoint:
    """A file with the state of a run at the end of an epoch.

    Args:
        path: Where.
        identity: What decides the fit (data, MPC, method, options, seed), as one short text.

    Raises:
        StorageError: If nothing could be written there.
    """

    def __init__(self, path: str | PathLike[str], identity: str) -> None:
        check_output(path)
        self._path, self._identity = Path(path), identity
        self._run: tuple[dict[str, Any], dict[str, NDArray[Any]]] = {}, {}
        self.kept: Kept = Kept(self)

    def resume(self, run: Run) -> History:
        """Takes a run to where the file says, if there is one; returns the history until then.

        Raises:
            InvalidArgumentError: If the file is of another fit; it stays as it is.
            FileFormatError: If it is damaged, or of a learning method that is not known here.
        """
        if not self._path.exists():
            return []
        document, arrays = read_archive(self._path, "checkpoint")
        METHODS.of_file(document.get("method"), str(self._path))
        with file_errors(self._path):
            identity = str(document["identity"])
            history = history_from_json(document["history"])
        if identity != self._identity:
            raise InvalidArgumentError(
                "checkpoint",
                expected="a checkpoint of the same data, MPC, options and seed",
                actual=f"{self._path}, of another fit",
                hint="Name another file, or delete this one.",
            )
        ran = {name: array for name, array in arrays.items() if not name.startswith(_KEPT)}
        dict.update(self.kept, {name.removeprefix(_KEPT): array for name, array in arrays.items() if name not in ran})
        self._run = self._document(run, history), ran
        run.restore(ran)
        return history

    def write(self, run: Run, history: History) -> None:
        """Replaces the file; an interruption leaves the old one."""
        self._run = self._document(run, history), run.to_arrays()
        self.write_again()

    def write_again(self) -> None:
        """Replaces the file by the last state of the run, and what was kept since; without a run, by nothing."""
        document, arrays = self._run
        if document:
            more = {f"{_KEPT}{name}": array for name, array in self.kept.items()}
            write_archive(self._path, "checkpoint", document, arrays | more)

    def _document(self, run: Run, history: History) -> dict[str, Any]:
        return {"method": run.method.name, "identity": self._identity, "history": list(history)}


class Kept(dict[str, NDArray[np.float64]]):
    """Arrays by name that outlive an interruption: what is put in is in the file when that returns.

    Args:
        checkpoint: Whose file.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__()
        self._checkpoint = checkpoint

    def __setitem__(self, name: str, array: NDArray[np.float64]) -> None:
        super().__setitem__(name, array)
        self._checkpoint.write_again()


def history_from_json(data: Any) -> History:
    """A history as files hold it: ``[[epoch, {metric: number}], ...]``.

    Raises:
        FileFormatError: For something else.
        TypeError: Likewise.
        ValueError: Likewise.
    """
    history: History = []
    for epoch, metrics in data:
        numbers = {check_name("metric", name, error=FileFormatError): float(value) for name, value in metrics.items()}
        history.append((int(epoch), numbers))
    return history
