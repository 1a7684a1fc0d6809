"""Each note where it is true, and where it must be silent."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import casadi as ca
import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes
from lq_plant import QuadraticValue
from numpy.typing import NDArray

from mpcoffline import MPC, Model, QuadraticCost, Signal, TransitionTable
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.diagnostics.limits import LimitCheck
from mpcoffline.diagnostics.measures import GoalCheck, ValueCheck, goal_check, value_check
from mpcoffline.diagnostics.notes import Fit, notes_on
from mpcoffline.diagnostics.report import PredictionCheck, Report
from mpcoffline.diagnostics.stability import (
    TheoremCheck,
    WeightCheck,
    closed_loop_eigenvalues,
    leaves_reference,
    weight_checks,
)
from mpcoffline.diagnostics.travel import Travel
from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.solvers import make_solver

Array = NDArray[np.float64]

FIT = Fit(smoothed=True, model=True, value=True)
QUIET = NoiseEstimate(np.zeros(2), np.zeros(2), np.ones(2), "repeated")


def notes(fit: Fit = FIT, **changes: Any) -> tuple[str, ...]:
    """Of a report without a fault, but for some changes."""
    report = {
        "goal": GoalCheck(0.2, False),
        "noise": QUIET,
        "failed_solves": (0.0, 0.0),
        "value": ValueCheck(100, 0.9, 0.0, 0.0, 0.9),
        "prediction": PredictionCheck(0.5, 0.1, 0.1, ()),
        "at_bounds": (),
        "limits": (LimitCheck("level", "hard", (0.0, 0.0, 0.04), (0.0, 0.0, 0.1), False),),
        "travel": (Travel("valve", (0.01, 0.05, 0.028), held=False),),
        "theorem": TheoremCheck(1.0, 0.0, (0.9, 0.2)),
        "weights": (WeightCheck("W", (0.1, 1.0), (0.1, 1.0)),),
    }
    return notes_on(cast("Report", SimpleNamespace(**(report | changes))), fit)


def test_nothing_is_said_of_a_report_without_a_fault() -> None:
    assert notes() == ()


def test_inputs_that_travel_much_farther_than_before_are_named() -> None:
    """Not where that is little of their range, where it is priced, or where the log has no two steps in a row."""
    (said,) = notes(
        travel=(Travel("valve", (0.01, 0.05, 0.031), held=False), Travel("pump", (0.1, 0.1, 0.1), held=False))
    )
    assert "valve by 3.1% of its range a step (1.0% in the log)" in said
    assert "pump" not in said
    assert "changes={name: weight}" in said
    little, priced, unknown = (0.001, 0.004, 0.0049), (0.01, 0.05, 0.1), (float("nan"), 0.05, 0.1)
    assert notes(travel=(Travel("valve", little, held=False),)) == ()
    assert notes(travel=(Travel("valve", priced, held=True),)) == ()
    assert notes(travel=(Travel("valve", unknown, held=False),)) == ()
    assert notes(Fit(True, True, True, learned=False), travel=(Travel("valve", priced, held=False),)) == ()


def test_a_plan_that_lives_beyond_its_limits_is_offered_a_margin() -> None:
    """Also where MPC_1 violates them as often, so that the verdict says nothing of it."""
    limits = [
        LimitCheck(name, "l1 = 50", (0.1, 0.8, share), (1, 2, 2), False) for name, share in (("p", 0.3), ("c", 0))
    ]
    (said,) = notes(limits=limits)
    assert said.startswith("The learned MPC violates 'p' in 30% of its steps")
    assert "--keep-limits" in said
    assert notes(Fit(smoothed=True, model=True, value=True, learned=False), limits=limits) == ()


def log_of(states: Array, nu: int = 1) -> TransitionTable:
    n = len(states)
    rng = np.random.default_rng(1)
    return TransitionTable.from_arrays(states, rng.normal(size=(n, nu)), rng.random(n), states, np.zeros(n))


def mpc_of(nx: int, W: Any, signals: tuple[Signal, ...] = (), **cost: Any) -> MPC:
    """Of integrators."""

    def step(x: ca.SX, u: ca.SX, p: Any, *d: Any) -> ca.SX:
        return 0.9 * x + 0.1 * u[0]

    model = Model(step, nx, 1, 1.0, discrete=True, signals=signals)
    return MPC(model, QuadraticCost(W, [[1.0]], **cost), QuadraticCost(np.eye(nx)), 5, 0.9, [-1.0], [1.0])


# ---------------------------------------------------------------- the goal


def missed(mpc: MPC, states: Array) -> bool:
    found = goal_check(mpc, log_of(states))
    assert found is not None
    return found.missed


def test_a_moving_set_point_among_the_states_is_a_goal_where_the_difference_is() -> None:
    """The set-point in the observation, W with -1; temperature, level and set-point go far from any fixed point."""
    rng = np.random.default_rng(0)
    set_point, level = 40.0 + rng.uniform(-15.0, 15.0, 3_000), rng.uniform(1.0, 2.0, 3_000)
    W = [[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]]
    follows = np.stack([set_point + rng.normal(0.0, 0.3, 3_000), level, set_point], axis=1)
    below = follows - np.array([8.0, 0.0, 0.0])
    assert not missed(mpc_of(3, W), follows)
    assert missed(mpc_of(3, W), below)


def test_a_signal_that_is_tracked_is_the_goal() -> None:
    rng = np.random.default_rng(0)
    set_point = rng.choice([20.0, 35.0, 50.0], 3_000)
    mpc = mpc_of(1, [[1.0]], (Signal("set_point"),), tracks={0: "set_point"})
    follows = np.stack([set_point + rng.normal(0.0, 0.3, 3_000), set_point], axis=1)
    assert not missed(mpc, follows)
    assert missed(mpc, follows + np.array([5.0, 0.0]))


def test_a_log_around_the_goal_reaches_it_in_many_dimensions() -> None:
    """Of eight normal coordinates hardly one row has all of them within a quarter of a spread."""
    states = np.random.default_rng(0).normal(size=(4_000, 8))
    found = goal_check(mpc_of(8, np.eye(8)), log_of(states))
    assert found is not None
    assert found.share < 1e-3
    assert not found.missed
    assert missed(mpc_of(8, np.eye(8), x_ref=np.full(8, 5.0)), states)


def test_units_of_the_states_change_nothing() -> None:
    states, scale = np.random.default_rng(0).normal(size=(1_000, 2)), np.array([1e-6, 1e4])
    for shift in (0.0, 7.0):
        plain, other = (
            goal_check(mpc_of(2, np.diag(1.0 / s**2), x_ref=shift * s), log_of(states * s)) for s in (np.ones(2), scale)
        )
        assert plain == other


def test_without_a_goal_or_a_use_of_it_nothing_is_said() -> None:
    far = GoalCheck(0.0, True)
    assert any("never reaches the goal" in note for note in notes(goal=far))
    assert notes(Fit(smoothed=True, model=True, value=False), goal=far) == ()
    assert notes(goal=None) == ()


# ---------------------------------------------------------------- stability


class Law:
    """A control law in place of a policy."""

    def __init__(self, mpc: MPC, law: Any) -> None:
        self.mpc, self._law = mpc, law

    def predict(self, y: Array, state: Any = None) -> tuple[Array, Any]:
        return self._law(y), state


@pytest.mark.parametrize(
    ("law", "leaves"),
    [
        (lambda x: 3.0 * x, True),  # x+ = 1.2 x
        (lambda x: 3.0 * x - 30.0 * x**3, False),  # comes to rest at 0.26, a quarter of a spread
        (lambda x: 3.0 * x - 0.3 * x**3, True),  # at 2.6
        (lambda x: -1.0 * x, False),
    ],
)
def test_a_loop_that_settles_near_the_reference_is_not_called_unstable(law: Any, leaves: bool) -> None:
    mpc, states = mpc_of(1, [[1.0]]), np.random.default_rng(0).normal(size=(500, 1))
    assert leaves_reference(cast("MPCPolicy", Law(mpc, law)), log_of(states), np.zeros(1)) == leaves


def test_unstable_is_said_of_loops_that_leave_alone() -> None:
    said = [notes(theorem=TheoremCheck(1.0, 0.0, (2.16, 0.5), leaves)) for leaves in (True, False)]
    assert "unstable at the reference" in said[0][0]
    assert said[1] == ()


def test_signals_are_no_motion_of_the_loop() -> None:
    """Held along the loop, a signal has the eigenvalue 1; the loop's own is that of the same MPC without."""
    rng = np.random.default_rng(0)
    plain, signalled = mpc_of(1, [[1.0]]), mpc_of(1, [[1.0]], (Signal("ambient"),))
    states = rng.normal(size=(500, 2))
    (alone,) = closed_loop_eigenvalues(plain, make_solver(plain), log_of(states[:, :1]), np.zeros(1))
    (beside,) = closed_loop_eigenvalues(signalled, make_solver(signalled), log_of(states), np.zeros(2))
    assert beside == pytest.approx(alone, abs=1e-4)
    assert alone < 0.9
    assert not leaves_reference(MPCPolicy(signalled), log_of(states), np.array([0.0, 1.0]))


