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
