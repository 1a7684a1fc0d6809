"""Learning in other units: an affine change of cost, states, inputs or time changes nothing of what is learned."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from other_units import Learned, Units, powers

from mpcoffline import (
    MPC,
    Model,
    MPCPolicy,
    OfflineMPCLearner,
    Parameter,
    QuadraticCost,
    TransitionTable,
    load_dataset,
    nominal_mpc,
)
from mpcoffline.estimation import identify, small_network

Array = NDArray[np.float64]

QUICK: dict[str, Any] = {
    "value_n_steps": 60,
    "fit_n_steps": 20,
    "hidden": (16,),
    "value_batch_size": 64,
    "fit_batch_size": 64,
}
TASKS = {"linear": "LinearTracking-v0", "pendulum": "PendulumSwingUp-v0", "cartpole": "CartPoleSwingUp-v0"}


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small networks of what the model misses are as invariant, and take their time."""
    monkeypatch.setattr(small_network, "_PATIENCE", 3)


def spring_log(n: int = 25, length: int = 40) -> TransitionTable:
    """A mass on a soft spring with friction, held away from rest by a wind, under a noisy regulator; s."""
    rng, rows = np.random.default_rng(0), []
    for episode in range(n):
        x, v = rng.uniform(-2.0, 2.0), rng.uniform(-1.0, 1.0)
        for _ in range(length):
            u, before = float(np.clip(-x - v + rng.normal(), -2.0, 2.0)), (x, v)
            for _ in range(5):
                x, v = x + 0.02 * v, v + 0.02 * (u - 0.4 * v - 0.5 * np.sin(x) + 0.3)
            cost = (before[0] - 0.4) ** 2 + 0.1 * before[1] ** 2 + 0.1 * u * u
            rows.append([*before, u, cost, x, v, episode])
    a = np.array(rows)
    return TransitionTable.from_arrays(a[:, :2], a[:, 2:3], a[:, 3], a[:, 4:6], np.zeros(len(a)), a[:, 6].astype(int))


def spring_mpc(hours: float = 1.0, *, start: float = 0.0) -> MPC:
    """MPC_1 of it, with time in other units: one s is so many of them; a wind that starts at zero.

    The state is (m, m/s) in any case, so that the log stays as it is.
    """

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        speed = x[1] / hours
        return ca.vertcat(speed, (u[0] - p["c"] * speed - 0.5 * ca.sin(x[0]) + p["wind"]) / p["m"])

    parameters = {
        "m": Parameter(1.6 * hours, low=0.1 * hours, high=10.0 * hours),
        "c": Parameter(0.1 * hours, low=1e-3 * hours, high=10.0 * hours),
        "wind": start,
    }
    model = Model(ode, 2, 1, 0.1 * hours, parameters)
    goal = [0.4, 0.0]
    stage, end = QuadraticCost(0.5 * np.eye(2), [[0.3]], x_ref=goal), QuadraticCost(np.eye(2), x_ref=goal)
    return MPC(model, stage, end, 20, 0.95, [-2.0], [2.0])


def problem(name: str) -> tuple[MPC, TransitionTable]:
    if name == "spring":
        return spring_mpc(), spring_log(n=20, length=15)
    options = {} if name == "linear" else {"alpha": 1.0, "seed": 0}
    table = TransitionTable.of(load_dataset(f"mpcoffline/{name}/ddpg-v0"))
    return nominal_mpc(f"mpcoffline/{TASKS[name]}", **options), table.take(slice(0, 1_000))


def learned(units: Units, mpc: MPC, table: TransitionTable, preset: str, **options: Any) -> Learned:
    learner = OfflineMPCLearner(units.mpc(mpc), preset=preset, seed=0, **(QUICK | options))
    learner.fit(units.table(table), show_progress=False)
    return Learned.of(learner, units, table.values().observations[:100])


