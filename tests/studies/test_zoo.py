"""The bench of foreign plants: outcomes, the file that is resumed, the counts."""

from __future__ import annotations

import logging
import sys
import warnings
from functools import partial
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plant_file import TEXT

from mpcoffline import FileFormatError, OfflineMPCLearner
from mpcoffline.learner.candidates import Candidates
from mpcoffline.studies import lines, zoo, zoo_page
from mpcoffline.studies.plant_files import PlantFile
from mpcoffline.studies.zoo import Case, Outcome

ROOT = Path(__file__).parents[2]


def outcome(mpc_1: float, learned: float, yardstick: float = np.nan, **more: float | str) -> Outcome:
    difference = {"gain": learned - mpc_1, "gain_error": 0.1, "short": learned - yardstick, "short_error": 0.1}
    row = {"plant": "cart", "seed": 0, "starts": 50} | difference | more
    return Outcome(mpc_1=mpc_1, learned=learned, yardstick=yardstick, **row)  # type: ignore[arg-type]


def test_a_case_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cart.py").write_text(TEXT)
    quick = partial(OfflineMPCLearner, preset="paper", value_n_steps=10, fit_n_steps=5)
    monkeypatch.setattr(zoo, "OfflineMPCLearner", quick)
    told: list[str] = []
    done = zoo.run_case(Case(str(tmp_path / "cart.py"), "cart", 0, 8), told.append)
    assert done.error == ""
    assert done.rows > 20
    assert done.gain == pytest.approx(done.learned - done.mpc_1)
    assert done.short == pytest.approx(done.learned - done.yardstick)
    assert done.gain_error > 0.0
    assert done.fit_s > 0.0
    assert done.yardstick < done.behaviour
    assert done.over_behaviour == pytest.approx(done.learned - done.behaviour)
    assert done.full == done.learned  # the recipe as published has no other candidate
    assert done.candidate == ""
    assert 0.0 <= done.choice_s < done.fit_s
    assert told[0] == "log"
    assert "8 episodes of learned" in told


def test_an_error_is_a_result(tmp_path: Path) -> None:
    (tmp_path / "cart.py").write_text(TEXT.replace("    return _mpc(0.5)", "    return 1 / 0"))
    done = zoo.run_case(Case(str(tmp_path / "cart.py"), "cart", 0, 3))
    assert done.error == "ZeroDivisionError: division by zero"
    assert done.mpc_1 > 0.0
    assert np.isnan(done.learned)


def test_differences_are_paired() -> None:
    costs, others = np.array([1.0, 4.0, 9.0]), np.array([0.0, 2.0, 6.0])
    assert zoo.paired(costs, others) == (2.0, pytest.approx(1.0 / np.sqrt(3.0)))
    assert np.isnan(zoo.paired(costs[:1], others[:1])[1])


def test_warnings_are_heard(tmp_path: Path) -> None:
    said: list[str] = []
    with zoo.heard(said):
        warnings.warn("first", stacklevel=1)
        logging.getLogger("mpcoffline.learning").warning("second %d", 2)
    assert said == ["second 2", "first"]


def test_results_survive_a_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "zoo.csv"
    assert lines.read(path, Outcome) == []
    first, second = outcome(2.0, 1.0, said="a, b\nc"), outcome(-2.0, np.nan, seed=1, error="no")
    lines.append(path, first)
    whole = path.read_bytes()
    lines.append(path, second)
    both = path.read_bytes()
    for size in range(len(whole), len(both)):  # killed while it wrote the second
        path.write_bytes(both[:size])
        lines.append(path, outcome(5.0, 5.0, seed=7))
        seeds = {o.seed for o in lines.read(path, Outcome)}
        assert {0, 7} <= seeds
    path.write_bytes(both)
    lines.append(path, outcome(-2.0, -3.0, seed=1))  # tried again
    found = lines.read(path, Outcome)
    assert [(o.seed, o.mpc_1, o.error) for o in found] == [(0, 2.0, ""), (1, -2.0, "")]
    assert found[0].said == "a, b\nc"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(FileFormatError, match="other columns"):
        lines.read(path, Outcome)


def test_counts_know_no_sign_of_the_cost() -> None:
    rows = [
        outcome(100.0, 90.0, 89.0, seed=0, said="off by 3"),  # better, close, room
        outcome(100.0, 103.0, 90.0, seed=1, said="off by 4.5"),  # worse, far, room
        outcome(-100.0, -103.0, -104.0, seed=2),  # better, close, room
        outcome(-100.0, -97.0, -101.0, seed=3),  # worse, close, no room
        outcome(-100.0, -99.0, seed=4),  # no yardstick
        outcome(1.0, np.nan, seed=5, gain=np.nan),  # no cost
        outcome(1.0, 9.0, seed=6, error="x"),
    ]
    counts = zoo_page.summarised(rows)
    assert counts.cases == 6
    assert [o.seed for o in counts.worse] == [1, 3, 5]
    assert (counts.yardsticks, counts.close, counts.room, counts.better) == (4, 3, 3, 2)
    page = zoo_page.report(rows)
    assert "**3 of 6**; cart 1 (+3 +- 0.1); cart 3 (+3 +- 0.1); cart 5" in page
    assert "**3 of 4**" in page
    assert "**2 of 3**" in page
    assert page.endswith(
        "## What the learner said\n\nWhere it is the same but for numbers, for the first seed.\n\n* cart 0: off by 3\n"
    )
    assert "Failed: cart 6: x" in page


