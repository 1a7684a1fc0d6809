"""Ends of episodes: when they matter, and what the terminal cost is there."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline import MPC, Model, NetworkCost, OfflineMPCLearner, QuadraticCost, TransitionTable
from mpcoffline.learning import Known, TerminalConfig, fit_terminal
from mpcoffline.learning.bellman.stages import with_terminal_cost
from mpcoffline.learning.ends import ends_matter, innermost, priced_ends

Array = NDArray[np.float64]

N_EPISODES, N_STEPS = 20, 25


def mpc() -> MPC:
    """x+ = x + 0.2 u with a cost and a terminal cost that no log has."""
    return MPC(
        model=Model(lambda x, u, _: x + 0.2 * u, nx=1, nu=1, dt=1.0, discrete=True),
        stage_cost=QuadraticCost([[2.0]], [[0.5]]),
        terminal_cost=QuadraticCost([[7.0]]),
        horizon=44,
        discount=0.95,
        action_low=[-1.0],
        action_high=[1.0],
    )


def walks(cost: float, last: float, *, varied: float = 0.0) -> TransitionTable:
    """Random walks that end where |x| > 1, at ``last``; a step costs ``cost`` and a part that varies."""
    rng = np.random.default_rng(0)
    rows: list[tuple[float, float, float, float, bool, int]] = []
    for episode in range(N_EPISODES):
        x = rng.uniform(-0.5, 0.5)
        for _ in range(N_STEPS):
            u = float(rng.uniform(-1.0, 1.0))
            reached = x + 0.2 * u
            ended = abs(reached) > 1.0
            rows.append((x, u, last if ended else cost + varied * x * x, reached, ended, episode))
            if ended:
                break
            x = reached
    s, a, L, reached, ended, ids = (np.array(column) for column in zip(*rows, strict=True))
    assert ended.sum() >= 3
    return TransitionTable.from_arrays(s[:, None], a[:, None], L, reached[:, None], ended, ids)


@pytest.mark.parametrize(
    ("cost", "last", "varied", "matter"),
    [
        (-1.0, 0.0, 0.0, True),  # alive: nothing follows an end
        (-1.0, -1.0, 0.0, True),  # the same where the last step pays, too
        (0.0, -100.0, 0.1, True),  # a goal
        (1.0, 50.0, 1.0, True),  # a failure with its price
        (1.0, 1.2, 1.0, False),  # switched off, and no more to pay
    ],
)
@settings(max_examples=5, deadline=None)
@given(exponent=st.floats(-6.0, 6.0))
def test_ends_matter_where_they_have_a_price(
    cost: float, last: float, varied: float, matter: bool, exponent: float
) -> None:
    """In any unit of cost."""
    unit = 10.0**exponent
    assert ends_matter(walks(unit * cost, unit * last, varied=unit * varied), 0.95) is matter


def test_no_end_is_left_out_where_it_matters() -> None:
    """Ends are the rows that are farthest out."""
    priced, free = walks(-1.0, 0.0), walks(1.0, 1.2, varied=1.0)
    assert innermost(priced, 0.8, 0.95).terminations.sum() == priced.terminations.sum()
    kept = innermost(free, 0.8, 0.95)
    assert len(kept) == pytest.approx(0.8 * len(free), abs=1)
    assert kept.terminations.sum() < free.terminations.sum()


def test_with_its_terminal_cost_a_plan_pays_what_an_end_costs() -> None:
    """Lhat + gamma T = L, by hand."""
    table = walks(0.0, 30.0, varied=1.0)
    ends = priced_ends(mpc(), table, None)
    assert ends is not None
    last = np.asarray(table.terminations) > 0.0
    x, u = (np.asarray(part, np.float64)[last, 0] for part in (table.observations, table.actions))
    np.testing.assert_allclose(2.0 * x**2 + 0.5 * u**2 + 0.95 * ends.values, 30.0, rtol=1e-6)
    assert (np.abs(ends.states) > 1.0).all()
    assert priced_ends(mpc(), walks(1.0, 1.2, varied=1.0), None) is None


def test_a_terminal_network_holds_the_ends_too() -> None:
    """V = 0 inside, 10 where episodes ended, of which there are few."""
    inside, outside = np.linspace(-1.0, 1.0, 1_000)[:, None], np.array([[-1.4], [1.4], [1.45], [-1.45]])
    ends = outside, np.full(4, 10.0)
    T = fit_terminal("network", lambda s: torch.zeros(len(s)), inside, x_ref=[0.0], seed=0, ends=ends)
    x = ca.SX.sym("x")
    value = ca.Function("T", [x], [T.terminal_expression(x, T.space.symbols(ca.DM(T.space.theta)))])
    assert value(np.linspace(-0.9, 0.9, 50)[None]).full() == pytest.approx(0.0, abs=1.5)
    assert (value(outside.T).full() > 5.0).all()


def test_from_a_bonus_for_being_alive_the_model_alone_is_learned(caplog: pytest.LogCaptureFixture) -> None:
    """Costs that are one number say nothing about the stage cost: it stays, with terminal cost and horizon."""
    learner = OfflineMPCLearner(mpc(), value_n_steps=30)
    learner.fit(walks(-1.0, 0.0), show_progress=False)
    assert "every step costs -1, only ends tell what is good" in caplog.text
    assert learner.mpc.horizon == 44
    for name, value in mpc().values.items():
        np.testing.assert_array_equal(learner.mpc.values[name], value)
    assert OfflineMPCLearner(mpc(), horizon=9).method.restructured(mpc()).horizon == 9


def test_the_terminal_cost_of_a_linear_quadratic_mpc_knows_a_price(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its exact value does not: where the model goes on, the plant has ended."""
    table = walks(0.0, 30.0, varied=1.0)
    monkeypatch.setattr(Known, "constant_value", property(lambda _: lambda s: torch.zeros(len(s))))
    for log, kind in ((table, NetworkCost), (walks(1.0, 1.2, varied=1.0), QuadraticCost)):
        found = with_terminal_cost(Known(mpc(), log), TerminalConfig("auto"))
        assert isinstance(found.mpc.terminal_cost, kind)
