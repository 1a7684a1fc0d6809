"""Plants of which sensors show something else than the states: description, environment, logs, identification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3.common.env_checker
from two_tanks import two_tanks

from mpcoffline import InvalidArgumentError, OfflineMPCLearner, Output, Parameter, Plant, State, TransitionTable
from mpcoffline.datasets import record
from mpcoffline.plants.outputs import check_measured

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
        ([Output("flow", lambda x: x.h3)], "output flow"),
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
