"""Minari's other format: arrow data sets give the same table as hdf5 ones."""

from __future__ import annotations

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from mpcoffline import TransitionTable

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'minari[arrow]'")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


def episodes() -> list[EpisodeBuffer]:
    rng = np.random.default_rng(0)
    return [
        EpisodeBuffer(
            id=i,
            observations=rng.normal(size=(steps + 1, 3)).astype(np.float32),
            actions=rng.uniform(-1.0, 1.0, (steps, 2)).astype(np.float32),
            rewards=rng.normal(size=steps),
            terminations=np.arange(steps) == (steps - 1 if i == 1 else steps),
            truncations=np.arange(steps) == (steps if i == 1 else steps - 1),
            infos={"cost": rng.normal(size=(steps + 1, 1))},
        )
        for i, steps in enumerate((5, 8, 1))
    ]


def test_arrow_and_hdf5_give_the_same_table() -> None:
    tables = [
        TransitionTable.from_minari(
            minari.create_dataset_from_buffers(
                f"mine/plant/{data_format}-v0",
                episodes(),
                observation_space=spaces.Box(-np.inf, np.inf, (3,), np.float32),
                action_space=spaces.Box(-1.0, 1.0, (2,), np.float32),
                data_format=data_format,
            )
        )
        for data_format in ("hdf5", "arrow")
    ]
    np.testing.assert_array_equal(tables[0].rows, tables[1].rows, strict=True)
    np.testing.assert_array_equal(tables[0].episode_ids, tables[1].episode_ids)
    expected = episodes()
    np.testing.assert_array_equal(tables[1].observations[5:13], expected[1].observations[:-1])
    np.testing.assert_allclose(tables[1].costs[:5], -expected[0].rewards, rtol=1e-7)
    assert tables[1].terminations.sum() == 1.0
