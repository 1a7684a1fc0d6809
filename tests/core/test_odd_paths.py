"""Blanks, accents and letters of other scripts in every path: store, cache, logs, policies, compiled solvers."""

from __future__ import annotations

import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from compiling import QUICK_FLAGS, compiled_with
from lq_plant import make_mpc, random_log

from mpcoffline import MPCPolicy, TransitionTable, load_dataset
from mpcoffline.datasets import dataset_from_table, from_csv, from_do_mpc, from_lerobot, verify
from mpcoffline.datasets.store.ids import dataset_path
from mpcoffline.datasets.store.manifest import write_manifest
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.solvers import make_solver

ODD = "mein Ordner (é, 测试) 'x' $HOME"


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of such a name, with everything in it that is written."""
    folder = tmp_path / ODD
    folder.mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "store"))
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(folder / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.chdir(folder)
    return folder


def test_a_solver_is_compiled_and_a_policy_kept(odd: Path) -> None:
    mpc = make_mpc(horizon=5)
    with compiled_with(QUICK_FLAGS):
        solver = make_solver(mpc, "ddp")
        solution = solver.solve([0.5, -0.2])
    assert solution.success
    assert list((odd / "cache" / "solvers").iterdir())
    MPCPolicy(mpc).save(odd / "ein Regler.zip")
    np.testing.assert_array_equal(MPCPolicy.load("ein Regler.zip").mpc.theta, mpc.theta)
    OfflineMPCLearner(mpc).save("学习.zip")
    np.testing.assert_array_equal(OfflineMPCLearner.load(odd / "学习.zip").nominal_mpc.theta, mpc.theta)


def test_data_sets_are_kept_and_read_as_another_machine_wrote_them(odd: Path) -> None:
    """The same file with every number the other way round, as HDF5 of a big-endian machine has them."""
    table = random_log(30)
    dataset_from_table("test/log-v0", table)
    np.testing.assert_array_equal(TransitionTable.from_minari("test/log-v0").rows, table.rows)
    path = dataset_path("test/log-v0") / "data" / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        for episode in file.values():
            for column in ("observations", "actions", "rewards"):
                values = episode[column][()]
                del episode[column]
                episode.create_dataset(column, data=values.astype(values.dtype.newbyteorder(">")))
    write_manifest(dataset_path("test/log-v0"))
    np.testing.assert_array_equal(TransitionTable.from_minari(load_dataset("test/log-v0")).rows, table.rows)
    assert verify("test/log-v0").ok


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
def test_logs_with_line_ends_of_any_system(odd: Path, ends: str) -> None:
    lines = ["Höhe,Ventil,Kosten", "1.0,0.5,2.0", "1.5,0.25,3.0", "2.0,0.0,4.0", ""]
    (odd / "Protokoll ä.csv").write_bytes(("\ufeff" + ends.join(lines)).encode("utf-8"))
    table = from_csv("Protokoll ä.csv", observations=["Höhe"], actions=["Ventil"], cost="Kosten")
    np.testing.assert_array_equal(table.observations, [[1.0], [1.5]])
    np.testing.assert_array_equal(table.next_observations, [[1.5], [2.0]])
    np.testing.assert_array_equal(table.costs, [2.0, 3.0])


def test_files_of_other_tools_are_refused_by_name(odd: Path) -> None:
    """Where a reader of another kind of file is given them: never read as numbers, never run."""
    pickled = odd / "results.pkl"
    pickled.write_bytes(b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x8c\x06system\x93.")
    with h5py.File(odd / "d4rl.hdf5", "w") as file:
        file["observations"] = np.zeros((3, 2))
    np.savez(odd / "arrays.npz", observations=np.zeros((3, 2)))
    (odd / "log.csv").write_text("a,b\n1,2\n")
    for path in sorted(odd.glob("*.*")):
        for read in (MPCPolicy.load, OfflineMPCLearner.load):
            with pytest.raises(ValueError, match=path.name):
                read(path)
        with pytest.raises(ValueError, match=r"data|LeRobot|frames|parquet"):
            from_lerobot(path)
        with pytest.raises(ValueError, match="stored data of do-mpc"):
            from_do_mpc(str(path), cost="L")
        if path.suffix != ".csv":
            with pytest.raises(ValueError, match=path.name):
                from_csv(path, observations=["a"], actions=["b"], cost="c")
