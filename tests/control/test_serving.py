"""The loop by a clock that only moves when told: late, lost and restarted devices, slow and failing policies."""

from __future__ import annotations

import csv
import json
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planted_logs import heater
from typer.testing import CliRunner

from mpcoffline import Input, InvalidArgumentError, MPCPolicy, Plant, StorageError
from mpcoffline.cli import app
from mpcoffline.control.course import Course
from mpcoffline.control.serving import (
    DecisionLog,
    DeviceError,
    LineDevice,
    LineServer,
    Measurement,
    Service,
    SimulatedDevice,
    SystemClock,
    VirtualClock,
)
from mpcoffline.solvers import Plan

LATE = replace(heater(), inputs=[Input("power", "%", 0, 100, delay=2)])
POLICIES = {"plain": MPCPolicy(heater().mpc()), "late": MPCPolicy(LATE.mpc())}
PLANTS: dict[str, Plant] = {"plain": heater(), "late": LATE}
DT = 5.0


Wrong = Mapping[int, Callable[[], None]]


class Broken:
    """A device of which single readings and writings go wrong, by number."""

    def __init__(self, device: SimulatedDevice, reads: Wrong | None = None, writes: Wrong | None = None) -> None:
        self.device, self.reads, self.writes, self.n = device, reads or {}, writes or {}, -1
        self.written: list[float] = []

    def read(self) -> Measurement:
        self.n += 1
        self.reads.get(self.n, lambda: None)()
        return self.device.read()

    def write(self, inputs: Mapping[str, float]) -> None:
        self.writes.get(self.n, lambda: None)()
        self.written.append(inputs["power"])
        self.device.write(inputs)


def refuse() -> None:
    raise DeviceError("heater", expected="an answer", actual="silence")


def lab(kind: str = "plain", **inputs: float) -> tuple[VirtualClock, SimulatedDevice, MPCPolicy]:
    clock, policy = VirtualClock(1.7e9), POLICIES[kind]
    return clock, SimulatedDevice(PLANTS[kind].env(steps=1_000), policy.mpc, clock, inputs=inputs, seed=3), policy


@pytest.mark.parametrize("kind", ["plain", "late"])
def test_a_sound_loop_does_what_the_policy_does_in_the_environment(kind: str) -> None:
    clock, device, policy = lab(kind)
    watched = Broken(device)
    stats = Service(policy, watched, clock=clock, transfer=1).run(60)
    env, state, actions, cost = PLANTS[kind].env(steps=1_000), None, [], 0.0
    y, _ = env.reset(seed=3)
    for _ in range(60):
        u, state = policy.predict(y, state)
        actions.append(float(u[0]))
        y, reward, *_ = env.step(u)
        cost -= float(reward)
    clock.advance(DT)
    device.read()  # the step of the last input
    assert watched.written == pytest.approx(actions, rel=1e-5, abs=1e-4)
    assert device.cost == pytest.approx(cost, rel=1e-6)
    assert (stats.periods, stats.decided) == (60, 60)
    assert str(stats) == "60 periods, 60 decided by the policy"
    assert clock.now() == pytest.approx(60 * DT)


@pytest.mark.parametrize("kind", ["plain", "late"])
def test_inputs_that_were_taken_but_not_confirmed_count_as_the_device_says(kind: str, tmp_path: Path) -> None:
    clock, device, policy = lab(kind)

    class Deaf(Broken):
        """It takes every input; of some it says nothing."""

        def write(self, inputs: Mapping[str, float]) -> None:
            super().write(inputs)
            if self.n in (20, 21, 35):
                refuse()

    watched, sound = Deaf(device), lab(kind)
    same = Broken(sound[1])
    Service(policy, same, clock=sound[0], transfer=1).run(60)
    with DecisionLog(tmp_path / "trial.csv", policy.mpc) as decisions:
        stats = Service(policy, watched, clock=clock, transfer=1, log=decisions).run(60)
    assert (stats.unwritten, stats.decided) == (3, 60)
    assert watched.written == pytest.approx(same.written, rel=1e-9)  # as if all had been confirmed
    with (tmp_path / "trial.csv").open() as file:
        rows = list(csv.DictReader(file))
    empty = [k for k, row in enumerate(rows) if row["power [%]"] == ""]
    assert empty == [20, 21, 35]
    known = [float(row["power [%]"]) for k, row in enumerate(rows) if k not in empty]
    assert known == pytest.approx([u for k, u in enumerate(watched.written) if k not in empty])


def test_it_takes_over_from_what_is_in_effect() -> None:
    clock, device, policy = lab("late", power=60.0)
    watched = Broken(device)
    first = device.read()
    y = np.array([first.values[label.name] for label in policy.mpc.layout.y_labels])
    memory = policy.mpc.layout.filled([60.0])[None]
    plan = Plan.none(1, policy.mpc)
    wanted = float(policy.predict(y, Course(plan.x, plan.u, memory))[0][0])
    Service(policy, watched, clock=clock, transfer=4).run(8)
    assert abs(wanted - 60.0) > 5.0
    assert watched.written[0] == pytest.approx(60.0 + (wanted - 60.0) / 4.0)


