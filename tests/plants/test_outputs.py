"""Plants of which sensors show something else than the states: description, environment, logs, identification."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3.common.env_checker
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from two_tanks import two_tanks

from mpcoffline import (
    Input,
    InvalidArgumentError,
    MPCPolicy,
    OfflineMPCLearner,
    Output,
    Parameter,
    Plant,
    State,
    TransitionTable,
)
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.datasets import record
from mpcoffline.plants.outputs import OutputReader, check_measured
from mpcoffline.tune import LogCheck
from mpcoffline.tune.output_check import _beginnings

PRESSURE = Output("pressure", lambda x: 1.0 + 0.0981 * x.h2, "mbar", low=1.0, high=5.0, noise=0.002)


def hidden(**changes: Any) -> Plant:
    """Two tanks of which a gauge shows the pressure below the lower one."""
    return two_tanks(outputs=[PRESSURE], **changes)


class Varied:
    """A pump that is moved now and then."""

    def __init__(self) -> None:
        self.rng, self.u = np.random.default_rng(0), 3.0

    def predict(self, observation: Any, *others: Any, **more: Any) -> tuple[Any, None]:
        if self.rng.random() < 0.2:
            self.u = self.rng.uniform(0.5, 5.5)
        return np.full((*np.shape(observation)[:-1], 1), self.u, np.float32), None


def test_the_environment_shows_outputs() -> None:
    plant = hidden()
    env = plant.env(noise=0.0, spread=0.0, signals={"set_point": 12.0})
    stable_baselines3.common.env_checker.check_env(env)
    y, info = env.reset(seed=1, options={"state": [9.0, 4.0]})
    np.testing.assert_allclose(y, [1.0 + 0.0981 * 4.0, 12.0], rtol=1e-6)
    noisy = plant.env(spread=0.0, signals={"set_point": 12.0})
    shown = [noisy.reset(seed=k, options={"state": [9.0, 4.0]})[0][0] for k in range(200)]
    assert np.std(shown) == pytest.approx(0.002, rel=0.2)
    assert info["state"].shape == (2,)
    np.testing.assert_allclose(plant.outputs_function([9.0, 4.0]).full().ravel(), [1.0 + 0.0981 * 4.0])


@pytest.mark.parametrize("delay", [0, 2])
def test_an_output_of_inputs_shows_those_that_acted_just_before(delay: int) -> None:
    """At rest before the episode, and dead time late."""
    pump = Input("pump", "V", 0, 6, usual=1.5, delay=delay)
    current = Output("current", lambda x, u: 0.5 * u.pump - 0.01 * x.h1, "A", noise=0.0)
    plant = two_tanks(inputs=[pump], outputs=["h2", current])
    assert plant.outputs_function.n_in() == 2
    env = plant.env(noise=0.0, spread=0.0)
    stable_baselines3.common.env_checker.check_env(env)
    y, info = env.reset(seed=1)
    applied = [1.5] * (delay + 1)
    for u in (3.0, 5.0, 2.0, 0.5):
        assert y[1] == pytest.approx(0.5 * applied[-1 - delay] - 0.01 * info["state"][0], abs=1e-6)
        y, *_, info = env.step(np.array([u], np.float32))
        applied.append(u)


def test_from_an_output_of_states_and_inputs_a_better_loop_is_learned_than_with_the_rough_model() -> None:
    """A mass on a spring, of which a load cell between it and its drive is all that is measured; the rough gain is half
    and the damping three times what they are."""

    def mass(gain: float, damping: float) -> Plant:
        return Plant(
            "mass",
            dt=0.2,
            states=[State("position", "m", -5, 5, start=(-1, 1)), State("speed", "m/s", -5, 5, start=(-0.5, 0.5))],
            inputs=[Input("push", "N", -3, 3)],
            parameters={"gain": Parameter(gain, spread=0.5), "damping": Parameter(damping, spread=0.5)},
            dynamics=lambda x, u, p: [x.speed, p.gain * u.push - x.position - p.damping * x.speed],
            cost={"position": 1.0, "push": 0.05},
            references={"position": 1.0},
            outputs=[Output("load", lambda x, u: u.push - x.position, "N", noise=0.02)],
            horizon=15,
            steps=40,
        )

    rough, env = mass(0.5, 1.2), mass(1.0, 0.4).env(spread=0.0)

    class Pushes:
        rng, u, k = np.random.default_rng(0), 0.0, 0

        def predict(self, observation: Any, *others: Any, **more: Any) -> tuple[Any, None]:
            self.u, self.k = self.rng.uniform(-2.5, 2.5) if self.k % 4 == 0 else self.u, self.k + 1
            return np.full((*np.shape(observation)[:-1], 1), self.u, np.float32), None

    log = TransitionTable.of(record(env, Pushes(), 6, "hidden/mass-v0", seed=0, overwrite=True))
    check = LogCheck()
    _beginnings(rough, log, check)
    assert not check.remarks
    found = rough.identify(log)
    for name, true in (("gain", 1.0), ("damping", 0.4)):
        i = found.names.index(f"model.{name}")
        assert abs(float(found.mpc.values[f"model.{name}"]) - true) < 4.0 * found.deviations[i]
        assert found.deviations[i] < 0.05 * true
    assert found.sensors.noise[0] == pytest.approx(0.02, rel=0.2)
    reader, mpc = OutputReader.of(rough), rough.mpc()
    again = OutputReader.from_json(json.loads(json.dumps(reader.to_json())), mpc)
    assert again.outputs.n_in() == 2
    learner = OfflineMPCLearner(mpc, preset="fast", candidate="full", value_n_steps=200)
    learner.fit(found, show_progress=False)

    def cost(policy: OutputFeedbackPolicy) -> float:
        return -float(evaluate_policy(policy, Monitor(env), n_eval_episodes=5)[0])

    sensors = found.sensors.suited(mpc, found.table)
    env.reset(seed=100)
    learned = cost(learner.output_policy)
    env.reset(seed=100)
    assert learned < 0.9 * cost(OutputFeedbackPolicy(MPCPolicy(mpc), sensors.observer(mpc)))


def test_names_of_states_stand_for_them() -> None:
    plant = two_tanks(outputs=["h2"])
    lower = plant.states[1]
    assert plant.outputs == (Output("h2", "h2", lower.unit, lower.low, lower.high, lower.deviation),)
    assert plant.measured == plant.outputs
    assert two_tanks().measured == two_tanks().states


def test_model_and_states_are_found_in_a_log_of_outputs_and_costs_are_theirs() -> None:
    truth = two_tanks(
        states=[State("h1", "cm", 0, 40, start=(2, 20)), State("h2", "cm", 0, 40, start=(2, 20))], outputs=[PRESSURE]
    )
    env = truth.env(spread=0.0, steps=60)
    dataset = record(env, Varied(), 8, "hidden/tanks-v0", seed=0, overwrite=True)
    log = TransitionTable.of(dataset)
    assert log.ny == 2
    exact = {name: parameter.value for name, parameter in truth.parameters.items()}
    rough = two_tanks(
        states=truth.states,
        outputs=[PRESSURE],
        parameters={name: Parameter(1.4 * float(value), spread=0.5) for name, value in exact.items()},
    )
    found = rough.identify(log)
    for name, deviation in zip(found.names, found.deviations, strict=True):
        value = float(found.mpc.values[name])
        assert abs(value - exact[name.removeprefix("model.")]) < 4.0 * deviation, name
        assert deviation < 0.1 * value
    assert found.sensors.noise[0] == pytest.approx(0.002, rel=0.1)
    columns = found.table.values()
    assert columns.observations.shape[1] == 3
    before = np.vstack([columns.actions[:1], columns.actions[:-1]])
    before[found.table.episodes.firsts] = columns.actions[found.table.episodes.firsts]
    expected = rough.costs(columns.observations[:, :2], columns.actions, columns.observations[:, 2:], before)
    np.testing.assert_allclose(columns.costs, expected, rtol=1e-5, atol=1e-5)
    learner = OfflineMPCLearner(rough.mpc(), preset="fast", candidate="full", value_n_steps=200)
    learner.fit(found, show_progress=False)
    action, _ = learner.output_policy.predict(np.array([1.5, 12.0], np.float32))
    assert action.shape == (1,)


def test_a_log_is_read_by_the_names_of_outputs(tmp_path: Path) -> None:
    pytest.importorskip("polars")
    file = tmp_path / "log.csv"
    rows = [f"{5 * k},{1.2 + 0.01 * k},{3 + k % 2},12" for k in range(12)]
    file.write_text("\n".join(["time [s],PI-7 [bar],pump [V],set_point [cm]", *rows]).replace("1.", "0.001"))
    plant = hidden(columns={"pressure": "PI-7"})
    table = plant.read(file)
    assert table.names == ("pressure [mbar]", "set_point [cm]", "pump [V]")
    assert not table.costs.any()


@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        ("h2", "expected a list of names of states"),
        (["h3"], "expected one of h1, h2"),
        ([Output("flow", "h3")], "output flow: of"),
        ([Output("pump", "h2")], "'pump' twice"),
        ([Output("h1", "h2")], "'h1' twice"),
        (["h2", "h2"], "'h2' twice"),
        ([Output("h2", lambda x: x.h2)], "'h2' twice.*by its name, 'h2', or as Output"),
        ([Output("flow", lambda x: x.h3)], "output flow"),
        ([Output("current", lambda x, u: u.pumps)], r"output current .*u.pumps: input.*expected one of pump"),
        ([Output("current", lambda x, v: v)], "expected a function of x, u .*an argument 'v'"),
        ([Output("current", "pump")], "lambda x, u: u.pump"),
        ([Output("flow", lambda x: [x.h1, x.h2])], "expected a number"),
    ],
)
def test_outputs_that_cannot_be_are_named(outputs: Any, words: str) -> None:
    with pytest.raises(InvalidArgumentError, match=words):
        two_tanks(outputs=outputs)


def test_what_an_output_is_made_of_is_checked() -> None:
    with pytest.raises(InvalidArgumentError, match="output q: of"):
        Output("q", 3)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgumentError, match="low < high"):
        Output("q", "h1", low=2.0, high=1.0)
    with pytest.raises(InvalidArgumentError, match="output q: noise"):
        Output("q", "h1", noise=-1.0)


def test_a_state_that_nobody_measures_says_where_it_begins() -> None:
    plant = two_tanks(states=[State("h1", "cm", 0, 40, start=5.0), State("h2", "cm", 0, 40)], outputs=["h2"])
    log = TransitionTable.from_arrays(
        np.ones((4, 2)), np.ones((4, 1)), np.ones(4), np.ones((4, 2)), np.zeros(4), np.zeros(4, int)
    )
    with pytest.raises(InvalidArgumentError, match="state h1: start: expected a range"):
        plant.identify(log)
    with pytest.raises(InvalidArgumentError, match="expected a plant with outputs"):
        two_tanks().identify(log)


def test_where_states_have_to_be_measured_it_says_what_to_do() -> None:
    with pytest.raises(InvalidArgumentError, match=r"`mpcoffline tune` estimates these; in Python: learner.fit"):
        check_measured(hidden(), "learn")
    check_measured(two_tanks(), "anything")
