"""A loop whose policy sees outputs: the observer is told what was applied, whoever decided it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import pytest

from mpcoffline import Input, MPCPolicy, Output, Plant, State
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.control.serving import DecisionLog, Measurement, Service, SimulatedDevice, VirtualClock
from mpcoffline.core.types import Array
from mpcoffline.estimation import KalmanObserver
from mpcoffline.mpc.labels import Label

DT = 5.0


def plant_of(delay: int = 0, fed: float = 0.0) -> Plant:
    """A slow wall and a room, of which the room is measured, in degrees and by a gauge that feels the heater."""
    return Plant(
        "room",
        dt=DT,
        states=[
            State("wall", "K", 0, 80, start=(5, 15), noise=0.0),
            State("room", "K", 0, 80, start=(5, 15), noise=0.0),
        ],
        inputs=[Input("power", "%", 0, 100, delay=delay)],
        dynamics=lambda x, u: [0.01 * (x.room - x.wall), 0.01 * (x.wall - 2.0 * x.room + u.power)],
        cost={"room": 1.0, "power": 1e-3},
        references={"room": 25.0},
        outputs=[
            Output("room", "room", "K", noise=0.0),
            Output("gauge", lambda x, u: x.room**2 / 50.0 + fed * u.power, "mV", noise=0.0),
        ],
        horizon=20,
        steps=1_000,
    )


def policy_of(plant: Plant) -> OutputFeedbackPolicy:
    mpc = plant.mpc()
    labels = [Label(output.name, output.unit) for output in plant.outputs]
    known = {"start": [10.0, 10.0], "start_spread": 5.0, "labels": labels}
    observer = KalmanObserver(mpc, plant.outputs_function, [0.1, 0.1], 0.01, **known)
    return OutputFeedbackPolicy(MPCPolicy(mpc), observer)


class Failing:
    """A device that at times measures nothing, or lacks a sensor."""

    def __init__(self, device: SimulatedDevice, silent: range, lacking: Mapping[str, range]) -> None:
        self.device, self.silent, self.lacking, self.n = device, silent, lacking, -1
        self.applied: list[float] = []

    def read(self) -> Measurement:
        self.n += 1
        measured = self.device.read()
        if self.n in self.silent:
            raise TimeoutError("silence")
        lost = {name: float("nan") for name, when in self.lacking.items() if self.n in when}
        return Measurement({**measured.values, **lost}, measured.inputs)

    def write(self, inputs: Mapping[str, float]) -> None:
        self.applied.append(inputs["power"])
        self.device.write(inputs)


class Shown(gym.Wrapper[Any, Any, Any, Any]):
    """The environment, with the true state to look at."""

    state: Array

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        y, info = super().reset(**options)
        self.state = info["state"]
        return y, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        y, reward, terminated, truncated, info = super().step(action)
        self.state = info["state"]
        return y, reward, terminated, truncated, info


def lab(policy: OutputFeedbackPolicy, plant: Plant) -> tuple[VirtualClock, SimulatedDevice, Shown]:
    clock, env = VirtualClock(1.7e9), Shown(plant.env(spread=0.0))
    return clock, SimulatedDevice(env, policy.mpc, clock, seed=3, measured=policy.y_labels), env


def states_of(policy: OutputFeedbackPolicy, service: Service) -> Array:
    known = service._carried._known
    assert known is not None
    return np.asarray(policy.observer.states(known)[0])


@pytest.mark.parametrize("delay", [0, 2])
def test_a_sound_loop_does_what_the_policy_does_in_the_environment(delay: int) -> None:
    plant = plant_of(delay)
    policy = policy_of(plant)
    clock, device, _ = lab(policy, plant)
    watched = Failing(device, range(0), {})
    stats = Service(policy, watched, clock=clock, transfer=1).run(40)
    same, state, actions = plant.env(spread=0.0), None, []
    y, _ = same.reset(seed=3)
    for _ in range(40):
        u, state = policy.predict(y, state)
        actions.append(float(u[0]))
        y, *_ = same.step(u)
    assert stats.decided == 40
    assert watched.applied == pytest.approx(actions, rel=1e-5, abs=1e-4)


@pytest.mark.parametrize(("delay", "fed"), [(0, 0.0), (2, 0.0), (0, 0.2), (2, 0.2)])
def test_it_knows_the_state_through_transfer_silence_and_a_lost_sensor(delay: int, fed: float) -> None:
    """An exact model without noise: whatever was applied, the estimate stays where the plant is."""
    plant = plant_of(delay, fed)
    policy = policy_of(plant)
    clock, device, env = lab(policy, plant)
    failing = Failing(device, range(30, 45), {"gauge": range(10, 20), "room": range(22, 27)})
    service = Service(policy, failing, clock=clock, transfer=8, hold=3, fallback={"power": 90.0})
    for k in range(1, 61):
        service.run(1)
        if k in (9, 20, 27, 42, 60):
            np.testing.assert_allclose(states_of(policy, service), env.state[:2], atol=0.3 if k == 9 else 0.1)
        clock.advance(DT)
    stats = service.stats
    assert (stats.lost, stats.held, stats.fallbacks) == (15, 3, 12)
    assert stats.decided == 45


def test_inputs_that_were_taken_but_not_confirmed_count_as_the_device_says() -> None:
    plant = plant_of()
    policy = policy_of(plant)
    clock, device, env = lab(policy, plant)

    class Deaf(Failing):
        """It takes every input; of some it says nothing."""

        def write(self, inputs: Mapping[str, float]) -> None:
            super().write(inputs)
            if 5 <= self.n < 12:
                raise TimeoutError("no answer")

    service = Service(policy, Deaf(device, range(0), {}), clock=clock, transfer=1)
    for k in range(16):
        service.run(1)
        if k == 15:
            np.testing.assert_allclose(states_of(policy, service), env.state[:2], atol=0.1)
        clock.advance(DT)
    assert service.stats.unwritten == 7


def test_the_log_has_the_outputs(tmp_path: Path) -> None:
    plant = plant_of()
    policy = policy_of(plant)
    clock, device, _ = lab(policy, plant)
    path = tmp_path / "trial.csv"
    with DecisionLog(path, policy.mpc, policy.y_labels) as log:
        Service(policy, Failing(device, range(0), {"gauge": range(3, 5)}), clock=clock, log=log).run(30)
    head = path.read_text().splitlines()[0]
    assert head.startswith("time,room [K],gauge [mV],power [%],wanted power [%],decided_by")
    table = plant.read(path)
    assert table.names[:2] == ("room [K]", "gauge [mV]")