def test_lost_measurements_are_bridged_then_the_fall_back_comes_in(tmp_path: Path) -> None:
    clock, device, policy = lab()
    lost = dict.fromkeys((*range(10, 12), *range(20, 27)), refuse)
    watched, log = Broken(device, lost), tmp_path / "trial.csv"
    told: list[str] = []
    with DecisionLog(log, policy.mpc) as decisions:
        service = Service(
            policy, watched, clock=clock, transfer=2, hold=4, fallback={"power": 7.0}, log=decisions, tell=told.append
        )
        stats = service.run(40)
    u = watched.written
    assert u[10] == u[11] == u[9]
    assert u[20:24] == [u[19]] * 4
    assert u[24:27] == [7.0] * 3
    assert (stats.periods, stats.decided, stats.lost, stats.held, stats.fallbacks) == (40, 31, 9, 6, 3)
    with log.open() as file:
        rows = list(csv.DictReader(file))
    by = [row["decided_by"] for row in rows]
    assert by[9:13] == ["policy", "hold", "hold", "policy"]
    assert by[23:30] == ["hold", "fallback", "fallback", "fallback", "transfer", "policy", "policy"]
    assert u[27] == pytest.approx(0.5 * (7.0 + float(rows[27]["wanted power [%]"])))
    assert rows[24]["T [°C]"] == ""
    assert "silence" in rows[24]["note"]
    assert [text.split(":")[0] for text in told] == ["no measurement", "Well again.", "no measurement", "Well again."]


def test_the_log_is_one_that_the_plant_reads(tmp_path: Path) -> None:
    pytest.importorskip("polars")
    clock, device, policy = lab()
    watched, log = Broken(device, {30: refuse}), tmp_path / "trial.csv"
    for _ in range(2):  # the second goes on with the first one's log
        with DecisionLog(log, policy.mpc) as decisions:
            Service(policy, watched, clock=clock, log=decisions).run(50)
        clock.advance(DT)
    table = heater().read(log)
    assert (len(table), table.n_episodes) == (97, 2)
    kept = [k for k in range(99) if k not in (29, 30)]
    assert table.actions[:, 0] == pytest.approx(np.array(watched.written)[kept], rel=1e-6)
    other = tmp_path / "notes.csv"
    other.write_text("a,b\n1,2\n")
    with pytest.raises(StorageError, match="a log of the same columns"):
        DecisionLog(other, policy.mpc)
    assert other.read_text() == "a,b\n1,2\n"


def test_what_comes_too_late_is_counted_and_nothing_drifts() -> None:
    clock, device, policy = lab()
    slow = {3: lambda: clock.advance(0.9 * DT), 6: lambda: clock.advance(100 * DT)}
    watched = Broken(device, slow, {9: lambda: clock.advance(3 * DT), 12: refuse})
    stats = Service(policy, watched, clock=clock).run(20)
    assert (stats.lost, stats.unwritten, stats.skipped) == (2, 2, 0)
    assert 19 * DT <= clock.now() < 20 * DT

    asleep = Broken(lab()[1])
    clock = VirtualClock()
    asleep.device = SimulatedDevice(PLANTS["plain"].env(steps=1_000), policy.mpc, clock)
    asleep.reads = {5: refuse}
    service = Service(policy, asleep, clock=clock, tell=lambda _: clock.advance(3.2 * DT))  # a computer that sleeps
    stats = service.run(20)
    assert stats.skipped == 4  # two when it begins to go wrong, two when it is over
    assert stats.periods == 16


def test_slow_and_failing_policies_never_end_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, device, policy = lab()
    watched, whole, calls = Broken(device), policy.predict, iter(range(100))

    def predict(y: Any, state: Any = None) -> Any:
        k = next(calls)
        if k == 4:
            clock.advance(0.85 * DT)
        if k == 8:
            raise InvalidArgumentError("model", expected="numbers", actual="none")
        if k == 12:
            policy.solver_stats.n_zero += 1
        if k == 16:
            policy.solver_stats.n_best_plan += 1
        return whole(y, state)

    monkeypatch.setattr(policy, "predict", predict)
    stats = Service(policy, watched, clock=clock).run(20)
    assert (stats.missed, stats.failed, stats.approximate, stats.held, stats.decided) == (1, 2, 1, 3, 17)
    assert [watched.written[k] == watched.written[k - 1] for k in (4, 8, 12)] == [True] * 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, MemoryError])
