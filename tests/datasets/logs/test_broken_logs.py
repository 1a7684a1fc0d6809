"""Logs that are broken: right numbers, or a word that names row and column; never a traceback."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from broken_logs import LEFT_OUT, LOG, MENDED, REFUSED, contents
from two_tanks import two_tanks

from mpcoffline import InvalidDataError

pytest.importorskip("polars")
PLANT = two_tanks()


def written(folder: Path, name: str) -> Path:
    file = folder / "log.csv"
    file.write_bytes(contents(name))
    return file


@pytest.mark.parametrize("name", MENDED)
def test_the_numbers_are_right_all_the_same(tmp_path: Path, name: str) -> None:
    rows = PLANT.read(written(tmp_path, name)).values()
    states = np.column_stack([LOG.h1, LOG.h2, LOG.set_point])
    np.testing.assert_allclose(rows.observations, states[:-1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(rows.next_observations, states[1:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(rows.actions[:, 0], LOG.pump[:-1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", REFUSED)
def test_a_clear_word_says_what_is_wrong(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidDataError, match=REFUSED[name][1]) as refused:
        PLANT.read(written(tmp_path, name))
    assert len(str(refused.value)) < 1_500


@pytest.mark.parametrize("name", LEFT_OUT)
def test_a_cell_that_is_no_number_is_left_out_with_its_row(tmp_path: Path, name: str) -> None:
    _, column, why = LEFT_OUT[name]
    table = PLANT.read(written(tmp_path, name))
    assert len(table) == 57  # the two intervals that touch row 31 are missing
    assert any((e.what, e.why, e.first) == (column, why, "log.csv, line 31") for e in table.report.left_out)
    states = np.delete(np.column_stack([LOG.h1, LOG.h2]), [28, 29, 59], axis=0)
    np.testing.assert_allclose(table.observations[:, :2], states, rtol=0, atol=1e-6)
