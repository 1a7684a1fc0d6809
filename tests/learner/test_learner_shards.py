"""A learner on shards: by one process, by two (kills: scripts/test_sharded), and what all of them hand out."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import lq_episodes
import lq_plant
import numpy as np
import pytest
import sharded_fit
from on_one_thread import one_thread  # noqa: F401 -- equal bits on any number of cores

from mpcoffline import MPC, OfflineMPCLearner
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import ShardedTable, write_shards

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shards")
    table = lq_episodes.episodes(n=200)
    write_shards(path, [table.take(slice(0, 2_400)), table.take(slice(2_400, None))])
    return path


def test_another_plant_is_refused_before_anything_is_learned(folder: Path) -> None:
    mpc: MPC = lq_plant.make_mpc(action_low=[-1.0], action_high=[1.0])
    with pytest.raises(InvalidDataError, match="action 0"):
        OfflineMPCLearner(mpc, preset="paper").fit(ShardedTable.open(folder), show_progress=False)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_two_processes_learn_what_one_learns(folder: Path, tmp_path: Path) -> None:
    alone, _ = sharded_fit.fitted(folder, tmp_path / "alone.ckpt")
    program = Path(sharded_fit.__file__)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [str(program), str(folder), str(tmp_path / "two.ckpt"), str(tmp_path / "two")]
    path = os.pathsep.join([str(ROOT), str(program.parent)])
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3_000:]
    first, second = (np.load(tmp_path / f"two-{rank}.npy") for rank in (0, 1))
    assert np.array_equal(first, second)
    assert np.array_equal(first, alone.theta)
    assert not np.array_equal(first, lq_plant.make_mpc().theta)

    other = ShardedTable.open(folder, lanes=sharded_fit.LANES + 1)
    learner = OfflineMPCLearner(lq_plant.make_mpc(), "cost+model", "paper", seed=0)
    with pytest.raises(InvalidArgumentError, match="checkpoint: expected a checkpoint of the same data"):
        learner.fit(other, checkpoint=tmp_path / "two.ckpt", show_progress=False)
