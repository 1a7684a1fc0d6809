"""Logs of every kind, right and broken: the right numbers, or a clear word that names row and column."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tank_logs import START, Log, simulated, stamps, text
from two_tanks import two_tanks

from mpcoffline import (
    FileFormatError,
    Input,
    InvalidArgumentError,
    InvalidDataError,
    MPCOfflineError,
    Plant,
    Signal,
    State,
    StorageError,
)
from mpcoffline.datasets.logs.collecting import Options
from mpcoffline.datasets.logs.reading import read_log
from mpcoffline.datasets.logs.wanted import Wanted

pl = pytest.importorskip("polars")
LOG = simulated()
FAST = simulated(n=300, dt=1.0)


@pytest.fixture(scope="module")
def plant() -> Plant:
    return two_tanks()


def written(folder: Path, content: str | bytes, name: str = "log.csv") -> Path:
    file = folder / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def same(table: Any, log: Log, *, steps: int | None = None, atol: float = 1e-6) -> None:
    """Whether the table holds the first steps of a log, one step a row."""
    rows, n = table.values(), len(log.t) - 1 if steps is None else steps
    assert len(table) == n
    s = np.column_stack([log.h1, log.h2, log.set_point])
    np.testing.assert_allclose(rows.observations, s[:n], rtol=0, atol=atol)
    np.testing.assert_allclose(rows.next_observations, s[1 : n + 1], rtol=0, atol=atol)
    np.testing.assert_allclose(rows.actions[:, 0], log.pump[:n], rtol=0, atol=atol)
    cost = (log.h2 - log.set_point) ** 2 + 0.02 * log.pump**2
    np.testing.assert_allclose(rows.costs, cost[:n], rtol=1e-5, atol=1e-5)


def german(log: Log = LOG, form: str = "g") -> str:
    lines = ["Zeit;h1 [cm];h2 [cm];pump;set_point"]
    for t, *numbers in zip(stamps(log), *log[1:], strict=True):
        stamp = t.astype("M8[ms]").item().strftime("%d.%m.%Y %H:%M:%S")
        lines.append(";".join([stamp, *(f"{v:{form}}".replace(".", ",") for v in numbers)]))
    return "\n".join(lines)


def with_times(form: Callable[[Any], str], header: str = "time") -> str:
    return text(LOG, f"{header},h1 [cm],h2 [cm],pump,set_point", [form(t) for t in stamps(LOG)])


def formatted(form: str) -> str:
    return with_times(lambda t: t.astype("M8[ms]").item().strftime(form))


def seconds(t: Any) -> float:
    return float((t - np.datetime64("1970-01-01")) / np.timedelta64(1, "s"))


def column_of(place: int, value: str, *, every: int = 1) -> str:
    """The log with each row's cell of a column replaced, or every third's ..."""
    lines = text(LOG).splitlines()
    changed = (cell(place, value)(line) if i % every == every - 1 else line for i, line in enumerate(lines[1:]))
    return "\n".join([lines[0], *changed])


def cell(column: int, value: str) -> Callable[[str], str]:
    return lambda line: ",".join(value if i == column else c for i, c in enumerate(line.split(",")))


def apart(t: Any) -> str:
    return str(t.astype("M8[s]")).replace("T", ",")


def other_header(header: str, factors: tuple[float, ...] = (1, 1, 1, 1)) -> str:
    columns = (v * f for v, f in zip(LOG[1:], factors, strict=True))
    rows = zip(LOG.t, *columns, strict=True)
    return "\n".join([header, *(",".join(f"{v:.7g}" for v in row) for row in rows)])


RIGHT: dict[str, str | bytes] = {
    "plain": text(LOG),
    "semicolons and decimal commas": german(),
    "as many decimal commas in each row": german(form=".4f"),
    "tabs": text(LOG).replace(",", "\t"),
    "byte order mark": b"\xef\xbb\xbf" + text(LOG).encode(),
    "UTF-16": text(LOG).encode("utf-16"),
    "UTF-16 without a mark": text(LOG).encode("utf-16-le"),
    "Latin letters": "\n".join(
        f"{line},{'0' if i else 'Überlauf'}" for i, line in enumerate(text(LOG).splitlines())
    ).encode("cp1252"),
    "Windows line ends": text(LOG).replace("\n", "\r\n"),
    "quoted": "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text(LOG).splitlines()),
    "lines above the header": "Export of unit 3\nCreated 2026-03-02\n\n" + text(LOG),
    "a row of units": text(LOG, "time,h1,h2,pump,set_point").replace("set_point\n", "set_point\ns,cm,cm,V,cm\n", 1),
    "ISO with T and Z": with_times(lambda t: f"{t.astype('M8[s]')}Z"),
    "ISO with an offset": with_times(lambda t: f"{(t + np.timedelta64(1, 'h')).astype('M8[s]')}+01:00"),
    "ISO with parts of a second": with_times(lambda t: str(t)),
    "German day without seconds of its own": formatted("%d.%m.%y %H:%M:%S"),
    "American": formatted("%m/%d/%Y %I:%M:%S %p"),
    "of a PI historian": formatted("%d-%b-%y %H:%M:%S"),
    "epoch in s": with_times(lambda t: f"{seconds(t):.1f}"),
    "epoch in ms": with_times(lambda t: f"{1e3 * seconds(t):.0f}"),
    "minutes": with_times(lambda t: f"{(t - START) / np.timedelta64(60, 's'):.9g}", "time [min]"),
    "date and time apart": text(LOG, "Date,Time,h1 [cm],h2 [cm],pump,set_point", [apart(t) for t in stamps(LOG)]),
    "millimetres in brackets": other_header("time,h1 (mm),h2 [mm],pump,set_point [m]", (10, 10, 1, 0.01)),
    "millimetres behind the name": other_header("time,h1_mm,h2_mm,pump_mV,set_point_cm", (10, 10, 1000, 1)),
    "other case and signs": other_header("Time,H1,H2,PUMP,Set Point"),
    "further columns": other_header("time,h1,h2,pump,set_point").replace("\n", ",x\n"),
    "thousands in quotes": text(LOG).replace("0,9.0000", '0,"9.0000"', 1),
    "rows upside down": "\n".join([text(LOG).splitlines()[0], *reversed(text(LOG).splitlines()[1:])]),
    "each row twice": "\n".join(
        [text(LOG).splitlines()[0], *(line for line in text(LOG).splitlines()[1:] for _ in "ab")]
    ),
}


@pytest.mark.parametrize("kind", RIGHT)
def test_a_log_that_can_be_read_gives_its_numbers(plant: Plant, tmp_path: Path, kind: str) -> None:
    same(plant.read(written(tmp_path, RIGHT[kind])), LOG)


def lines_of(changes: dict[int, Callable[[str], str]]) -> str:
    """The log with some lines changed; the header is line 1."""
    lines = text(LOG).splitlines()
    return "\n".join(changes.get(i + 1, str)(line) for i, line in enumerate(lines))


REFUSED: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "log.csv: expected a table with a header, got an empty file"),
    "blank": (" \n\n", "log.csv: expected a table with a header, got an empty file"),
    "header only": (text(LOG).splitlines()[0] + "\n", "log.csv: expected rows below the header, got none"),
    "no header": ("\n".join(text(LOG).splitlines()[1:]), "log.csv, line 1: expected a header"),
    "one column": ("h1\n1\n2\n", "log.csv: expected a table of several columns, got one column"),
    "an Excel file": (b"PK\x03\x04" + b"\x00" * 50, "log.csv: expected a table .* got an archive, as of Excel"),
    "gzip": (gzip.compress(b"a,b\n1,2\n"), "log.csv: expected a table .* got a gzip archive"),
    "binary": (bytes(range(256)) * 20, "log.csv: expected a table .* got a binary file"),
    "a damaged Parquet file": (b"PAR1" + b"\x01" * 100, "log.csv: expected a table"),
    "a missing column": (
        other_header("time,h1,level2,pump,set_point"),
        "column of 'h2': expected one among 'time', 'h1'",
    ),
    "a column twice": (
        other_header("time,h1,h1,pump,set_point"),
        "column of 'h1': expected one column of that name, got 2",
    ),
    "another kind of unit": (
        other_header("time,h1 [bar],h2,pump,set_point"),
        r"column 'h1 \[bar\]': unit: expected a unit that can become cm, got bar",
    ),
    "an unknown unit": (
        other_header("time,h1 [blorb],h2,pump,set_point"),
        r"column 'h1 \[blorb\]': unit: expected one that is known, got 'blorb'",
    ),
    "text in a column": (
        column_of(2, "high"),
        r"log.csv, line 2: column 'h2 \[cm\]': expected a number, got 'high' \(60 of",
    ),
    "a column without a number": (column_of(1, ""), "log.csv: h1: expected numbers, got no number at all"),
    "a row too long": (
        lines_of({31: lambda line: f"{line},1,2"}),
        "line 31: expected 5 cells, as in the header, got 7",
    ),
    "times that are none": (column_of(0, "noon"), "column 'time': expected time stamps of a usual form, got 'noon'"),
    "most times missing": (column_of(0, "", every=3), "log.csv, line 4: time: expected a time stamp, got none in 33%"),
    "rows too far apart": (
        text(LOG._replace(t=12 * LOG.t)),
        "time: expected rows at most as far apart as .* 5 s, got 60 s",
    ),
    "an input in another unit": (
        other_header("time,h1,h2,pump,set_point", (1, 1, 16, 1)),
        "log.csv, line .*: pump: expected values from 0 to 6 V",
    ),
    "a state in another unit": (
        other_header("time,h1,h2,pump,set_point", (1, 10, 1, 1)),
        "log.csv, line .*: h2: expected values from 0 to 40 cm",
    ),
    "one row": ("\n".join(text(LOG).splitlines()[:2]), "log.csv: expected two rows, got 1"),
    "HTML": ("<html>\n<body>\nLogin, please\n</body>\n", "log.csv: "),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_log_that_cannot_be_read_is_refused_by_row_and_column(plant: Plant, tmp_path: Path, kind: str) -> None:
    content, message = REFUSED[kind]
    with pytest.raises(InvalidDataError, match=message):
        plant.read(written(tmp_path, content))


def without(rows: slice, columns: slice = slice(1, None)) -> Log:
    parts = [np.array(v) for v in LOG]
    for v in parts[columns]:
        v[rows] = np.nan
    return Log(*parts)


def test_empty_cells_and_words_of_historians_are_left_out_and_told(plant: Plant, tmp_path: Path) -> None:
    content = lines_of({20: cell(1, ""), 30: cell(2, "Bad Input"), 40: cell(3, "NaN"), 45: cell(1, "?!")})
    table = plant.read(written(tmp_path, content))
    told = {(e.what, e.why): (e.count, e.first) for e in table.report.left_out}
    assert told["h1", "text in place of a number, as '?!'"] == (1, "log.csv, line 45")
    assert told["h1", "no number"] == (2, "log.csv, line 20")
    assert told["h2", "no number"] == (1, "log.csv, line 30")
    assert told["pump", "no number"] == (1, "log.csv, line 40")
    # The steps to and from an unknown state are gone, and the one whose input is not known.
    assert len(table) == 59 - 2 - 2 - 1 - 2
    assert table.n_episodes == 5


def test_a_gap_begins_a_new_episode(plant: Plant, tmp_path: Path) -> None:
    lines = text(LOG).splitlines()
    table = plant.read(written(tmp_path, "\n".join(lines[:21] + lines[31:])))
    assert len(table) == 59 - 11
    assert table.episodes.lengths.tolist() == [19, 29]
    assert "1 gap of more than 7.5 s, where new episodes begin, the first before log.csv, line 22" in str(table.report)


def test_a_faster_log_is_resampled_where_inputs_change(plant: Plant, tmp_path: Path) -> None:
    late = FAST._replace(t=FAST.t + 2.0)  # its intervals begin 2 s after the full ones
    table = plant.read(written(tmp_path, text(late)))
    same(table, Log(*(v[::5] for v in FAST)), steps=59)
    assert "intervals beginning where inputs change" in str(table.report)


def test_rows_at_any_times_are_interpolated(plant: Plant, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 290, 2000))
    h = np.stack([10 + 0.01 * t, 8 - 0.01 * t])
    pump = np.where(t < 100, 1.0, 2.0)
    log = Log(t, *h, pump, np.full(2000, 9.0))
    table = plant.read(written(tmp_path, text(log, times=[f"{v:.9f}" for v in t])))
    rows = table.values()
    at = t[0] + 5.0 * np.arange(len(rows.costs))
    np.testing.assert_allclose(rows.observations[:, 0], 10 + 0.01 * at, atol=2e-4)
    changing = (rows.actions[:, 0] > 1) & (rows.actions[:, 0] < 2)
    assert changing.sum() == 1  # its mean over the interval in which it changed
    begin = at[np.flatnonzero(changing)[0]]
    assert rows.actions[changing, 0] == pytest.approx(1 + (begin + 5.0 - t[t >= 100][0]) / 5.0, abs=1e-3)


def test_a_changes_only_log_is_held(plant: Plant, tmp_path: Path) -> None:
    kept = np.append(True, np.diff(LOG.pump) != 0)
    kept[::4] = True
    log = Log(*(v[kept] for v in LOG))
    table = plant.read(written(tmp_path, text(log)), max_gap=60.0)
    assert len(table) >= 55


def test_daylight_saving(plant: Plant, tmp_path: Path) -> None:
    utc = np.datetime64("2026-10-25T00:30:00") + (1000 * LOG.t * 12).astype("timedelta64[ms]")  # 2:30 local, twice
    local = [t + np.timedelta64(2 if t < np.datetime64("2026-10-25T01:00:00") else 1, "h") for t in utc]
    content = text(LOG, times=[str(t.astype("M8[s]")) for t in local])
    minute = two_tanks(dt=60.0)
    known = minute.read(written(tmp_path, content), timezone="Europe/Berlin")
    guessed = minute.read(written(tmp_path, content))
    for table in (known, guessed):
        same(table, LOG)
    assert "end of daylight saving" in str(guessed.report)
    spring = np.datetime64("2026-03-29T01:30:00") + (1000 * LOG.t * 12).astype("timedelta64[ms]")
    content = text(LOG, times=[str(t.astype("M8[s]")) for t in spring])  # 2:00 to 2:59 are not there
    table = minute.read(written(tmp_path, content), timezone="Europe/Berlin")
    (lost,) = [e for e in table.report.left_out if "does not have" in e.why]
    assert (lost.count, lost.first) == (30, "log.csv, line 32")
    with pytest.raises(InvalidArgumentError, match="timezone: expected a"):
        minute.read(written(tmp_path, content), timezone="Nowhere/City")


def test_spikes_stuck_sensors_and_manual_mode_are_left_out(plant: Plant, tmp_path: Path) -> None:
    log = simulated(n=400)
    h1, h2 = log.h1.copy(), log.h2.copy()
    h1[50] = 39.0
    h2[100:160] = h2[100]
    mode = np.where((np.arange(400) >= 300) & (np.arange(400) < 320), "MAN", "Auto")
    frame = pl.DataFrame({"t": log.t, "h1": h1, "h2": h2, "pump": log.pump, "set_point": log.set_point, "mode": mode})
    table = plant.read(frame, where={"mode": "AUTO"})
    told = {(e.what, e.why): (e.count, e.first) for e in table.report.left_out}
    assert told["h1", "a spike"] == (1, "frame, row 50")
    assert told["h2", f"stuck at {h2[100]:g} while others move"] == (60, "frame, row 100")
    assert told["rows", "not mode = AUTO"] == (20, "frame, row 300")
    rows = table.values()
    assert np.abs(np.diff(rows.observations[:, 0])).max() < 3.0
    sound = plant.read(pl.DataFrame(dict(zip(("t", "h1", "h2", "pump", "set_point"), log, strict=True))))
    assert not sound.report.left_out


def test_values_beyond_ranges_are_left_out(plant: Plant) -> None:
    pump, h1 = LOG.pump.copy(), LOG.h1.copy()
    pump[10], pump[20], h1[30] = 6.03, 9.0, 55.0
    table = plant.read({"t": LOG.t, "h1": h1, "h2": LOG.h2, "pump": pump, "set_point": LOG.set_point})
    told = {(e.what, e.why): e.count for e in table.report.left_out}
    assert told == {("pump", "outside its bounds, 0 to 6 V"): 1, ("h1", "outside 0 to 40 cm"): 1}
    assert table.actions.max() == 6.0


@pytest.mark.parametrize("kind", ["parquet", "ipc", "arrow table", "lazy"])
def test_other_forms_than_text(plant: Plant, tmp_path: Path, kind: str) -> None:
    columns = {"time": stamps(LOG), "h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point}
    frame = pl.DataFrame(columns)
    log: Any = tmp_path / f"log.{kind}"
    if kind == "parquet":
        frame.write_parquet(log)
    elif kind == "ipc":
        frame.write_ipc(log)
    else:
        log = pytest.importorskip("pyarrow").table(columns) if kind == "arrow table" else frame.lazy()
    same(plant.read(log), LOG)


def test_several_files_episodes_and_clocks_that_restart(plant: Plant, tmp_path: Path) -> None:
    lines = text(LOG).splitlines()
    first, second = "\n".join(lines[:31]), "\n".join([lines[0], *lines[31:]])
    files = [written(tmp_path, second, "b.csv"), written(tmp_path, first, "a.csv")]
    assert plant.read(files).episodes.lengths.tolist() == [29, 29]
    dated = with_times(lambda t: str(t.astype("M8[s]"))).splitlines()
    files = [
        written(tmp_path, "\n".join([dated[0], *dated[31:]]), "b.csv"),
        written(tmp_path, "\n".join(dated[:31]), "a.csv"),
    ]
    same(plant.read(files), LOG)  # a calendar puts them together
    restarted = text(LOG._replace(t=np.append(LOG.t[:30], LOG.t[:30])))
    assert plant.read(written(tmp_path, restarted)).episodes.lengths.tolist() == [29, 29]
    runs = text(LOG).replace("set_point", "set_point,run", 1).splitlines()
    runs = [runs[0], *(f"{line},{'abc'[i // 20]}" for i, line in enumerate(runs[1:]))]
    table = plant.read(written(tmp_path, "\n".join(runs)), episode="run")
    assert table.episodes.lengths.tolist() == [19, 19, 19]


def test_without_time_rows_are_dt_apart_and_that_is_said(plant: Plant) -> None:
    table = plant.read({"h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point})
    same(table, LOG)
    assert "no column of time was found: rows are taken to be 5 s apart" in str(table.report)


def test_a_quantity_that_is_called_like_a_time_is_none() -> None:
    states = [State("T", "degC"), State("t", "degC")]
    plant = Plant(
        "oven",
        dt=2.0,
        states=states,
        inputs=[Input("u", low=0, high=1)],
        dynamics=lambda x, u: [u.u, x.T - x.t],
        cost={"T": 1.0},
    )
    rows = {"T": [20.0, 30.0, 25.0], "t": [1.0, 2.0, 4.0], "u": [0.1, 0.2, 0.3]}
    table = plant.read(rows)
    assert "no column of time was found: rows are taken to be 2 s apart" in table.report.notes
    np.testing.assert_allclose(table.observations, [[20, 1], [30, 2]])
    assert "time in s" in " ".join(plant.read(rows | {"time": [0, 2, 4]}).report.notes)


def test_a_signal_far_from_its_range_is_refused_and_one_about_it_noted(plant: Plant) -> None:
    frame = {"time": LOG.t, "h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": 10.0 * LOG.set_point}
    with pytest.raises(InvalidDataError, match=r"row 0: set_point: expected values from 5 to 20 cm, got 100"):
        plant.read(frame)
    table = plant.read(frame | {"set_point": np.where(LOG.t < 30.0, 25.0, LOG.set_point)})
    assert "set_point is outside its range, 5 to 20 cm, in 10% of the rows" in table.report.notes
    assert len(table) == 59


def test_columns_and_units_may_be_said(plant: Plant, tmp_path: Path) -> None:
    content = other_header("ts,LI-101.PV,LI-102.PV,P1.MV [%],SP", (10, 10, 1000, 1))
    columns = {"h1": "LI-101.PV", "h2": "LI-102.PV", "pump": "P1.MV [%]", "set_point": "SP"}
    file = written(tmp_path, content)
    same(plant.read(file, columns=columns, units={"h1": "mm", "h2": "mm", "pump": "mV"}), LOG)
    with pytest.raises(
        InvalidArgumentError, match="columns: expected names among h1, h2, pump, set_point, got 'level'"
    ):
        plant.read(file, columns={"level": "SP"})
    with pytest.raises(InvalidDataError, match="column 'SP': expected one quantity, got 'h1' and 'set_point'"):
        plant.read(file, columns=columns | {"h1": "SP"}, units={"pump": "mV"})


def test_temperatures_have_an_offset(tmp_path: Path) -> None:
    import casadi as ca

    from mpcoffline import Input, State

    room = Plant(
        "room",
        dt=60.0,
        states=[State("T", "°C", -20, 60)],
        inputs=[Input("heat", "kW", 0, 5)],
        dynamics=lambda x, u: [(u.heat - 0.1 * (x.T - 10)) / 3600],
        cost=lambda x: ca.fabs(x.T - 21),
    )
    log = written(tmp_path, "time,T [K],heat [W]\n0,293.15,1000\n60,294.15,2000\n120,295.15,0\n")
    rows = room.read(log).values()
    np.testing.assert_allclose(rows.observations[:, 0], [20.0, 21.0], atol=1e-5)
    np.testing.assert_allclose(rows.actions[:, 0], [1.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(rows.costs, [1.0, 0.0], atol=1e-5)


def german(log: Any, tags: str = "LI101 Oben [mm];LI102 Unten [cm];SC100 Pumpe [V];LC102 Sollwert [cm]") -> str:
    """A log whose rows have text at both ends, so that a comma leaves no number whole."""
    rows = [f"Zeit;{tags};Betriebsart"]
    for k, values in enumerate(zip(10 * log.h1, log.h2, log.pump, log.set_point, strict=True)):
        numbers = [f"{value:.3f}".replace(".", ",") for value in values]
        rows.append(
            ";".join([f"02.03.2026 06:{5 * k // 60:02}:{5 * k % 60:02}", *numbers, "HAND" if k < 2 else "AUTO"])
        )
    return "\n".join(rows) + "\n"


def test_text_at_both_ends_of_a_row_hides_no_decimal_comma(tmp_path: Path, plant: Plant) -> None:
    columns = {"h1": "LI101", "h2": "LI102", "pump": "SC100", "set_point": "lc102 Sollwert"}
    table = plant.read(written(tmp_path, german(LOG)), columns=columns, where={"Betriebsart": "AUTO"})
    np.testing.assert_allclose(table.values().observations[:, 0], LOG.h1[2:-1], atol=1e-3)
    np.testing.assert_allclose(table.values().actions[:, 0], LOG.pump[2:-1], atol=1e-3)


def test_a_description_says_what_logs_call_its_columns(tmp_path: Path) -> None:
    described = two_tanks(columns={"h1": "LI101", "h2": "LI102", "pump": "SC100", "set_point": "LC102"})
    for reader in (described.wanted, Wanted.from_json(described.wanted.to_json(described.cost_function))):
        table = read_log(written(tmp_path, german(LOG)), reader, Options(where={"Betriebsart": "AUTO"}))
        np.testing.assert_allclose(table.values().observations[:, 0], LOG.h1[2:-1], atol=1e-3)
    assert len(described.read(written(tmp_path, text(LOG)))) == len(two_tanks().read(written(tmp_path, text(LOG))))
    both = german(LOG).replace("LI102 Unten [cm]", "h1 [cm]")  # a column of its name is another one here
    table = described.read(written(tmp_path, both), columns={"h2": "h1"})
    np.testing.assert_allclose(table.values().observations[:, 0], LOG.h1[:-1], atol=1e-3)
    with pytest.raises(InvalidDataError, match="column 'LI102': expected one among 'Zeit', "):
        described.read(written(tmp_path, german(LOG).replace("LI102", "XX")))
    with pytest.raises(InvalidArgumentError, match=r"columns: expected one of .*got 'h3'"):
        two_tanks(columns={"h3": "LI103"})
    with pytest.raises(InvalidArgumentError, match="columns: h1: expected a header of up to 200 characters"):
        two_tanks(columns={"h1": " "})
    wrong = described.wanted.to_json(described.cost_function)
    wrong["states"][0]["header"] = "x" * 201
    with pytest.raises(FileFormatError, match="header of h1"):
        Wanted.from_json(wrong)


def test_a_tag_of_two_columns_is_none_of_them(tmp_path: Path, plant: Plant) -> None:
    log = written(tmp_path, german(LOG, "LI101 Oben [mm];LI101 Unten [cm];SC100 Pumpe [V];LC102 Sollwert [cm]"))
    names = {"h2": "LI101 Unten", "pump": "SC100", "set_point": "LC102"}
    with pytest.raises(InvalidDataError, match=r"column 'LI101': expected one column of that name, got 2: 'LI101 Oben"):
        plant.read(log, columns={"h1": "LI101", **names})
    with pytest.raises(InvalidDataError, match=r"columns of 'h1', 'LI10': .*Is it 'LI101") as refused:
        plant.read(log, columns={**names, "h2": "LI10"})
    assert "Zeit'?" not in str(refused.value)


def test_previews_and_clocks_come_from_the_log() -> None:
    plant = two_tanks(signals=[Signal("set_point", "cm", preview=2), Signal("day", period=17280)])
    t = stamps(LOG)
    columns = {"time": t, "h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point}
    rows = plant.read(columns).values()
    sp = LOG.set_point
    np.testing.assert_allclose(
        rows.observations[:-1, 2:5], np.stack([sp[:-2], sp[1:-1], np.append(sp[2:], [])], axis=1)[:58]
    )
    assert np.arctan2(rows.observations[0, 6], rows.observations[0, 5]) == pytest.approx(
        np.pi / 2, abs=1e-5
    )  # 6 o'clock


def test_a_price_on_changes_counts_the_step_before() -> None:
    plant = two_tanks(cost={"h2": 1.0}, references={"h2": "set_point"}, changes={"pump": 2.0})
    rows = plant.read({"h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point}).values()
    change = np.append(0.0, np.diff(LOG.pump))[:-1]
    np.testing.assert_allclose(rows.costs, ((LOG.h2 - LOG.set_point) ** 2)[:-1] + 2 * change**2, rtol=1e-5, atol=1e-5)


def test_the_log_becomes_a_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: Plant) -> None:
    from mpcoffline import TransitionTable

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    table = plant.read({"h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point})
    again = TransitionTable.from_minari(table.to_minari("mine/tanks/log-v0"))
    assert again.names == table.names == ("h1 [cm]", "h2 [cm]", "set_point [cm]", "pump [V]")
    np.testing.assert_allclose(again.values().next_observations, table.values().next_observations, rtol=1e-6)
    np.testing.assert_array_equal(again.episode_ids, table.episode_ids)


def test_offsets_cost_no_digits(tmp_path: Path) -> None:
    plant = two_tanks(
        states=[type(two_tanks().states[0])("h1", "cm"), type(two_tanks().states[0])("h2", "cm")],
        limits=[],
        dynamics=lambda x, u, p: [p.k * u.pump, p.c1 * u.pump - p.c2],
    )
    columns = {"h1": LOG.h1 + 1e7, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point}
    rows = plant.read(columns).values()
    np.testing.assert_allclose(rows.next_observations[:, 0] - rows.observations[:, 0], np.diff(LOG.h1), atol=1e-4)


def test_what_is_no_log_is_refused(plant: Plant, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"none.csv: expected a log"):
        plant.read(tmp_path / "none.csv")
    with pytest.raises(InvalidArgumentError, match="log: expected a file, or a frame"):
        plant.read(3)
    with pytest.raises(InvalidArgumentError, match="max_gap: expected at least the control interval"):
        plant.read({"h1": [1.0]}, max_gap=1.0)
    for error in (InvalidArgumentError, InvalidDataError, StorageError):
        assert issubclass(error, MPCOfflineError)


def test_a_column_of_few_words_that_nothing_reads_is_named_with_how_to_choose_by_it(plant: Plant) -> None:
    names = ("t", "h1", "h2", "pump", "set_point")
    frame = dict(zip(names, LOG, strict=True))
    n = len(LOG.t)
    modes = ["MAN" if i < n // 4 else "AUTO" for i in range(n)]
    others = {
        "operation mode": modes,
        "operator": [f"shift {i}" for i in range(n)],
        "count": [f"{i % 3}" for i in range(n)],
        "alarm": ["high" if i < n // 4 else "" for i in range(n)],
        "site": ["north"] * n,
    }
    (said,) = (note for note in plant.read(frame | others).report.notes if "is not used" in note)
    share = modes.count("AUTO") / n
    assert said.startswith(
        f"column 'operation mode' is not used: 'AUTO' in {share:.1%}, 'MAN' in {1 - share:.1%} of the"
    )
    assert "--where 'operation mode=AUTO'" in said
    chosen = plant.read(frame | others, where={"operation mode": "AUTO"})
    assert not any("is not used" in note for note in chosen.report.notes)
