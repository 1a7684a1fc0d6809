"""What a policy applies where a solve was not accepted."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest
from hard_plants import always_applied, closed_loop, heater, kinked, limited, reactor, vehicle
from numpy.typing import NDArray

from mpcoffline import MPC, MPCPolicy, make_solver
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.solvers import SOLVERS, Plan, Solution, Solver
from mpcoffline.solvers.fallback import Fallback, SolverStats

Array = NDArray[np.float64]
LOW, HIGH = -0.5, 0.75


class Scripted(Solver):
    """Answers each problem with constant inputs: ``(input, value, success)`` by whether it is warm."""

    name = "scripted"
    script: Callable[[float, bool], tuple[float, float, bool]]
    calls: list[int]

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        self.calls.append(len(x))
        n, mpc = len(x), self.mpc
        warm = np.zeros(n, dtype=bool) if warm_start is None else warm_start.known
        rows = [type(self).script(float(x[i, 0]), bool(warm[i])) for i in range(n)]
        inputs, value, success = (np.array(column) for column in zip(*rows, strict=True))
        u = np.broadcast_to(inputs[:, None, None], (n, mpc.horizon, mpc.nu)).astype(np.float64)
        states = np.repeat(x[:, None], mpc.horizon + 1, axis=1)
        stats: dict[str, Any] = {"iterations": np.ones(n, dtype=int), "time": 0.0}
        return Solution(u[:, 0].copy(), states, u, value, success, ["word"] * n, stats)


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> MPCPolicy:
    monkeypatch.setitem(SOLVERS._things, "scripted", Scripted)
    monkeypatch.setattr(Scripted, "calls", [], raising=False)
    return MPCPolicy(lq_plant.make_mpc(action_low=[LOW], action_high=[HIGH]), "scripted")


def answering(monkeypatch: pytest.MonkeyPatch, script: Callable[[float, bool], tuple[float, float, bool]]) -> None:
    monkeypatch.setattr(Scripted, "script", staticmethod(script), raising=False)


def answers(stats: SolverStats) -> dict[str, int]:
    assert sum(stats.answers.values()) == stats.n_failures
    return {name: count for name, count in stats.answers.items() if count}


# ---------------------------------------------------------------- the order


def test_the_best_plan_is_applied_by_a_cold_solve_and_clipped(
    scripted: MPCPolicy, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answering(monkeypatch, lambda x, warm: (x, 1.0, False))
    with caplog.at_level(logging.INFO):
        actions, state = scripted.predict([[0.3, 0.0], [2.0, 0.0], [-2.0, 0.0]])
        scripted.predict([[0.3, 0.0]])
    np.testing.assert_allclose(actions[:, 0], [0.3, HIGH, LOW], rtol=1e-6)
    assert state.known.all()
    assert ((state.u >= LOW) & (state.u <= HIGH)).all()
    assert answers(scripted.solver_stats) == {"best_plan": 4}
    told = [r.getMessage() for r in caplog.records if "solved" in r.getMessage()]
    assert told == ["An MPC was not solved (word): applying the best plan found."]


@pytest.mark.parametrize(("level", "n"), [(logging.WARNING, 1), (logging.INFO, 0)])
def test_what_a_simulated_controller_cannot_solve_is_no_warning(
    level: int, n: int, scripted: MPCPolicy, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answering(monkeypatch, lambda x, warm: (x, 1.0, False))
    scripted.retry_at_most(1.0, level)
    with caplog.at_level(logging.WARNING):
        scripted.predict([[0.3, 0.0]])
    assert sum("was not solved" in record.getMessage() for record in caplog.records) == n
    assert answers(scripted.solver_stats) == {"best_plan": 1}


def test_a_warm_failure_is_tried_once_from_all_starts_and_it_alone(
    scripted: MPCPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, lambda x, warm: (x, 1.0, True))
    _, state = scripted.predict([[0.1, 0.0], [0.2, 0.0], [0.3, 0.0]])
    answering(monkeypatch, lambda x, warm: (0.6, 1.0, True) if not warm else (x, 1.0, x != 0.2))
    Scripted.calls.clear()
    actions, _ = scripted.predict([[0.1, 0.0], [0.2, 0.0], [0.3, 0.0]], state)
    assert Scripted.calls == [3, 1]
    np.testing.assert_allclose(actions[:, 0], [0.1, 0.6, 0.3], rtol=1e-6)
    assert answers(scripted.solver_stats) == {"retried": 1}


def test_an_mpc_whose_solves_fail_again_and_again_is_retried_for_a_part(
    scripted: MPCPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mpcoffline.solvers.fallback._ANYHOW", 4)
    scripted.retry_at_most(0.25)
    answering(monkeypatch, lambda x, warm: (x, 1.0, not warm))
    state, tried = None, []
    for _ in range(7):
        Scripted.calls.clear()
        _, state = scripted.predict([[0.1, 0.0], [0.2, 0.0]], state)
        tried.append(list(Scripted.calls))
    # Two are tried again as long as no more than 4 and a quarter of 2, 4, 6, ... problems have been before.
    assert tried == [[2], [2, 2], [2, 2], [2, 2], [2, 2], [2], [2]]
    assert scripted.solver_stats.n_retried == 8
    assert scripted.solver_stats.n_best_plan == 4
    with pytest.raises(InvalidArgumentError, match="share"):
        scripted.retry_at_most(1.5)


@pytest.mark.parametrize(
    ("warm_value", "cold_value", "expected"),
    [(1.0, 2.0, 0.2), (2.0, 1.0, 0.6), (np.nan, 5.0, 0.6), (5.0, np.inf, 0.2), (-3.0, -2.0, 0.2)],
)
def test_of_two_plans_that_are_not_accepted_the_cheaper_is_applied(
    scripted: MPCPolicy, monkeypatch: pytest.MonkeyPatch, warm_value: float, cold_value: float, expected: float
) -> None:
    answering(monkeypatch, lambda x, warm: (0.1, 1.0, True))
    _, state = scripted.predict([[1.0, 0.0]])
    answering(monkeypatch, lambda x, warm: (0.2, warm_value, False) if warm else (0.6, cold_value, False))
    actions, _ = scripted.predict([[1.0, 0.0]], state)
    np.testing.assert_allclose(actions, [[expected]], rtol=1e-6)
    assert answers(scripted.solver_stats) == {"best_plan": 1}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_never_applied(scripted: MPCPolicy, monkeypatch: pytest.MonkeyPatch, bad: float) -> None:
    for script in (lambda x, warm: (bad, 1.0, False), lambda x, warm: (0.3, bad, False)):
        answering(monkeypatch, lambda x, warm: (0.1, 1.0, True))
        _, state = scripted.predict([[1.0, 0.0]])
        answering(monkeypatch, script)
        cold, nothing = scripted.predict([[1.0, 0.0]])
        assert (cold == 0.0).all()
        assert not nothing.known.any()
        warm, plan = scripted.predict([[1.0, 0.0]], state)
        np.testing.assert_allclose(warm, [[0.1]], rtol=1e-6)
        assert plan.known.all()
    assert answers(scripted.solver_stats) == {"previous_plan": 2, "zero": 2}


def test_the_counts_are_said_in_words() -> None:
    stats = SolverStats(n_solves=200, n_failures=3, n_retried=1, n_best_plan=2)
    assert stats.failures == "3 of 200 (1.5 %): 1 solved from all starts, 2 by the best plan found"
    assert SolverStats(n_solves=7).failures == "0 of 7"


# ---------------------------------------------------------------- closed loops of hard plants


@pytest.mark.parametrize(
    ("mpc", "start", "at_most"),
    [
        (reactor(), [0.5, 0.2], -36.75),
        (reactor(0.001), [0.5, 0.2], -36.3),
        (vehicle(), [1.0, 0.5, 0.0, 0.0], 18.17),
        (vehicle("hypot"), [1.0, 0.5, 0.0, 0.0], 18.17),
    ],
)
def test_singular_and_flat_problems_are_solved(mpc: MPC, start: list[float], at_most: float) -> None:
    """``at_most``: ipopt's closed loops, rounded up."""
    policy = MPCPolicy(mpc)
    assert policy.solver.name == "ddp"
    assert closed_loop(policy, start) <= at_most
    assert policy.solver_stats.n_failures == 0


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_bound_that_can_not_be_kept_at_the_start_does_not_stop_control(unit: float) -> None:
    policy = MPCPolicy(limited(unit))
    assert closed_loop(policy, [1.0 * unit, 0.9 * unit]) < 56.8
    found = answers(policy.solver_stats)
    assert set(found) == {"best_plan"}
    assert found["best_plan"] < 10  # once the speed is legal again, all is solved