def test_violations_have_their_columns_and_counts() -> None:
    """Only where a plant has limits."""
    assert "limit" not in zoo_page.report([outcome(100.0, 90.0)])
    limits: dict[str, Any] = {"over_mpc_1": 0.02, "over_yardstick": 0.0, "more_over_error": 0.004}
    more = outcome(100.0, 90.0, seed=1, over_learned=0.03, more_over=0.01, **limits)
    fewer = outcome(100.0, 90.0, seed=2, over_learned=0.01, more_over=-0.01, **limits)
    unsure = outcome(100.0, 90.0, seed=3, over_learned=0.025, more_over=0.005, **limits)
    page = zoo_page.report([more, fewer, unsure, outcome(100.0, 90.0, seed=4)])
    assert "beyond two standard errors: **1 of 3** with limits (cart 1)" in page
    assert "| 2.0%/0.0%/3.0% | +1 +- 0.4 % |" in page
    assert "| -/-/- | - |" in page


def test_verdicts_are_counted_against_the_truth() -> None:
    def judged(learned: float, full: float, seed: int, verdict: str, full_verdict: str, **more: Any) -> Outcome:
        known = {
            "behaviour": 110.0, "over_behaviour": learned - 110.0, "full_over_behaviour": full - 110.0,
            "full": full, "full_gain": full - 100.0, "candidate": "identified", "verdict": verdict,
            "full_verdict": full_verdict, "reason": "why", "warned": 0.0, "full_warned": 1.0, "fit_s": 20.0,
            "choice_s": 5.0, "verdict_s": 3.0,
        }  # fmt: skip
        return outcome(100.0, learned, seed=seed, **(known | more))

    rows = [
        judged(50.0, 120.0, 0, "recommend", "keep MPC_1", expected=52.0, from_log=50.0, lowest=45.0, highest=60.0),
        judged(
            90.0,
            90.0,
            1,
            "try with care",
            "recommend",
            expected=80.0,
            from_log=90.0,
            lowest=70.0,
            highest=85.0,
        ),
        judged(105.0, 130.0, 2, "recommend", "recommend"),
        judged(120.0, 99.0, 3, "keep MPC_1", "keep MPC_1", warned=1.0),
        judged(
            95.0, 95.0, 4, "try with care", "keep MPC_1", behaviour=96.0, over_behaviour=-1.0, full_over_behaviour=-1.0
        ),
    ]
    page = zoo_page.report(rows)
    assert (
        "Recommended, but worse than MPC_1 by more than 2 %: handed out **1** (cart 2), whole fit **1** (cart 2)"
        in page
    )
    assert "MPC_1 by more than 2 % and recommended: handed out **1 of 3**, whole fit **1 of 2**" in page
    assert "more than 2 %, too, and recommended: handed out **1 of 2**, whole fit **1 of 1**" in page  # without cart 4
    assert "worse than the controllers of the log by more than 2 %: handed out **0**, whole fit **1** (cart 2)" in page
    assert "and the verdict says so: handed out **1 of 1**, whole fit **2 of 2**" in page
    assert "median deviation **7.6%**" in page
    assert "within the report's own band 1 of 2" in page
    assert "worse than MPC_1 by more than 2 % in 2 of 5; better in 2, what was handed out in 3" in page
    assert "verdict 3 to 3 (median 3); with fit 23 to 23" in page
    assert "52 (45 to 60)" in page
    assert "recommend: why" in page


def test_a_whole_fit_is_what_the_learner_would_have_handed_out(tmp_path: Path) -> None:
    (tmp_path / "cart.py").write_text(TEXT)
    nominal = PlantFile.load(tmp_path / "cart.py").module.mpc(0)
    learner = OfflineMPCLearner(nominal)
    assert zoo.taking(learner, "full") is learner
    learner._mpc, full = nominal, nominal.replace(horizon=3)
    learner.candidates = Candidates({"MPC_1": nominal, "full": full}, "MPC_1")
    other = zoo.taking(learner, "full")
    assert other.mpc is other.policy.mpc is full
    assert other.candidate == "full"
    assert learner.mpc is nominal


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script as a module."""
    monkeypatch.setattr(sys, "prefix", str(ROOT / ".venv"))  # else it would start itself anew there
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = SourceFileLoader("bench_zoo", str(ROOT / "scripts" / "bench_zoo"))
    spec = spec_from_loader("bench_zoo", loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_the_script_skips_what_is_done_and_what_cannot_be(
    bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cart.py").write_text(TEXT)
    (tmp_path / "other.py").write_text("import no_such_package_here\n" + TEXT)
    out, page = tmp_path / "zoo.csv", tmp_path / "pages" / "zoo.md"
    lines.append(out, outcome(2.0, 1.0, 1.0))
    done: list[Case] = []

    def run_case(case: Case, tell: object) -> Outcome:
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(case)
        return outcome(1.0, 2.0, 1.0, seed=case.seed)

    monkeypatch.setattr(bench.zoo, "run_case", run_case)
    command = ["bench_zoo", str(tmp_path), "--seeds", "0", "1", "2", "--out", str(out), "--table", str(page)]
    monkeypatch.setattr(sys, "argv", command)
    assert bench.main() == 130
    assert [case.seed for case in done] == [1]
    printed = capsys.readouterr()
    assert "Left out. other: expected no_such_package_here to be installed" in printed.out
    assert "2 cases to do; 1 are in" in printed.out
    assert "what was done is in" in printed.err
    done.clear()
    assert bench.main() == 0
    assert [case.seed for case in done] == [2]
    assert "**2 of 3**" in page.read_text()
    monkeypatch.setattr(sys, "argv", [*command, "--plants", "card"])
    assert bench.main() == 2
    assert "Did you mean 'cart'" in capsys.readouterr().err
