"""A fit from shards, as a program that torchrun starts: theta of the first process goes to a file.

    sharded_fit.py SHARDS CHECKPOINT OUT [--dies RANK EPOCH] [--preset NAME] [--pids FOLDER]

With ``--dies`` a process kills itself at the end of an epoch, in its first life.
"""

from __future__ import annotations

import argparse
import os
import signal
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import torch

from mpcoffline import OfflineMPCLearner
from mpcoffline.datasets import ShardedTable

LANES = 4


def fitted(shards: Path, checkpoint: Path, dies: list[int] | None = None, preset: str = "paper") -> Any:
    """A short fit of both regressions, which goes on from the checkpoint where there is one."""
    table = ShardedTable.open(shards, lanes=LANES)
    own: dict[str, Any] = {"hidden": (32, 32), "fit_n_steps": 40, "n_restarts": 0, "refit_rows": 2_000}
    learner = OfflineMPCLearner(lq_plant.make_mpc(), "cost+model", preset, seed=0, **own)
    epochs = learner.fitter(table, n_steps=80, n_steps_per_epoch=10, checkpoint=checkpoint, show_progress=False)
    for epoch, _ in epochs:
        first_life = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") == "0"
        if dies is not None and first_life and [table.ranks.rank, epoch] == dies:
            os.kill(os.getpid(), signal.SIGKILL)
    return learner, table.ranks


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("shards", "checkpoint", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--dies", nargs=2, type=int)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--pids", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.pids is not None:
        (given.pids / os.environ["RANK"]).write_text(str(os.getpid()), encoding="utf-8")
    learner, ranks = fitted(given.shards, given.checkpoint, given.dies, given.preset)
    np.save(given.out.with_name(f"{given.out.stem}-{ranks.rank}.npy"), learner.theta)


if __name__ == "__main__":
    main()