@pytest.mark.slow
def test_kinks_cost_no_more_than_applying_whatever_is_found() -> None:
    policy = MPCPolicy(kinked())
    cost = closed_loop(policy, [3.0, -2.0])
    assert not answers(policy.solver_stats)  # all are solved, with the corners rounded
    assert cost <= 1.001 * always_applied(policy, [3.0, -2.0])


@pytest.mark.slow
def test_a_kink_on_the_input_bound_costs_little() -> None:
    smooth, kink = (closed_loop(MPCPolicy(heater(k)), [1.5, 0.1], 100) for k in (False, True))
    assert kink <= 1.1 * smooth


def test_what_ddp_returns_unaccepted_is_the_model_run_within_the_bounds() -> None:
    mpc = kinked()
    x = np.random.default_rng(0).normal(size=(60, 2)) * 2.0
    solution = make_solver(mpc, "ddp", max_iterations=1).solve(x)
    failed = ~solution.success
    assert failed.any()
    assert np.isfinite(solution.value).all()
    assert (np.abs(solution.u) <= 1.0).all()
    states = x
    for k in range(mpc.horizon):
        states = np.stack([mpc.model(s, u) for s, u in zip(states, solution.u[:, k], strict=True)])
        np.testing.assert_allclose(solution.x[:, k + 1], states, rtol=1e-9, atol=1e-12)
    assert {solution.status[i] for i in np.flatnonzero(failed)} <= {"stalled", "iteration limit"}


