"""Which jobs there are and in which order; what comes of one; and that a run goes on where it was stopped."""

from __future__ import annotations

import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plant_file import TEXT

from mpcoffline import MPCPolicy
from mpcoffline.studies import lines
from mpcoffline.studies.field.arenas import arena_of, whole_episodes
from mpcoffline.studies.field.controllers import run_job
from mpcoffline.studies.field.jobs import ALGORITHMS, SEARCHED, Job, Outcome, jobs_of

ROOT = Path(__file__).parents[3]
ARENAS = {"pendulum": "", "cart": "/somewhere/cart.py"}


def test_what_is_worth_most_comes_first() -> None:
    jobs = jobs_of(ARENAS, ALGORITHMS, [1_000, 5_000, 50_000], [0, 1], 30, 20_000)
    assert len({job.key for job in jobs}) == len(jobs)
    searched = [job for job in jobs if job.algorithm in SEARCHED]
    assert {(job.size, job.seed) for job in searched} <= {(5_000, 0)}
    rest = [job for job in jobs if job.algorithm not in SEARCHED and job.algorithm != "cql"]
    assert jobs[: len(rest)] == rest  # CQL and searches wait for all others
    assert [job.seed for job in rest] == sorted(job.seed for job in rest)
    first = [job for job in rest if job.seed == 0]
    assert [bool(job.path) for job in first] == sorted(bool(job.path) for job in first)
    assert {job.size for job in jobs if not ALGORITHMS[job.algorithm].needs_log} == {0}
    assert max(job.size for job in jobs if job.algorithm == "iql") == 5_000
    assert {job.steps for job in jobs if ALGORITHMS[job.algorithm].peer} == {20_000}
    assert {job.steps for job in jobs if not ALGORITHMS[job.algorithm].peer} == {0}


@pytest.fixture
def cart(tmp_path: Path) -> str:
    (tmp_path / "cart.py").write_text(TEXT)
    return str(tmp_path / "cart.py")


def test_logs_are_of_whole_episodes_and_no_more_than_needed(cart: str) -> None:
    arena = arena_of("cart", cart)
    small, large = arena.log(15, 3), arena.log(200, 3)
    for table, size in ((small, 15), (large, 200)):
        _, firsts, _ = table.episodes
        assert firsts[-1] < size <= len(table)
    np.testing.assert_array_equal(large.rows[: len(small)], small.rows)
    some = whole_episodes(large, 40, np.random.default_rng(0))
    ids, firsts, lengths = some.episodes
    assert len(some) >= 40 > len(some) - lengths.max()
    for each, length in zip(ids, lengths, strict=True):
        assert length == (large.episode_ids == each).sum()
    assert len(whole_episodes(large, 10**6, np.random.default_rng(0))) == len(large)


def test_discounted_costs_are_those_of_a_loop_by_hand(cart: str) -> None:
    arena = arena_of("cart", cart)
    truth = arena.truth()
    assert truth is not None
    policy, module = MPCPolicy(truth), arena._plant.module  # type: ignore[attr-defined]
    plant, state, total = module.Plant(), None, 0.0
    y = plant.reset(np.random.default_rng([902, 0]))
    for k in range(module.STEPS):
        u, state = policy.predict(y, state=state, episode_start=np.array([k == 0]))
        y, cost, ended = plant.step(u)
        total += 0.9**k * cost
        if ended:
            break
    assert arena.loops(policy, 2, 1).discounted[0] == pytest.approx(total, rel=1e-5)


def test_a_job_is_measured(cart: str) -> None:
    made = run_job(Job("cart", cart, "identified", 60, 0, 8, 0))
    best = run_job(Job("cart", cart, "truth", 0, 0, 8, 0))
    assert (made.error, best.error) == ("", "")
    assert made.rows >= 60 > best.rows == 0
    assert made.cost == pytest.approx(best.cost, rel=0.2)  # the gain is all that was wrong
    assert made.train_s >= 0.0 < made.latency_ms
    assert made.file_kb > 0.1
    assert np.isnan(made.violated)
    log = run_job(Job("cart", cart, "behaviour", 0, 0, 8, 0))
    assert best.cost < log.cost


def test_an_error_is_a_result(cart: str) -> None:
    done = run_job(Job("cart", cart, "bc", 60, 0, 8, 100))
    assert done.error == "PeerError: bc: expected an environment of the peers, got none."
    assert done.rows >= 60


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script as a module."""
    monkeypatch.setattr(sys, "prefix", str(ROOT / ".venv"))  # else it would start itself anew there
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = SourceFileLoader("bench_field", str(ROOT / "scripts" / "bench_field"))
    spec = spec_from_loader("bench_field", loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_a_run_goes_on_where_it_was_stopped(
    bench: Any, cart: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[Job] = []

    def run(job: Job, peers: object) -> Outcome:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(job)
        return Outcome(*job.key, rows=job.size, cost=1.0 + job.size, cost_error=0.1, error="" if job.size else "bad")

    monkeypatch.setattr(bench, "run_job", run)
    monkeypatch.setattr("mpcoffline.studies.field.picture.write", lambda *_: [])
    out, page = tmp_path / "field.csv", tmp_path / "field.md"
    command = ["bench_field", str(tmp_path), "--plants", "cart", "--sizes", "10", "20", "30", "--seeds", "0"]
    command += ["--algorithms", "truth", "identified", "--out", str(out), "--page", str(page)]
    monkeypatch.setattr(sys, "argv", command)
    assert bench.main() == 130
    assert "4 jobs to do; 0 are in" in capsys.readouterr().out
    assert [job.size for job in done] == [0, 10]
    done.clear()
    assert bench.main() == 130  # the one that failed is done again
    assert [job.size for job in done] == [0, 20]
    assert {each.size for each in lines.read(out, Outcome)} == {0, 10, 20}
    monkeypatch.setattr(sys, "argv", [*command, "--jobs", "0"])
    assert bench.main() == 0
    assert "21 +- 0.1" in page.read_text()
    monkeypatch.setattr(sys, "argv", [*command, "--algorithms", "idl"])
    assert bench.main() == 2
    assert "Did you mean 'iql'" in capsys.readouterr().err
