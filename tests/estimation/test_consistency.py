"""Contradictions between an MPC and a log: each one made from a good log is found by name, good logs are silent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from late_plants import belt_log, belt_mpc
from numpy.typing import NDArray

import mpcoffline
from mpcoffline import (
    MPC,
    InvalidDataError,
    Model,
    Parameter,
    QuadraticCost,
    Signal,
    StateBounds,
    TransitionTable,
    nominal_mpc,
)
from mpcoffline.estimation.findings import CHECKS, Finding
from mpcoffline.estimation.rows import Rows, without_jumps

Array = NDArray[np.float64]
DT, STEPS, EPISODES = 0.05, 60, 20
GOAL = 0.8


class Log(NamedTuple):
    """Arrays of a log."""

    s: Array
    a: Array
    cost: Array
    s_next: Array
    end: Array
    ids: NDArray[np.int64]

    def table(self) -> TransitionTable:
        return TransitionTable.from_arrays(*self)

    def column(self, i: int, change: Callable[[Array], Array]) -> Log:
        """The log with one observation changed."""
        s, s_next = self.s.copy(), self.s_next.copy()
        s[:, i], s_next[:, i] = change(s[:, i]), change(s_next[:, i])
        return self._replace(s=s, s_next=s_next)

    def order(self, *order: int) -> Log:
        return self._replace(s=self.s[:, order], s_next=self.s_next[:, order])


def arm_log(seed: int = 0, noise: float = 0.0, delay: int = 0) -> Log:
    """Angle, rate and the motor's torque of an arm in gravity, by a PD controller with test signals."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[Any, ...]] = []
    for episode in range(EPISODES):
        q, w, torque, offset = rng.uniform(-1, 1), 0.0, 0.0, 0.0
        gain, late = rng.uniform(3, 8), [0.0] * delay
        seen = np.array([q, w, torque]) + noise * rng.normal(size=3)
        for _ in range(STEPS):
            offset = 1.5 * rng.normal() if rng.random() < 0.2 else offset
            u = float(np.clip(2.8 + gain * (GOAL - seen[0]) - seen[1] + offset, -6, 6))
            late.append(u)
            acts = late.pop(0)
            cost = 5 * (q - GOAL) ** 2 + 0.1 * w**2 + 0.02 * u**2
            for _ in range(20):
                h = DT / 20
                torque += h * (acts - torque) / 0.08
                w += h * (torque - 3.9 * np.sin(q) - 0.25 * w) / 0.25
                q += h * w
            reached = np.array([q, w, torque]) + noise * rng.normal(size=3)
            rows.append((seen, [u], cost, reached, 0.0, episode))
            seen = reached
    return Log(*(np.array(column) for column in zip(*rows, strict=True)))


def arm_mpc(seed: int = 0, dt: float = DT, **changes: Any) -> MPC:
    """An MPC of it with parameters wrong by up to a factor 2."""
    factors = np.exp(np.random.default_rng(seed).uniform(-0.7, 0.7, 4))
    values = dict(zip(("inertia", "gravity", "friction", "lag"), factors * [0.25, 3.9, 0.25, 0.08], strict=True))

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        turned = (x[2] - p["gravity"] * ca.sin(x[0]) - p["friction"] * x[1]) / p["inertia"]
        return ca.vertcat(x[1], turned, (u[0] - x[2]) / p["lag"])

    parameters = {name: Parameter(v, low=v / 5, high=v * 5) for name, v in values.items()}
    cost = QuadraticCost(W=np.diag([4.0, 0.2, 0.0]), R=[[0.03]], x_ref=[GOAL, 0, 0])
    mpc = MPC(Model(ode, 3, 1, dt, parameters, delay=changes.pop("delay", None)), cost, cost, 20, 0.95, [-6], [6])
    return mpc.replace(**changes)


LOG = arm_log()


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), noise=st.sampled_from([0.0, 0.003, 0.03]), delay=st.sampled_from([0, 0, 2]))
def test_a_rough_model_is_no_contradiction(seed: int, noise: float, delay: int) -> None:
    report = mpcoffline.check(arm_mpc(seed), arm_log(seed, noise, delay).table())
    assert report.ok, str(report)


@pytest.mark.usefixtures("shipped")
@pytest.mark.parametrize("task", ["pendulum", "cartpole", "linear"])
def test_the_shipped_logs_are_silent(task: str) -> None:
    ids = {"pendulum": "PendulumSwingUp-v0", "cartpole": "CartPoleSwingUp-v0", "linear": "LinearTracking-v0"}
    error: dict[str, Any] = {} if task == "linear" else {"alpha": 1.5, "seed": 3}
    report = mpcoffline.check(nominal_mpc(f"mpcoffline/{ids[task]}", **error), f"mpcoffline/{task}/ddpg-v0")
    assert report.ok, str(report)
    assert str(report) == "Nothing contradicts the description of the MPC."


