"""The page on a log: planted defects are named, a sound log raises no alarm, experiments are as long as needed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from planted_logs import Case, changed, defects, found_in, heater, is_named, logged
from typer.testing import CliRunner

from mpcoffline import Input, Plant, Signal, State
from mpcoffline.cli import app
from mpcoffline.cli.own_plants import _show
from mpcoffline.core.tables import Table
from mpcoffline.tune import LogCheck, check_log
from mpcoffline.tune.covered import coverage, gain, readable
from mpcoffline.tune.determined import in_words
from mpcoffline.tune.experiment import experiments

pytest.importorskip("polars")

LOG = logged("heater", 21, 300)
KELVIN = Case("kelvin", "heater", lambda: changed(LOG, T=LOG["T"] + 273.15), ("kelvin",))
STILL = Case("still", "tanks", lambda: logged("tanks", 7, 150, pump=lambda k, x: 3.0), ("input that varies",))


def stuck() -> dict[str, object]:
    T = LOG["T"].copy()
    T[100:160] = T[100]
    return changed(LOG, T=T)


CASES = {case.name: case for case in defects()}
QUICK = ("dead time of 1 step", "another sampling time", "state and input exchanged", "a sensor that drifts")


@pytest.mark.parametrize(
    "case",
    [KELVIN, STILL, Case("stuck", "heater", stuck, ("stuck at",)), *(CASES[name] for name in QUICK)],
    ids=lambda c: c.name,
)
def test_a_planted_defect_is_named(case: Case) -> None:
    problems, advice = found_in(case)
    assert is_named(case, problems, advice), (problems, advice)


@pytest.mark.parametrize(
    ("first", "after", "kind"), [(60, 150, "problem"), (60, 90, "advice"), (1170, 1200, "problem")]
)
def test_a_sensor_that_was_stuck_for_a_while_is_left_out_and_no_reason_to_wait(
    first: int, after: int, kind: str
) -> None:
    """A fortieth of the log is an incident; a twentieth of it, or to its end, something to mend."""
    plant, found = heater(), LogCheck()
    log = {name: np.tile(column, 4) for name, column in LOG.items()} | {"time": 5.0 * np.arange(1200)}
    log["T"][first:after] = log["T"][first]
    readable(plant.read(log), found)
    (remark,) = found.remarks
    assert (remark.kind, "stuck at" in remark.text) == (kind, True)
    assert ("to the log's end" in remark.text) == (after == 1200)


def test_what_the_log_covers_leaves_out_previews_and_clocks() -> None:
    plant = Plant(
        "store",
        dt=3600.0,
        states=[State("level", "kWh", 0, 10)],
        inputs=[Input("power", "kW", -1, 1)],
        signals=[Signal("day", period=24), Signal("price", "EUR/kWh", low=0, high=1, preview=12)],
        dynamics=lambda x, u: [u.power / 3600],
        cost=lambda x, u, d: d.price * u.power,
    )
    rng, found = np.random.default_rng(0), LogCheck()
    log = {"time": 3600.0 * np.arange(300), "level": 5 + rng.normal(size=300), "power": rng.choice([-1, 1], 300)}
    coverage(plant, plant.read(log | {"price": rng.choice([0.25, 0.75], 300)}), found)
    (covered,) = found.tables
    assert [row[0] for row in covered.rows] == ["level [kWh]", "price [EUR/kWh]", "power [kW]"]
    assert [row[-1] for row in covered.rows[1:]] == ["50%", "100%"]


def test_a_sound_log_is_worth_tuning_and_the_page_says_what_it_determines() -> None:
    plant, told = heater(), list[str]()
    page = check_log(plant, plant.read(LOG), tell=told.append)
    assert told == ["units, signs, sampling", "dead time", "parameters", "predictions"]
    assert page.problems == []
    assert page.verdict.startswith("Worth tuning.")
    assert page.identification is not None
    text = str(page)
    for words in (
        "300 rows, 5 s apart",
        "What the log covers",
        "T [°C]",
        "the log determines all 2",
        "dead time: none",
    ):
        assert words in text
    (parameters,) = [table for table in page.tables if table.title == "Parameters"]
    assert [row[-1] for row in parameters.rows] == ["yes", "yes"]
    assert page.identification.noise.measurement[0] == pytest.approx(0.05, rel=0.3)


def slow_room(seed: int, tau: float, n: int = 1_500) -> dict[str, np.ndarray]:
    """A log of a room under feedback; its persons, who are counted, heat it through a lag of tau control intervals."""
    rng, log = np.random.default_rng(seed), list[tuple[float, ...]]()
    T, felt, persons, heat, step = 20.0, 0.0, 0.0, 0.5, 0.0
    for k in range(n):
        persons = float(rng.integers(0, 20)) if k % 25 == 0 else persons
        step = 0.3 * rng.normal() if k % 10 == 0 else step
        heat = float(np.clip(0.5 + 0.4 * (21.0 - T) + step, 0.0, 2.0))
        log.append((60.0 * k, T + 0.01 * rng.normal(), heat, persons))
        T += 0.05 * (18.0 - T) + 0.12 * heat + 0.02 * (felt if tau else persons) + 0.005 * rng.normal()
        felt += (1.0 - np.exp(-1.0 / max(tau, 1e-3))) * (persons - felt)
    return dict(zip(("time", "T", "heat", "persons"), np.array(log).T, strict=True))


def room() -> Plant:
    return Plant(
        "room",
        dt=60.0,
        states=[State("T", "°C", 0, 60)],
        inputs=[Input("heat", "kW", 0, 2)],
        signals=[Signal("persons", low=0, high=30), Signal("wanted", "°C", usual=21.0)],
        parameters={"loss": 0.05, "kW": 0.1, "each": 0.02},
        dynamics=lambda x, u, d, p: [x.T + p.loss * (18.0 - x.T) + p.kW * u.heat + p.each * d.persons],
        cost=lambda x, u, d: (x.T - d.wanted) ** 2 + 0.1 * u.heat,
        discrete=True,
    )


def test_a_column_that_is_not_the_inputs_is_named_and_no_lag_of_it() -> None:
    problems, advice = found_in(CASES["a column that was not applied"])
    assert is_named(CASES["a column that was not applied"], problems, advice)
    assert not any("acts slowly" in text for text in advice)


@pytest.mark.parametrize("tau", [0.0, 10.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_signal_that_acts_slowly_is_named_with_its_time_constant_and_what_it_hides(seed: int, tau: float) -> None:
    plant = room()
    log = slow_room(seed, tau)
    page = check_log(plant, plant.read(log | {"wanted": np.full(len(log["time"]), 21.0)}))
    said = [each.text for each in page.remarks if each.about == "lag"]
    assert len(said) == (tau > 0.0)
    for text in said:
        assert text.startswith("persons acts slowly, as through a lag with a time constant of about ")
        amount, unit = text.split("about ")[1].split()[:2]
        assert unit == "minutes:"
        assert 60.0 * float(amount) == pytest.approx(60.0 * tau, rel=0.3)
        assert "outputs=" in text
    (lag,) = page.lags or [None]
    assert (lag is None) == (tau == 0.0)
    if lag is not None:
        each = plant.mpc().model.space.names.index("each")
        assert lag.after[each] == pytest.approx(0.02, rel=0.1)
        assert abs(lag.before[each] - 0.02) > 3.0 * abs(lag.after[each] - 0.02)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.25, "0.25 s"), (113.0, "110 s"), (200.0, "3.3 minutes"), (7_200.0, "2 hours"), (259_200.0, "3 days")],
)
def test_times_have_as_many_digits_as_they_deserve(seconds: float, words: str) -> None:
    assert in_words(seconds) == words


def test_the_verdict_claims_no_more_than_is_known() -> None:
    begin = "Worth tuning. Ten steps ahead, the described model is 3.0 times"
    assert gain(0.9, 0.3, 0.01).startswith(begin)
    assert gain(0.05, 0.05, 0.0).startswith("Nothing speaks against tuning. The described parameters predict")
    assert gain(0.4, 0.38, 0.25).startswith("Nothing speaks against")  # noise makes most of it
    poor = gain(0.62, 0.55, 0.01)
    assert poor.startswith("Tuning may gain little.")
    assert "miss by 62% of the spread and 55%, of which the sensors' noise makes 1%" in poor


def test_the_experiment_is_as_long_as_its_noise_asks_for() -> None:
    plant = Plant(
        "gain",
        dt=1.0,
        states=[State("y")],
        inputs=[Input("u", low=-1, high=1)],
        parameters={"b": 1.0, "q": 1.0},
        dynamics=lambda x, u, p: [p.b * u.u + 0 * p.q],
        cost={"y": 1.0},
        discrete=True,
    )
    found = experiments(plant.mpc(), ["b", "q"], np.zeros(1), np.ones(1), hold=1)
    assert found["q"] is None  # nothing depends on it
    assert found["b"] is not None
    # y = b u + noise of 1: the deviation of b is 1 / (a sqrt(n)), 10 % of it after n = 100 / a^2
    assert found["b"].amplitude == pytest.approx(0.8)
    assert found["b"].steps == pytest.approx(100 / 0.8**2, abs=1)


def test_the_command_gives_json_and_refuses_in_a_line(tmp_path: Path) -> None:
    runner, file, log = CliRunner(), tmp_path / "heater.py", tmp_path / "log.csv"
    folder = Path(__file__).parents[1] / "helpers"
    file.write_text(
        f"import sys\nsys.path.append({str(folder)!r})\nfrom planted_logs import heater\nplant = heater()\n"
    )
    columns = (LOG["time"], LOG["T"] + 273.15, LOG["ambient"], LOG["power"])
    rows = (",".join(f"{v:.7g}" for v in row) for row in zip(*columns, strict=True))
    log.write_text("\n".join(["s,TI-1,ambient,power", *rows]))
    missing = runner.invoke(app, ["check", str(file), str(log)])
    assert missing.exit_code == 1
    assert "log.csv: column of 'T': expected one among" in " ".join(missing.stderr.split())
    command = ["check", str(file), str(log), "--column", "T=TI-1", "--time", "s", "--unit", "T=K"]
    assert runner.invoke(app, [*command, "--where", "mode"]).exit_code == 2
    done = runner.invoke(app, [*command, "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["worth_tuning"]
    assert document["log"]["notes"][0] == "T: K to °C"
    assert [row["determined"] for row in document["tables"]["Parameters"]] == ["yes", "yes"]


def test_the_page_is_shown_problems_first(capsys: pytest.CaptureFixture[str]) -> None:
    page = LogCheck("10 rows", tables=[Table(("parameter", "in the log"), [("k", "1")], title="Parameters")])
    page.add("problem", "h1", "stuck at 3")
    page.add("good", "noise", "little")
    _show(page)
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines == [
        "Not yet worth tuning: 1 thing is to be looked at first.", "10 rows", "To be mended first", "* h1: stuck at 3",
        "Good", "* noise: little", "Parameters", "parameter  in the log", "k          1",
    ]  # fmt: skip