# ---------------------------------------------------------------- the rescue


def hurried(**options: Any) -> MPCPolicy:
    """A policy whose ddp solver has no time to converge."""
    return MPCPolicy(heater(kink=False), max_iterations=1, **options)


def test_the_rescue_solves_what_ddp_did_not(caplog: pytest.LogCaptureFixture) -> None:
    plain, rescued = hurried(), hurried(rescue="ipopt", rescue_time=20.0)
    x = np.random.default_rng(0).uniform(0.3, 0.6, size=(3, 2))
    plain.predict(x)
    n = plain.solver_stats.n_failures
    assert n > 1
    assert answers(plain.solver_stats) == {"best_plan": n}
    with caplog.at_level(logging.WARNING):
        actions, _ = rescued.predict(x)
    assert answers(rescued.solver_stats) == {"rescued": n}
    np.testing.assert_allclose(actions, make_solver(heater(kink=False), "ipopt").solve(x).u0, atol=1e-3)
    assert "An MPC was not solved (iteration limit): solved by ipopt." in caplog.text


def test_the_rescue_obeys_its_time_and_the_best_plan_is_applied() -> None:
    policy = hurried(rescue="ipopt", rescue_time=1e-6)
    actions, _ = policy.predict([0.5, 0.2])
    np.testing.assert_array_equal(actions, hurried().predict([0.5, 0.2])[0])
    assert answers(policy.solver_stats) == {"best_plan": 1}


def test_the_rescue_is_saved_and_pickled(tmp_path: Path) -> None:
    policy = hurried(rescue="ipopt", rescue_time=20.0)
    policy.predict([0.5, 0.2])
    policy.save(tmp_path / "policy.zip")
    for copy in (MPCPolicy.load(tmp_path / "policy.zip"), pickle.loads(pickle.dumps(policy))):
        before = copy.solver_stats.n_rescued
        copy.predict([0.5, 0.2])
        assert copy.solver_stats.n_rescued == before + 1


def test_other_rescues_and_times_are_refused() -> None:
    with pytest.raises(UnknownIdError, match="rescue"):
        MPCPolicy(heater(kink=False), rescue="ipop")
    for time in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InvalidArgumentError, match="rescue_time"):
            Fallback(heater(kink=False), "ipopt", time)
