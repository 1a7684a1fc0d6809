"""Learning beside signals: no model predicts them, those of the log stand in targets, and closed loops replay them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import torch
from scipy.integrate import solve_ivp

from mpcoffline import MPC, Model, MPCPolicy, OfflineMPCLearner, Parameter, QuadraticCost, Signal, TransitionTable
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.estimation import find_delays, identify
from mpcoffline.learning import Bellman, ParameterConfig, StartConfig, TerminalConfig, ValueConfig
from mpcoffline.learning.bellman.equation import BellmanProblem
from mpcoffline.simulation.starts import signals_along


def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
    return p["decay"] * x + p["gain"] * u + p["share"] * d.inflow


def make_mpc(delay: int | None = 2) -> MPC:
    parameters = {
        name: Parameter(value, low=0.01, high=3.0) for name, value in {"decay": 0.7, "gain": 0.8, "share": 0.1}.items()
    }
    signals = [Signal("set_point", preview=1), Signal("inflow")]
    model = Model(step, 1, 1, 1.0, parameters, discrete=True, delay=delay, signals=signals)
    tracks = {0: "set_point"}
    end = QuadraticCost([[3.0]], tracks=tracks)
    return MPC(model, QuadraticCost([[1.0]], [[0.1]], tracks=tracks), end, 10, 0.9, [-2.0], [2.0])


def make_log(delay: int = 2, n_episodes: int = 25, length: int = 40) -> TransitionTable:
    """x+ = 0.9 x + 0.5 u[k-2] + 0.3 inflow, under a controller that follows a set-point which jumps."""
    rng, parts = np.random.default_rng(0), []
    for e in range(n_episodes):
        jumps = rng.uniform(-1.0, 1.0, length // 10 + 1)
        set_points, inflow = np.repeat(jumps, 10), rng.normal(size=length + 1).cumsum() * 0.2
        x, past, y = rng.normal(), [0.0] * delay, []
        for k in range(length + 1):
            y.append([x, set_points[k], set_points[min(k + 1, length)], inflow[k]])
            u = float(np.clip(0.5 * (set_points[k] - x) + 0.4 * rng.normal(), -2.0, 2.0))
            past.append(u)
            if k < length:
                parts.append((y[-1], [u], (x - set_points[k]) ** 2 + 0.1 * u**2, False, e))
            x = 0.9 * x + 0.5 * past.pop(0) + 0.3 * inflow[k] + 0.01 * rng.normal()
            if k > 0:
                parts[-1 if k == length else -2] += (y[-1],)
    s, a, c, t, ids, reached = (np.array(part) for part in zip(*parts, strict=True))
    return TransitionTable.from_arrays(s, a, c, reached, t, ids)


def test_the_plants_parameters_are_identified_and_its_dead_time_found() -> None:
    table = make_log()
    assert find_delays(make_mpc(None), table).delay == (2,)
    found = identify(make_mpc(2), table)
    np.testing.assert_allclose(found.theta[:3], [0.9, 0.5, 0.3], rtol=0.05)
    assert found.errors_after.shape == (1,)


def test_an_ode_that_is_not_affine_is_identified_beside_signals_and_dead_time() -> None:
    """A drained tank, its rows integrated by scipy; how finely it is integrated is chosen on the log."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return p["gain"] * u + p["share"] * d.inflow - p["drain"] * x * ca.fabs(x)

    parameters = {name: Parameter(0.5, low=0.01, high=5.0) for name in ("gain", "share", "drain")}
    signals = [Signal("inflow", preview=1)]
    stiff, cost = Model(ode, 1, 1, 2.0, parameters, delay=1, signals=signals), QuadraticCost([[1.0]], [[0.1]])
    mpc = MPC(stiff, cost, QuadraticCost([[1.0]]), 5, 0.9, [0.0], [4.0])
    rng, parts = np.random.default_rng(0), []
    for e in range(6):
        x, before, inflow = rng.uniform(0.5, 2.0), 1.0, rng.uniform(0.0, 1.0, 32)
        for k in range(30):
            u, rate = rng.uniform(0.0, 4.0), 0.8 * before + 0.3 * inflow[k]
            reached = solve_ivp(lambda _, x, rate: rate - 1.2 * x * abs(x), (0.0, 2.0), [x], args=(rate,), rtol=1e-9)
            y = np.array([[x, *inflow[k : k + 2]], [reached.y[0, -1], *inflow[k + 1 : k + 3]]])
            parts.append((y[0], [u], x**2, y[1], False, e))
            x, before = y[1, 0], u
    table = TransitionTable.from_arrays(*(np.array(part) for part in zip(*parts, strict=True)))
    found = identify(mpc, table)
    np.testing.assert_allclose(found.theta[:3], [0.8, 0.3, 1.2], rtol=0.03)
    assert found.model.check(table).advice == found.model.check(with_memory(table, mpc.layout)).advice == ""


def test_predicted_successors_have_the_logged_signals() -> None:
    mpc, value = make_mpc(2), lambda s: s.sum(dim=1)
    table = with_memory(make_log(), mpc.layout)
    batch = table.columns(torch.from_numpy(table.rows[:50]))
    reached = BellmanProblem(mpc, value, 1.0).predicted(batch, torch.from_numpy(mpc.theta)).numpy()  # type: ignore[arg-type]
    np.testing.assert_array_equal(reached[:, 1:4], batch.next_observations[:, 1:4])
    np.testing.assert_allclose(reached[:, 4], batch.actions[:, 0])
    np.testing.assert_allclose(reached[:, 0], mpc.model(batch.observations, batch.actions)[:, 0])


def test_a_fit_gives_a_policy_that_follows() -> None:
    method = Bellman(
        identify=StartConfig("identified", adapt_above=1.0),
        value=ValueConfig(n_steps=20),
        fit=ParameterConfig(n_steps=1, refit_rows=500),
        terminal=TerminalConfig("quadratic"),
    )
    learner = OfflineMPCLearner(make_mpc(None), "cost+model", method=method)
    learner.fit(make_log(), show_progress=False)
    assert learner.mpc.model.delay == (2,)
    assert (learner.mpc.ny, learner.mpc.nx) == (4, 6)
    policy, ends = learner.policy, []
    for set_point in (-0.5, 0.8):
        x, past, state = 0.0, [0.0, 0.0], None
        for _ in range(40):
            action, state = policy.predict(np.array([x, set_point, set_point, 0.2]), state=state)
            past.append(float(action[0]))
            x = 0.9 * x + 0.5 * past.pop(0) + 0.3 * 0.2
        ends.append(x)
    assert ends[1] - ends[0] > 0.8
    assert isinstance(policy, MPCPolicy)


def test_logged_signals_go_on_as_along_a_horizon_after_the_episode() -> None:
    table, layout = make_log(n_episodes=2, length=20), make_mpc(0).layout
    found = signals_along(table, np.array([0, 17]), 5, layout)
    np.testing.assert_array_equal(found[0], table.next_observations[:5, 1:4])
    np.testing.assert_array_equal(found[1, :3], table.next_observations[17:20, 1:4])
    last = table.next_observations[19, 1:4]
    np.testing.assert_array_equal(found[1, 3:], [[last[1], last[1], last[2]]] * 2)
