"""(VALUE) on a GPU: the CPU's V, exact resumption, and results that need no GPU afterwards. Skipped without one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest
import torch

from mpcoffline import OfflineMPCLearner
from mpcoffline.learning import VALUE_METHODS, ValueConfig
from mpcoffline.learning.value.fit import ValueTraining

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.8, 0.8, 9)), axis=-1).reshape(-1, 2)


def training(device: str, **options: Any) -> ValueTraining:
    config = ValueConfig(**({"hidden": (16, 16), "n_steps": 300, "batch_size": 64, "learning_rate": 5e-3} | options))
    return ValueTraining(lq_plant.exploring_log(1_000), 0.9, config, seed=0, device=device)


@pytest.mark.parametrize(
    "options",
    [*({"method": method} for method in ("auto", *VALUE_METHODS)), {"n_members": 3}, {"validation": 0.3}],
    ids=str,
)
def test_both_devices_learn_the_same_value(options: dict[str, Any]) -> None:
    values = []
    for device in ("cpu", "cuda"):
        run = training(device, **options)
        run.advance(300)
        values.append(run.result.predict(GRID))
    spread = np.ptp(values[0])
    np.testing.assert_allclose(values[1], values[0], atol=0.01 * spread)  # float32, sums in another order


@pytest.mark.parametrize("options", [{"method": method} for method in ("auto", *VALUE_METHODS)], ids=str)
def test_an_interrupted_training_ends_with_the_same_bits(options: dict[str, Any]) -> None:
    whole, first, second = (training("cuda", **options) for _ in range(3))
    whole.advance(300)
    first.advance(120)
    second.restore(first.to_arrays())
    second.advance(300)
    for name, array in whole.to_arrays().items():
        np.testing.assert_array_equal(second.to_arrays()[name], array, err_msg=name)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_a_fit_on_the_gpu_agrees_with_the_cpus_and_is_saved(preset: str, tmp_path: Path) -> None:
    table = lq_plant.exploring_log(1_000)
    costs = []
    for device in ("cpu", "cuda"):
        learner = OfflineMPCLearner(
            lq_plant.make_mpc(), learn="cost+model", preset=preset, seed=0, device=device, value_n_steps=300
        )
        learner.fit(table, show_progress=False)
        mpc = learner.mpc
        stage, terminal = mpc.stage_function, mpc.terminal_function
        costs.append([[float(stage(x, x[:1], mpc.theta)), float(terminal(x, mpc.theta))] for x in GRID])
    np.testing.assert_allclose(costs[1], costs[0], atol=0.05 * np.max(costs[0]))

    learner.save(tmp_path / "learner.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "learner.zip")
    np.testing.assert_array_equal(loaded.theta, learner.theta)
    assert loaded.value_function is not None
    assert loaded.value_function.mean.device.type == "cpu"


def test_an_interrupted_fit_on_the_gpu_goes_on_bit_for_bit(tmp_path: Path) -> None:
    def learner() -> OfflineMPCLearner:
        return OfflineMPCLearner(
            lq_plant.make_mpc(), preset="default", seed=0, device="cuda", value_n_steps=200, validation=0.0
        )

    table, file = lq_plant.exploring_log(1_000), tmp_path / "checkpoint.zip"
    whole = learner()
    whole.fit(table, show_progress=False, n_steps_per_epoch=50)
    part = learner()
    part.fit(
        table,
        show_progress=False,
        n_steps_per_epoch=50,
        checkpoint=file,
        callbacks=[lambda learner, epoch, metrics: epoch < 2],
    )
    resumed = learner()
    resumed.fit(table, show_progress=False, n_steps_per_epoch=50, checkpoint=file)
    np.testing.assert_array_equal(resumed.theta, whole.theta)