# ---------------------------------------------------------------- V


def test_v_is_not_blamed_for_returns_that_the_state_does_not_tell() -> None:
    rng, n = np.random.default_rng(0), 4_000
    s, ids = rng.normal(size=(n, 1)), np.arange(n) // 40
    told, untold = (s**2)[:, 0], rng.exponential(size=n)
    right, wrong = QuadraticValue(np.eye(1)), QuadraticValue(-np.eye(1))
    for costs, value, blind in ((told, right, False), (told, wrong, True), (untold, right, False)):
        table = TransitionTable.from_arrays(s, s, costs, s, np.zeros(n), ids)
        found = value_check(value, table, 0.05)
        assert found.blind == blind
        assert bool(notes(value=found)) == blind


def test_a_v_that_is_not_used_is_not_talked_about() -> None:
    unused = Fit(smoothed=True, model=True, value=False)
    assert notes(unused, value=ValueCheck(100, 0.0, 0.0, 0.0, 0.9)) == ()
    assert notes(unused, theorem=TheoremCheck(9.0, 0.0, ())) == ()
    assert "V grows" in notes(theorem=TheoremCheck(9.0, 0.0, ()))[0]


# ---------------------------------------------------------------- model, bounds, weights, solves


def test_advice_is_what_the_user_can_do() -> None:
    worse = PredictionCheck(0.5, 0.1, 0.5, ())
    assert "prediction_weight" in notes(prediction=worse)[0]
    assert "learn='cost+model'" in notes(Fit(smoothed=True, model=False, value=True), prediction=worse)[0]