def test_whatever_ends_the_loop_leaves_the_fall_back(
    error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, device, policy = lab()
    watched, whole, calls = Broken(device), policy.predict, iter(range(100))

    def predict(y: Any, state: Any = None) -> Any:
        if next(calls) == 3:
            raise error
        return whole(y, state)

    monkeypatch.setattr(policy, "predict", predict)
    with pytest.raises(error):
        Service(policy, watched, clock=clock, fallback={"power": 7.0}).run(20)
    assert len(watched.written) == 4
    assert watched.written[-1] == 7.0


@pytest.mark.parametrize("values", [{"T": 30.0}, {"T": np.nan, "ambient": 20.0}, {"T": "warm", "ambient": 20.0}, None])
def test_an_incomplete_measurement_is_none(values: Any) -> None:
    clock, device, policy = lab()
    device.read = lambda: Measurement(values)  # type: ignore[method-assign]
    stats = Service(policy, device, clock=clock).run(3)
    assert (stats.lost, stats.decided) == (3, 0)


def test_previews_and_clocks_are_filled_in() -> None:
    from mpcoffline import Signal

    signals = [Signal("ambient", "°C", low=10, high=30, preview=2), Signal("day", period=24)]
    policy = MPCPolicy(replace(heater(), signals=signals).mpc())
    service = Service(policy, lab()[1], clock=VirtualClock())
    found = service._complete(Measurement({"T": 30.0, "ambient": 20.0, "ambient in 1 steps": 21.0}), 6 * DT)
    assert found == pytest.approx(
        {"T": 30.0, "ambient": 20.0, "ambient in 1 steps": 21.0, "ambient in 2 steps": 21.0, "cos day": 0, "sin day": 1}
    )


def test_options_that_cannot_be_are_refused() -> None:
    clock, device, policy = lab()
    for options in ({"fallback": {"power": 120.0}}, {"fallback": {"steam": 1.0}}, {"deadline": 9.0}, {"transfer": 0}):
        with pytest.raises((ValueError, LookupError)):
            Service(policy, device, clock=clock, **options)  # type: ignore[arg-type]


# ---------------------------------------------------------------- a connection


def test_a_device_over_tcp_that_is_restarted() -> None:
    clock, device, policy = lab()
    with LineServer(device) as server:
        line = LineDevice(server.host, server.port)
        assert line.read() == device.read()
        line.write({"power": 12.5})
        assert device.read().inputs == {"power": 12.5}
        stats = Service(policy, line, clock=clock).run(5)
        assert stats.decided == 5
        port = server.port
    with pytest.raises(DeviceError):
        line.read()
    stats = Service(policy, line, clock=clock).run(5)
    assert (stats.lost, stats.unwritten) == (5, 5)
    with LineServer(device, port=port):
        assert Service(policy, line, clock=clock).run(5).decided == 5
    line.close()


def test_late_and_foreign_answers_are_not_taken() -> None:
    answers = {
        1: [{"id": 0, "values": {"T": 1.0}}, "noise", {"id": 1, "values": {"T": 2.0}, "inputs": {"power": None}}],
        2: [{"id": 1, "values": {"T": 3.0}}, {"id": 2, "error": "sensor broken"}],
        3: ["{"],
    }
    listening = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        connection, _ = listening.accept()
        with connection, connection.makefile("rw") as file:
            for line in file:
                for each in answers[json.loads(line)["id"]]:
                    file.write((each if each == "{" else json.dumps(each)) + "\n")
                file.flush()

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    device = LineDevice(*listening.getsockname())
    found = device.read()
    assert found.values == {"T": 2.0}
    assert np.isnan(found.inputs["power"])
    with pytest.raises(DeviceError, match="sensor broken"):
        device.read()
    with pytest.raises(DeviceError, match="expected an answer"):
        device.write({"power": 1.0})
    thread.join(5.0)
    listening.close()


def test_a_call_that_hangs_is_left_to_itself() -> None:
    clock, gate = SystemClock(), threading.Event()
    with pytest.raises(TimeoutError, match="no answer in time"):
        clock.call("read", gate.wait, clock.now())
    with pytest.raises(TimeoutError, match="still under way"):
        clock.call("read", lambda: True, clock.now())
    gate.set()
    assert clock.call("read", lambda: 5, clock.now() + 10.0) == 5
    with pytest.raises(ZeroDivisionError):
        clock.call("read", lambda: 1 // 0, clock.now() + 10.0)


def test_a_simulated_device_brings_itself_to_rest() -> None:
    clock, policy = VirtualClock(), POLICIES["plain"]
    device = SimulatedDevice(PLANTS["plain"].env(), policy.mpc, clock, inputs={"power": 3.0}, watchdog=4)
    device.write({"power": 50.0})
    clock.advance(4 * DT)
    assert device.read().inputs == {"power": 50.0}
    clock.advance(DT)
    assert device.read().inputs == {"power": 3.0}


def test_the_command_simulates_a_trial(tmp_path: Path) -> None:
    file, policy, log = tmp_path / "heater.py", tmp_path / "policy.zip", tmp_path / "trial.csv"
    file.write_text("from planted_logs import heater\nplant = heater()\n")
    POLICIES["plain"].save(policy)
    command = ["serve", str(policy), "--simulate", str(file), "--log", str(log), "--periods", "30"]
    result = CliRunner().invoke(app, [*command, "--fallback", "power=0"])
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("30 periods, 30 decided by the policy")
    assert len(log.read_text().splitlines()) == 31
    document = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert (document["periods"], document["lost"]) == (30, 0)
    assert CliRunner().invoke(app, command[:2]).exit_code == 2
    assert CliRunner().invoke(app, ["serve", str(policy), "--device", "nowhere"]).exit_code == 2
