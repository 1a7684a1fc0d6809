"""Callbacks of ``OfflineMPCLearner.fit`` that write its metrics down: CSV files and TensorBoard events."""

from __future__ import annotations

import csv
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.outputs import check_output, check_output_folder, make_folder

if TYPE_CHECKING:
    from .learner import OfflineMPCLearner


class CSVLogger:
    """Writes every metric of every epoch as a row ``epoch, total_step, metric, value`` of one CSV file.

    Example:
        >>> learner.fit(dataset, callbacks=[CSVLogger("fit.csv")])

    Args:
        path: The file; rows are added to one that exists, so that a resumed fit goes on in it.

    Raises:
        StorageError: If nothing could be written there.
    """

    COLUMNS = ("epoch", "total_step", "metric", "value")

    def __init__(self, path: str | PathLike[str]) -> None:
        check_output(path, make=True)
        self._path = Path(path)

    def __call__(self, learner: OfflineMPCLearner, epoch: int, total_step: int) -> None:
        """Adds the rows of an epoch."""
        make_folder(self._path.parent)
        new = not self._path.exists()
        with self._path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(self.COLUMNS)
            writer.writerows((epoch, total_step, name, value) for name, value in learner.history[-1][1].items())


class TensorBoardLogger:
    """Writes every metric as a scalar of TensorBoard, over the total number of gradient steps.

    Args:
        folder: Where TensorBoard looks for events.

    Raises:
        StorageError: If nothing could be written there.
        MPCOfflineError: If TensorBoard is not installed.
    """

    def __init__(self, folder: str | PathLike[str]) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise MPCOfflineError(
                "TensorBoardLogger",
                expected="the package tensorboard",
                actual=str(error),
                hint='pip install "mpcoffline[tensorboard]"',
            ) from error
        check_output_folder(folder)
        self._writer = SummaryWriter(str(folder))

    def __call__(self, learner: OfflineMPCLearner, epoch: int, total_step: int) -> None:
        """Writes the scalars of an epoch."""
        for name, value in learner.history[-1][1].items():
            self._writer.add_scalar(f"fit/{name}", value, total_step)
        self._writer.flush()