def swapped_with_input(log: Log) -> Log:
    """The rate and the action exchanged: s+ is what the next row holds there."""
    s, a, s_next = log.s.copy(), log.a.copy(), log.s_next.copy()
    s[:, 1], a[:, 0], s_next[:, 1] = log.a[:, 0], log.s[:, 1], np.roll(log.a[:, 0], -1)
    return log._replace(s=s, a=a, s_next=s_next)


def rolled(values: Array, by: int) -> Array:
    return np.roll(values, by, axis=0)


DEGREES = 180.0 / np.pi
CHANGES: dict[str, tuple[Callable[[Log], Log], str, str]] = {
    "1000 times": (lambda log: log.column(1, lambda v: 1e3 * v), "observation 1", "divided by 1000"),
    "a thousandth": (lambda log: log.column(2, lambda v: 1e-3 * v), "observation 2", "multiplied by 1000"),
    "one angle in degrees": (lambda log: log.column(0, lambda v: DEGREES * v), "observation 0", "degrees to radians"),
    "all angles in degrees": (
        lambda log: log.column(0, lambda v: DEGREES * v).column(1, lambda v: DEGREES * v),
        "observation 0 and observation 1",
        "degrees to radians",
    ),
    "an angle's sign": (lambda log: log.column(0, np.negative), "observation 0", "sign of observation 0"),
    "states exchanged": (lambda log: log.order(1, 0, 2), "observations 0 and 1", "are exchanged"),
    "others exchanged": (lambda log: log.order(0, 2, 1), "observations 1 and 2", "are exchanged"),
    "state and input exchanged": (swapped_with_input, "observation 1 and action 0", "are exchanged"),
    "the input's sign": (lambda log: log._replace(a=-log.a), "action 0", "sign of action 0"),
    "the input's unit": (lambda log: log._replace(a=log.a / 1e3), "action 0", "multiplied by 1000"),
    "another input": (
        lambda log: log._replace(a=np.random.default_rng(1).permutation(log.a)),
        "action 0",
        "no effect on any state in the next 20 steps",
    ),
    "a constant input": (lambda log: log._replace(a=0.0 * log.a + 2.0), "action 0", "2 in all rows"),
    "no test signals": (
        lambda log: log._replace(a=np.clip(-0.3 * log.s[:, :1] + 0.1 * log.s[:, 1:2], -6, 6)),
        "action 0",
        "follows from the state",
    ),
    "a sensor that is off": (lambda log: log.column(1, lambda v: 0.0 * v + 0.3), "observation 1", "0.3 in all rows"),
    "actions a row late": (lambda log: log._replace(a=rolled(log.a, 1)), "actions", "actions of the row before"),
    "a constant cost": (lambda log: log._replace(cost=0.0 * log.cost + 7.0), "costs", "all costs are 7,"),
    "a reward": (lambda log: log._replace(cost=-log.cost), "costs", "rank correlation -"),
    "too few rows": (lambda log: Log(*(part[:3] for part in log)), "rows", "3"),
    "shuffled": (
        lambda log: Log(*(part[np.random.default_rng(2).permutation(len(log.s))] for part in log[:-1]), LOG.ids),
        "episodes",
        "episodes of one step",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_a_likely_contradiction_is_named(name: str) -> None:
    change, about, words = CHANGES[name]
    log = change(LOG)
    if name == "shuffled":
        log = log._replace(ids=np.arange(len(log.s)))
    report = mpcoffline.check(arm_mpc(1, action_low=[-99], action_high=[99]), log.table())
    assert not report.errors
    assert [each.name for each in report.warnings] == [about], str(report)
    assert words in report.warnings[0].actual
    assert report.warnings[0].hint
    report.raise_for_errors()


@pytest.mark.parametrize("factor", [0.001, 1 / 60, 10.0])
def test_another_sampling_time_is_named(factor: float) -> None:
    report = mpcoffline.check(arm_mpc(1, dt=DT * factor), LOG.table())
    assert [each.name for each in report.findings] == ["dt"], str(report)
    assert f"about {DT:g} s" in report.findings[0].actual


CERTAIN: dict[str, tuple[Callable[[Log], Log], str, str]] = {
    "the same row": (lambda log: log._replace(s_next=log.s), "next_observations", "the same row's"),
    "the row before": (lambda log: log._replace(s_next=rolled(log.s, 1)), "next_observations", "one step earlier"),
    "the row after next": (lambda log: log._replace(s_next=rolled(log.s, -2)), "next_observations", "two steps later"),
    "out of bounds": (lambda log: log._replace(a=1e3 * log.a), "action 0", "-6000"),
    "a column more": (lambda log: log._replace(a=np.repeat(log.a, 2, axis=1)), "actions", "2"),
    "a column less": (lambda log: log._replace(s=log.s[:, :2], s_next=log.s_next[:, :2]), "observations", "2"),
}


@pytest.mark.parametrize("name", CERTAIN)
@pytest.mark.parametrize("with_ids", [True, False])
def test_a_certain_contradiction_is_an_error(name: str, with_ids: bool) -> None:
    change, about, words = CERTAIN[name]
    changed = change(LOG)
    table = TransitionTable.from_arrays(*changed[:-1], changed.ids if with_ids else None)
    report = mpcoffline.check(arm_mpc(), table)
    assert len(report.errors) == 1, str(report)
    assert about in report.errors[0].name
    assert str(report).startswith("error: ")
    if name != "out of bounds":
        assert words in report.errors[0].actual
    with pytest.raises(InvalidDataError, match=about):
        report.raise_for_errors()
    learner = mpcoffline.OfflineMPCLearner(arm_mpc())
    with pytest.raises(InvalidDataError, match=about):
        learner.fit(table, show_progress=False)


def test_a_dead_time_longer_than_the_episodes_is_an_error() -> None:
    report = mpcoffline.check(arm_mpc(delay=STEPS + 3), LOG.table())
    assert report.errors[0].expected.startswith(f"more than {STEPS + 3} consecutive rows")


@pytest.mark.parametrize("speed", [0.05, 0.6, 0.8])
def test_a_wrapped_angle_may_turn_fast(speed: float) -> None:
    """So many turns a step, at most: the share of the steps that cross the end of the turn."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-np.pi, np.pi, (400, 1))
    moved = x + 2.0 * np.pi * speed * rng.uniform(0.8, 1.0, (400, 1))
    rows = Rows(x, np.zeros((400, 1)), (moved + np.pi) % (2.0 * np.pi) - np.pi)
    found, angles = without_jumps(rows, moved - rows.reached)
    assert angles == (0,)
    np.testing.assert_allclose(found.reached, moved)


@pytest.mark.parametrize("delay", [1, 3, 7])
def test_a_dead_time_is_no_other_unit(delay: int) -> None:
    """With inputs in another one the belt's errors would be twice 2 pi in all rows: the belt is no angle."""
    assert not any("converted" in each.actual for each in mpcoffline.check(belt_mpc(), belt_log(delay)).findings)


@pytest.mark.parametrize("delay", [0, 2])
def test_known_dead_time_is_taken_into_account(delay: int) -> None:
    assert mpcoffline.check(arm_mpc(delay=delay), arm_log(delay=delay).table()).ok
    report = mpcoffline.check(arm_mpc(delay=delay), arm_log(delay=delay).column(1, lambda v: 1e3 * v).table())
    assert [each.name for each in report.findings] == ["observation 1"]


def test_references_and_bounds_speak_where_the_model_cannot() -> None:
    """A tank whose filling has no unit of its own: any scale of level and inflow fits a free gain."""
    rng = np.random.default_rng(0)
    s, a = rng.uniform(0.001, 0.02, (500, 1)), rng.uniform(0, 1, (500, 1))
    table = TransitionTable.from_arrays(s, a, (s[:, 0] - 0.012) ** 2, 0.9 * s + 0.001 * a, np.zeros(500))

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return 0.9 * x + p["gain"] * u

    model = Model(step, 1, 1, 1.0, {"gain": 0.001}, discrete=True)
    cost, plain = QuadraticCost(W=[[1.0]], x_ref=[12.0]), QuadraticCost(W=[[1.0]], x_ref=[0.012])
    bound = [StateBounds([5.0], [20.0], name="level")]
    for mpc, what in (
        (MPC(model, cost, cost, 5, 0.9, [0], [1]), "the reference, 12"),
        (MPC(model, plain, plain, 5, 0.9, [0], [1], bound), "bounds 'level', 5 to 20"),
    ):
        found = {each.name: each for each in mpcoffline.check(mpc, table).findings}
        assert what in found["observation 0"].expected
        assert "multiplied by 1000" in found["observation 0"].actual


def test_a_fit_says_once_what_is_likely(caplog: pytest.LogCaptureFixture) -> None:
    learner = mpcoffline.OfflineMPCLearner(arm_mpc(), preset="paper", value_n_steps=5, fit_n_steps=2)
    learner.fit(LOG._replace(a=-LOG.a).table(), show_progress=False)
    assert caplog.text.count("the sign of action 0 is flipped") == 1


def test_checks_are_added_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CHECKS, "_things", dict(CHECKS.items()))
    CHECKS.add("mine", lambda mpc, log: iter([Finding("moon", "none", f"{len(log)} rows", "Look up.")]))
    assert str(mpcoffline.check(arm_mpc(), LOG.table())) == "warning: moon: expected none, got 1200 rows. Look up."


def room_mpc(low: float, high: float) -> MPC:
    """Two temperatures in kelvin beside that of the outside; the first follows a set-point."""

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        wall = 0.9 * x[1] + 0.1 * d.outside
        return ca.vertcat(x[0] + 0.2 * (x[1] - x[0]) + p["gain"] * u, wall)

    signals = [Signal("set_point"), Signal("outside", usual=280.0)]
    model = Model(step, 2, 1, 60.0, {"gain": Parameter(1.5, low=0.1, high=10.0)}, discrete=True, signals=signals)
    cost = QuadraticCost(np.diag([1.0, 0.0]), [[0.1]], tracks={0: "set_point"})
    bounds = StateBounds(low=[low] * 4, high=[high] * 4)
    return MPC(model, cost, QuadraticCost(np.eye(2)), 20, 0.95, [0.0], [4.0], constraints=[bounds])


def room_log(sign: float = 1.0, order: tuple[int, ...] = (0, 1, 2, 3)) -> TransitionTable:
    rng, rows = np.random.default_rng(0), []
    for episode in range(12):
        x, outside = rng.uniform(262.0, 285.0, 2), rng.uniform(262.0, 285.0)
        for _ in range(50):
            point, u = rng.uniform(262.0, 285.0), rng.uniform(0.0, 4.0)
            reached = np.array([x[0] + 0.2 * (x[1] - x[0]) + sign * u, 0.9 * x[1] + 0.1 * outside])
            y, outside = [*x, point, outside], outside + 0.3 * rng.normal()
            y_next = [*reached, point, outside]
            rows.append((y, [u], (x[0] - point) ** 2 + 0.1 * u**2, y_next, False, episode))
            x = reached
    s, *others, reached, end, ids = (np.array(column) for column in zip(*rows, strict=True))
    return TransitionTable.from_arrays(s[:, order], *others, reached[:, order], end, ids)


def test_signals_are_no_states() -> None:
    """What follows a set-point has no reference of its own, and bounds may be on signals, too."""
    assert mpcoffline.check(room_mpc(200.0, 400.0), room_log()).ok
    assert "observation 0" in str(mpcoffline.check(room_mpc(-20.0, 20.0), room_log()))


@pytest.mark.parametrize(
    ("log", "words"), [({"sign": -1.0}, "the sign of action 0"), ({"order": (1, 0, 2, 3)}, "0 and 1 are exchanged")]
)
def test_logs_with_signals_are_read_otherwise_too(log: dict[str, Any], words: str) -> None:
    assert words in str(mpcoffline.check(room_mpc(200.0, 400.0), room_log(**log)))


def test_exchanged_inputs_beside_a_signal_are_named() -> None:
    """A reading of several inputs leaves the signals where they are."""

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return ca.vertcat(0.9 * x[0] + p["heat"] * u[0] + 0.3 * d.load, 0.8 * x[1] - p["cool"] * u[1] + 0.1 * x[0])

    gains = {"heat": Parameter(0.5, low=0.3, high=0.9), "cool": Parameter(0.2, low=0.1, high=0.4)}
    model = Model(step, 2, 2, 60.0, gains, discrete=True, signals=[Signal("load")])
    mpc = MPC(model, QuadraticCost(np.eye(2), np.eye(2)), QuadraticCost(np.eye(2)), 20, 0.95, [-1.0] * 2, [1.0] * 2)
    rng = np.random.default_rng(0)
    y, u = np.hstack([rng.normal(size=(600, 2)), rng.normal(size=(600, 1))]), rng.uniform(-1.0, 1.0, (600, 2))
    heated = 0.9 * y[:, 0] + 0.5 * u[:, 0] + 0.3 * y[:, 2]
    reached = np.column_stack([heated, 0.8 * y[:, 1] - 0.2 * u[:, 1] + 0.1 * y[:, 0], rng.normal(size=600)])
    cost = (y[:, :2] ** 2).sum(axis=1) + (u**2).sum(axis=1)
    table = TransitionTable.from_arrays(y, u, cost, reached, np.zeros(600), np.arange(600))
    exchanged = TransitionTable.from_arrays(y, u[:, ::-1], cost, reached, np.zeros(600), np.arange(600))
    assert "exchanged" not in str(mpcoffline.check(mpc, table))
    assert "actions 0 and 1 are exchanged" in str(mpcoffline.check(mpc, exchanged))
