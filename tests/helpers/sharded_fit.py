"""A fit from shards, as a program that torchrun starts: theta of the first process goes to a file.

sharded_fit.py SHARDS CHECKPOINT OUT [--preset NAME] [--pids FOLDER]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import torch

from mpcoffline import OfflineMPCLearner
from mpcoffline.datasets import ShardedTable

LANES = 4


def fitted(shards: Path, checkpoint: Path, preset: str = "paper") -> Any:
    """A short fit of both regressions, which goes on from the checkpoint where there is one."""
    table = ShardedTable.open(shards, lanes=LANES)
    own: dict[str, Any] = {"hidden": (32, 32), "fit_n_steps": 40, "n_restarts": 0, "refit_rows": 2_000}
    learner = OfflineMPCLearner(lq_plant.make_mpc(), "cost+model", preset, seed=0, **own)
    epochs = learner.fitter(table, n_steps=80, n_steps_per_epoch=10, checkpoint=checkpoint, show_progress=False)
    for _ in epochs:
        pass
    return learner, table.ranks


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("shards", "checkpoint", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--pids", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.pids is not None:
        (given.pids / os.environ["RANK"]).write_text(str(os.getpid()), encoding="utf-8")
    learner, ranks = fitted(given.shards, given.checkpoint, given.preset)
    np.save(given.out.with_name(f"{given.out.stem}-{ranks.rank}.npy"), learner.theta)


if __name__ == "__main__":
    main()
