"""Candidates take as many substeps as their own plans ask for."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpcoffline import MPC, Model, Parameter, QuadraticCost, TransitionTable
from mpcoffline.core.types import Array
from mpcoffline.estimation import identify
from mpcoffline.learner.fineness import fine_enough
from mpcoffline.learning import Known
from mpcoffline.mpc.integrators import Scheme
from mpcoffline.simulation.quick import quick_policy

DT = 0.1


def cubic(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    """Slow near rest; at x = 4 its time constant, 1/48, is a fifth of a step."""
    return -p["k"] * x**3 + u


def truly(x: float, u: float) -> float:
    """The state a step later, by an implicit scheme of order 5."""
    found = solve_ivp(lambda _, y: -(y**3) + u, (0.0, DT), [x], method="Radau", rtol=1e-9, atol=1e-11)
    return float(found.y[0, -1])


def make_mpc(goal: float, integrator: str = "auto") -> MPC:
    model = Model(cubic, 1, 1, DT, {"k": Parameter(1.0, low=0.5, high=2.0)}, integrator=integrator)
    cost = QuadraticCost([[1.0]], [[1e-6]], x_ref=[goal], u_ref=[goal**3])
    return MPC(model, cost, QuadraticCost([[1.0]], x_ref=[goal]), 8, 0.95, [-100.0], [100.0])


def make_log() -> TransitionTable:
    """Of six episodes near rest."""
    rng, rows = np.random.default_rng(0), []
    for episode in range(6):
        x = rng.uniform(-0.3, 0.3)
        for _ in range(20):
            u = rng.uniform(-0.5, 0.5)
            reached = truly(x, u)
            rows.append((x, u, x * x, reached, episode))
            x = reached
    x_, u_, cost, reached_, ids = (np.array(column) for column in zip(*rows, strict=True))
    return TransitionTable.from_arrays(x_[:, None], u_[:, None], cost, reached_[:, None], 0.0 * x_, ids)


LOG = make_log()


def known_of(mpc: MPC) -> Known:
    suited = mpc.replace(model=mpc.model.suited_to_log(LOG))
    return Known(suited, LOG, found=identify(suited, LOG))


def off(mpc: MPC) -> float:
    """By how much a step of its plans from the log misses the truth at most, in parts of the step and of the log's."""
    plans = quick_policy(mpc).solver.solve(np.array([[-0.2], [0.0], [0.2]]))
    scale = float((LOG.values().next_observations - LOG.values().observations).std())

    def missed(x: Array, u: Array) -> list[float]:
        reached = [truly(float(x[k, 0]), float(u[k, 0])) for k in range(len(u))]
        return [abs(r - x[k + 1, 0]) / (scale + abs(r - x[k, 0])) for k, r in enumerate(reached)]

    return max(max(missed(x, u)) for x, u in zip(plans.x, plans.u, strict=True))


def test_plans_that_go_farther_than_the_log_are_integrated_as_they_ask_for() -> None:
    known = known_of(make_mpc(4.0))
    assert known.mpc.model.scheme == Scheme("rk4", 1)
    assert off(known.mpc) > 0.4  # twice what may be: the planner believes in what is not there
    more, between = fine_enough(known, {"identified": known.mpc}, LOG)
    assert more.found is not None
    models = [more.mpc.model, more.found.model, between["identified"].model]
    assert len({str(model.scheme) for model in models}) == 1  # one for all: they are compared
    assert more.mpc.model.scheme is not None
    assert 1 < more.mpc.model.scheme.substeps <= 16
    assert off(more.mpc) < 0.2
    assert more.mpc.theta == pytest.approx(known.mpc.theta)


def test_plans_where_the_log_was_ask_for_no_more() -> None:
    known = known_of(make_mpc(0.1))
    more, between = fine_enough(known, {"identified": known.mpc}, LOG)
    assert more.mpc is known.mpc
    assert between["identified"] is known.mpc


def test_who_says_how_a_model_is_integrated_is_obeyed() -> None:
    known = known_of(make_mpc(4.0, "rk4"))
    more, _ = fine_enough(known, {}, LOG)
    assert more.mpc is known.mpc