@cache
def learned_as_it_is(preset: str, **options: Any) -> Learned:
    """What is learned of the spring in its own units."""
    return learned(Units(), spring_mpc(), spring_log(), preset, **options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spring", *TASKS])
def test_powers_of_two_change_no_bit(name: str) -> None:
    """Rounding does not depend on them: theta, V and the terminal cost from it are the same numbers."""
    mpc, table = problem(name)
    units = Units(powers(mpc.nx, 0), powers(mpc.nu, 1), cost=4.0**-7)
    candidate = "auto" if name == "spring" else "full"  # the choice is as invariant, and takes its time
    before, after = (learned(u, mpc, table, "default", candidate=candidate) for u in (Units(), units))
    differences = before.differences(after)
    terminal = differences.pop("terminal")
    assert differences == dict.fromkeys(differences, 0.0)
    assert terminal == 0.0 or (name == "linear" and terminal < 1e-9)  # the Riccati equation's solver balances


@pytest.mark.parametrize("units", [Units(cost=4.0**9), Units([2.0**-15, 2.0**9], 2.0**12)], ids=["cost", "states"])
def test_units_of_the_log_change_no_bit(units: Units) -> None:
    before, after = learned_as_it_is("paper"), learned(units, spring_mpc(), spring_log(), "paper")
    assert before.differences(after) == dict.fromkeys(vars(before), 0.0)


@pytest.mark.parametrize("hours", [2.0**-12, 2.0**6])
def test_the_unit_of_time_changes_no_bit(hours: float) -> None:
    """One s is so many units: rates, dt and parameters follow."""
    table = spring_log()
    before, after = (identify(spring_mpc(h), table) for h in (1.0, hours))
    np.testing.assert_array_equal(after.theta[:2], before.theta[:2] * hours)
    np.testing.assert_array_equal(after.theta[2:], before.theta[2:])
    assert not before.undetermined
    np.testing.assert_allclose(before.theta[:3], [1.0, 0.4, 0.3], rtol=0.1)


@pytest.mark.parametrize(
    "units", [Units(cost=1e-7), Units(offset=1e3), Units(offset=-1e6), Units([1e5, 1e-6], 1e3, 1e6)]
)
def test_other_units_and_offsets_change_what_rounding_does(units: Units) -> None:
    """Weights to six digits: the log is float32. Without steps on the model; these amplify rounding."""
    options = {"terminal": "quadratic", "candidate": "full"}
    before, after = (
        learned_as_it_is("default", **options),
        learned(units, spring_mpc(), spring_log(), "default", **options),
    )
    differences = before.differences(after)
    assert max(differences[name] for name in ("model", "W", "R")) < 2e-4
    assert max(differences[name] for name in ("terminal", "value")) < 2e-3


@pytest.mark.parametrize("start", [0.0, Parameter(0.0, low=-1e5, high=1e5), 3e3])
def test_a_parameter_that_starts_at_zero_is_found(start: Any) -> None:
    """It is 1e4, where its effect is as large as that of anything else: no prior of its own size holds it."""
    rng, size, truth = np.random.default_rng(0), 1e4, 1e4
    x, u = (rng.normal(size=(1_000, 1)) * size for _ in range(2))
    table = TransitionTable.from_arrays(x, u, x[:, 0] ** 2, 0.9 * x + 0.1 * (u + truth), np.zeros(1_000))
    parameters = {"a": 0.5, "b": start}
    model = Model(lambda x, u, p: p["a"] * x + 0.1 * (u + p["b"]), 1, 1, 0.1, parameters, discrete=True)
    mpc = MPC(model, QuadraticCost([[1.0]], [[0.1]]), QuadraticCost([[1.0]]), 10, 0.95, [-5 * size], [5 * size])
    found = identify(mpc, table)
    assert not found.undetermined
    assert float(mpc.with_theta(found.theta).values["model.b"]) == pytest.approx(truth, rel=1e-5)


def in_units(units: Units, candidate: str) -> OfflineMPCLearner:
    """What is learned of the spring in other units."""
    schedule = {"value_n_steps": 300, "hidden": (32,), "value_batch_size": 128, "horizon": 15}
    learner = OfflineMPCLearner(units.mpc(spring_mpc()), seed=0, candidate=candidate, **schedule)
    table = spring_log(n=40, length=15)  # the choice simulates as many steps
    learner.fit(units.table(table), show_progress=False)
    return learner


def closed_loop(units: Units, mpc: MPC) -> float:
    """The true cost of the spring's mass under an MPC in other units, in the old ones."""
    policy = MPCPolicy(mpc)
    x, total, plan = np.random.default_rng(1).uniform([-2.0, -1.0], [2.0, 1.0], (20, 2)), 0.0, None
    for _ in range(40):
        u, plan = policy.predict(x * units.states, state=plan)
        u = u[:, 0].astype(float) / float(np.asarray(units.inputs))
        total += float(np.mean((x[:, 0] - 0.4) ** 2 + 0.1 * x[:, 1] ** 2 + 0.1 * u**2))
        for _ in range(5):
            x = x + 0.02 * np.column_stack([x[:, 1], u - 0.4 * x[:, 1] - 0.5 * np.sin(x[:, 0]) + 0.3])
    return total


@pytest.mark.slow
def test_the_closed_loop_is_the_same_in_any_units() -> None:
    """Of the whole fit, and of what is chosen where all units are others."""
    spread = float(spring_log().costs.std())
    all_others = Units([1e-6, 1e6], 1e6, cost=1e-6, offset=-1e3 * spread)
    chosen, whole = [], []
    for units in (Units(), all_others):
        learner = in_units(units, "auto")
        assert learner.candidates is not None
        chosen.append(closed_loop(units, learner.mpc))
        whole.append(closed_loop(units, learner.candidates["full"]))
    far = Units(cost=1e6, offset=1e6 * spread)
    whole.append(closed_loop(far, in_units(far, "full").mpc))
    np.testing.assert_allclose(chosen[1], chosen[0], rtol=0.01)
    np.testing.assert_allclose(whole[1:], whole[0], rtol=0.01)
