"""Which solver is chosen, why, and what is refused."""

from __future__ import annotations

import logging
import pickle
from typing import Any

import casadi as ca
import numpy as np
import pytest

import mpcoffline.solvers as solvers
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.mpc import MPC, Model, NormCost, QuadraticCost, StateBounds
from mpcoffline.solvers import CompilerError, make_solver


def integrator(**changes: Any) -> MPC:
    arguments: dict[str, Any] = {
        "model": Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True),
        "stage_cost": QuadraticCost([[1.0]], [[1.0]]),
        "terminal_cost": QuadraticCost([[2.0]]),
        "horizon": 4,
        "discount": 0.95,
        "action_low": [-3.0],
        "action_high": [3.0],
    }
    return MPC(**(arguments | changes))


def pendulum() -> Model:
    return Model(lambda x, u, p: ca.vertcat(x[1], ca.sin(x[0]) + u), 2, 1, 0.1)


NONLINEAR: dict[str, Any] = {
    "model": pendulum(),
    "stage_cost": QuadraticCost(np.eye(2), [[1.0]]),
    "terminal_cost": QuadraticCost(np.eye(2)),
}


@pytest.mark.parametrize(
    ("changes", "name", "reason"),
    [
        ({}, "lqr", "lqr is the fastest that fits"),
        ({"terminal_cost": NormCost([0.0])}, "ddp", "lqr does not support a terminal cost that is not quadratic"),
        (NONLINEAR, "ddp", "lqr does not support a model that is not affine"),
        ({"constraints": lambda x, u, p: u - 1.0}, "ddp", "lqr does not support constraints other than input"),
        ({"constraints": StateBounds([-1.0], [1.0])}, "ddp", "lqr does not support constraints other than input"),
    ],
)
def test_auto_takes_the_fastest_that_fits(
    changes: dict[str, Any], name: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="mpcoffline.solvers"):
        solver = make_solver(integrator(**changes))
    assert solver.name == name
    assert reason in solver.reason
    assert solver.reason in caplog.text


def test_solvers_by_name() -> None:
    for name in ("lqr", "ddp", "ipopt"):
        solver = make_solver(integrator(), name)
        assert solver.name == name
        assert solver.reason == ""
        assert solver.solve([0.5]).value == pytest.approx(float(make_solver(integrator()).value([0.5])), rel=1e-7)
    with pytest.raises(UnknownIdError, match="Did you mean 'ipopt'"):
        make_solver(integrator(), "ipop")
    with pytest.raises(InvalidArgumentError, match="a problem that the lqr solver takes, got a model"):
        make_solver(integrator(**NONLINEAR), "lqr")


def test_options_choose_too() -> None:
    assert make_solver(integrator(), n_starts=2).reason == "ddp is the fastest that fits; lqr has no option n_starts"
    assert make_solver(integrator(), n_workers=1).name == "ipopt"
    assert make_solver(integrator(), cache_size=3).name == "lqr"


def test_options_that_do_not_exist_or_fit() -> None:
    with pytest.raises(InvalidArgumentError, match="options of the lqr solver: expected some of cache_size, got n_sta"):
        make_solver(integrator(), "lqr", n_starts=2)
    with pytest.raises(InvalidArgumentError, match=r"options of the solvers: .* got colour"):
        make_solver(integrator(), colour="blue")
    with pytest.raises(InvalidArgumentError, match="expected options of one solver"):
        make_solver(integrator(), cache_size=3, n_workers=2)
    for n_starts in (0, -1, 65):
        with pytest.raises(InvalidArgumentError, match="n_starts: expected an integer from 1 to 64"):
            make_solver(integrator(), n_starts=n_starts)


def test_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(solvers.DDPSolver):
        def __init__(self, mpc: MPC, *, max_iterations: int = 1, n_threads: int = 1) -> None:
            raise CompilerError("C compiler", expected="a working one", actual="none")

    monkeypatch.setitem(solvers.SOLVERS._things, "ddp", Broken)
    assert make_solver(integrator()).name == "lqr"
    with pytest.warns(UserWarning, match="500 times slower than ddp: C compiler: expected a working one"):
        solver = make_solver(integrator(**NONLINEAR), n_threads=1)
    assert solver.name == "ipopt"
    assert "ddp has no compiler" in solver.reason
    with pytest.raises(CompilerError):
        make_solver(integrator(), "ddp")


def test_a_registered_solver_takes_part_in_auto(monkeypatch: pytest.MonkeyPatch) -> None:
    class Eager(solvers.IpoptSolver):
        relative_speed = 1e6

        @classmethod
        def refuses(cls, mpc: MPC) -> str:
            return "long horizons" if mpc.horizon > 4 else ""

    monkeypatch.setattr(solvers.SOLVERS, "_things", dict(solvers.SOLVERS.items()))
    solvers.SOLVERS.add("eager", Eager)
    chosen = make_solver(integrator())
    assert type(chosen) is Eager
    assert (chosen.name, chosen.reason) == ("eager", "eager is the fastest that fits")
    longer = make_solver(integrator(horizon=5))
    assert (longer.name, longer.reason) == ("lqr", "lqr is the fastest that fits; eager does not support long horizons")
    with pytest.raises(InvalidArgumentError, match="mpc: expected a problem that the eager solver takes, got long"):
        make_solver(integrator(horizon=5), "eager")


def test_a_pickled_solver_has_the_options_that_it_was_made_with() -> None:
    solver = make_solver(integrator(horizon=2), "ipopt", max_time=5.0, n_starts=2)
    again = pickle.loads(pickle.dumps(solver))
    assert again.options == solver.options
    assert solvers.changed_options(again) == {"max_time": 5.0, "n_starts": 2}
