"""Single empty cells: bridged where the log's own values say that this is harmless, told where not; missing columns."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tank_logs import simulated, text
from two_tanks import two_tanks

from mpcoffline import Input, Plant, State
from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets.logs.sampling import Series, bridge

pytest.importorskip("polars")


def plant() -> Plant:
    return Plant(
        "a slow one",
        dt=1.0,
        states=[State("x", "cm")],
        inputs=[Input("u", "V", -1, 1)],
        parameters={"a": 0.1},
        dynamics=lambda x, u, p: [p.a * (u.u - x.x)],
        cost={"x": 1.0},
    )


def read(t: Any, x: Any, u: Any, empty: list[int]) -> Any:
    import polars

    cells = [None if k in empty else float(v) for k, v in enumerate(x)]
    return plant().read(polars.DataFrame({"time": t, "x": cells, "u": u}))


def test_a_smooth_state_is_bridged_within_what_is_said() -> None:
    t = np.arange(400.0)
    x = np.sin(t / 30.0)
    empty = [50, 51, 120, 301]  # two beside each other stay a gap
    table = read(t, x, np.round(np.cos(t / 30.0), 3), empty)
    (note,) = [each for each in table.report.notes if "single empty" in each]
    assert note.startswith("x: 2 single empty cells bridged")
    said = float(re.findall(r"off by (\S+) cm", note)[0])
    columns = table.values()
    starts = columns.observations[:, 0]
    for k in (120, 301):
        nearest = float(np.abs(starts - x[k]).min())
        assert nearest <= 2.0 * said, "a root mean square is half of the largest error of a sine, and less"
    assert table.n_episodes == 2, "one gap of two cells"
    assert len(table) == len(t) - 1 - 3


def test_a_state_that_jumps_is_not_bridged_and_what_it_costs_is_said() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(400.0)
    table = read(t, rng.normal(size=400), np.round(rng.uniform(-1, 1, 400), 3), [120, 301])
    (note,) = [each for each in table.report.notes if "single empty" in each]
    assert "2 single empty cells not bridged, a new episode begins behind each" in note
    assert table.n_episodes == 3
    assert len(table) == len(t) - 1 - 4, "the step in front of each cell and the one behind it"


def test_nothing_is_said_where_no_cell_is_empty() -> None:
    t = np.arange(60.0)
    assert not [each for each in read(t, np.sin(t / 30.0), np.zeros(60), []).report.notes if "single empty" in each]


def test_the_error_of_a_bridge_is_that_of_the_curvature() -> None:
    """Of x = t^2 in unit steps, the middle of two neighbours is off by one; a step goes 2 t - 1."""
    t = np.arange(10.0)
    off, step = bridge(Series(t, t**2), 2.05)
    assert off == pytest.approx(1.0)
    assert step == pytest.approx(np.sqrt(np.mean((2 * t[1:-1] - 1) ** 2)))


def test_all_missing_columns_are_named_at_once(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text(text(simulated(), header="time,level_1,h2 [cm],pmp,set_point"))
    with pytest.raises(InvalidDataError) as told:
        two_tanks().read(file)
    assert "columns of 'h1', 'pump'" in str(told.value)
    assert "pump: Is it 'pmp'?" in str(told.value)
    file.write_text(text(simulated(), header="time,level_1,h2 [cm],pump,set_point"))
    with pytest.raises(InvalidDataError, match="column of 'h1'"):
        two_tanks().read(file)


def test_a_log_that_was_written_faster_than_its_plant_is_says_so() -> None:
    """A simulated loop by the computer's clock: hundreds of rows within one control interval."""
    rng = np.random.default_rng(0)
    with pytest.raises(InvalidDataError, match=r"All rows lie within 0\.998 s, less than one control .* VirtualClock"):
        read(0.002 * np.arange(500), rng.normal(size=500), rng.choice([-1.0, 1.0], 500), [])
