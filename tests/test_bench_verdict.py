"""scripts/bench_verdict: what its cases share, and when its page is written."""

from __future__ import annotations

import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script as a module."""
    monkeypatch.setattr(sys, "prefix", str(ROOT / ".venv"))  # else it would start itself anew there
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = SourceFileLoader("bench_verdict", str(ROOT / "scripts" / "bench_verdict"))
    spec = spec_from_loader("bench_verdict", loader)
    assert spec is not None
    module = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "bench_verdict", module)
    loader.exec_module(module)
    return module


@pytest.mark.parametrize("data", ["log", "first 1000", "noise 5 %"])
@pytest.mark.usefixtures("shipped")
def test_cases_share_v_where_their_rows_are_the_same(bench: Any, monkeypatch: pytest.MonkeyPatch, data: str) -> None:
    monkeypatch.setattr(bench, "fit_value", lambda *arguments, **options: object())
    first, second = (bench.Case("pendulum", 1.0, data, bench.QUADRATIC, seed) for seed in (0, 1))
    tables = [bench.log_of(case) for case in (first, second)]
    same_rows = np.array_equal(tables[0].rows, tables[1].rows)
    values = [bench.value_function(case, table, 0.95) for case, table in zip((first, second), tables, strict=True)]
    assert (values[0] is values[1]) == same_rows == (data == "first 1000")


def test_the_page_is_written_once_it_is_whole(
    bench: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "report_of", lambda results: [f"{len(results)} cases"])
    page = tmp_path / "verdict.md"
    page.write_text("before")
    results = [{"case": case.name} for seed in (0, 1, 2, 3) for case in bench.cases(seed)]
    bench.publish(results[:-1], page)
    assert page.read_text() == "before"
    assert f"1 cases are missing, the first {results[-1]['case']!r}" in capsys.readouterr().out
    bench.publish(results, page)
    assert page.read_text() == f"{len(results)} cases\n"


def judged(cost: float, verdict: str, simulated: float, expected: tuple[float, float, float]) -> dict[str, Any]:
    return {
        "name": "some fit", "verdict": verdict, "reasons": ["why"], "cost": cost, "from_log": cost + 1.0,
        "gain": cost - 100.0, "gain_error": 1.0, "simulated": simulated, "expected": list(expected),
        "worse_than_today": cost > 120.0,
    }  # fmt: skip


def test_the_page_counts_what_must_not_be(bench: Any) -> None:
    rest = {
        "mpc_1": 100.0, "today": 110.0, "fit_error": 0.1, "one_step": {"learned": 0.1}, "outside": 0.0, "growth": 1.0,
        "seconds": {"fit": 10.0, "diagnose": 5.0},
    }  # fmt: skip
    good, bad = (
        judged(50.0, "recommend", -48.0, (45.0, 52.0, 60.0)),
        judged(130.0, "recommend", -5.0, (90.0, 95.0, 99.0)),
    )
    kept = judged(100.0, "keep MPC_1", 0.0, (90.0, 100.0, 110.0))
    results = [
        {"case": "pendulum 1 log default 0", "seed": 0, "handed out": good, **rest},
        {"case": "pendulum 1 log default 2", "seed": 2, "handed out": kept, "full": bad, **rest},
    ]
    page = "\n".join(bench.report_of(results))
    assert "| worse than MPC_1 | 0 of 2 | 1 of 2 |" in page
    assert "| recommended, but worse than MPC_1 | 0 | 1; pendulum 1 log default 2 |" in page
    assert "| better than MPC_1 and recommended | 1 of 1 | 1 of 1 |" in page
    assert "| worse than the logged controller, and told | 0 of 0 | 1 of 1 |" in page
    assert "| true cost within the report's band | 2 of 2 | 1 of 2 |" in page
    assert (
        "| pendulum 1 log default 2 | 110 | 100 | some fit | 100 | 101 | 100 (90 to 110) | keep MPC_1 | 130"
        " | recommend |" in page
    )