def test_long_lists_are_cut() -> None:
    names = tuple(f"model.weights[{i},{j}]" for i in range(20) for j in range(20))
    (open_ones,) = notes(prediction=PredictionCheck(0.5, 0.1, 0.1, names))
    (bounds,) = notes(at_bounds=names)
    assert "and 394 more" in open_ones
    assert "and 394 more" in bounds
    assert max(len(open_ones), len(bounds)) < 400


def test_weights_are_looked_at_in_spreads_of_what_they_weigh() -> None:
    """A state in small units has a large weight: the other has not lost its direction."""
    s = episodes().observations.astype(np.float64) * [1e-5, 1.0]
    before, after = (
        lq_plant.make_mpc(stage_cost=QuadraticCost(np.diag(w), lq_plant.R)) for w in ([1e10, 1.0], [1e10, 0.1])
    )
    lost = lq_plant.make_mpc(stage_cost=QuadraticCost(np.diag([1e10, 0.0]), lq_plant.R))
    assert notes(weights=weight_checks(before, after, log_of(s))) == ()
    assert "lost a direction" in notes(weights=weight_checks(before, lost, log_of(s)))[0]


def test_failed_solves_are_told() -> None:
    assert notes(failed_solves=(0.005, 0.0)) == ()
    first, second = notes(failed_solves=(0.05, 0.28))
    assert first.startswith("5.0% of the problems of MPC_1")
    assert second.startswith("28.0% of the problems of the learned MPC")


def test_where_mpc_1_is_handed_out_nothing_is_said_of_a_learned_one() -> None:
    kept = Fit(smoothed=True, model=True, value=True, learned=False)
    faults = {
        "prediction": PredictionCheck(0.5, 0.1, 0.5, ()), "theorem": TheoremCheck(9.0, 0.0, (2.0,), True),
        "failed_solves": (0.0, 0.2),
    }  # fmt: skip
    assert len(notes(**faults)) == 4
    assert notes(kept, **faults) == ()
