"""A described plant as a Gymnasium environment, against its own model and equations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker
from gymnasium.utils.env_checker import check_env
from two_tanks import two_tanks

from mpcoffline import Input, InvalidArgumentError, Signal, State, TransitionTable, evaluate
from mpcoffline.core.errors import UnknownIdError
from mpcoffline.datasets import record
from mpcoffline.plants import PlantEnv


class Constant:
    """A pump that runs at 3 V."""

    def predict(self, observation: Any, *others: Any, **more: Any) -> tuple[Any, None]:
        return np.full((*np.shape(observation)[:-1], 1), 3.0, np.float32), None


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized.*")
def test_it_is_what_gymnasium_and_sb3_ask_for() -> None:
    env = two_tanks().env()
    check_env(env.unwrapped, skip_render_check=True)
    stable_baselines3.common.env_checker.check_env(env)


def test_without_noise_and_spread_it_moves_as_the_model() -> None:
    plant = two_tanks()
    env = plant.env(noise=0.0, spread=0.0, signals={"set_point": 12.0})
    y, _ = env.reset(seed=1)
    _, reward, *_, info = env.step(np.array([3.0], np.float32))
    reached = plant.mpc().model(np.asarray(y, np.float64), [3.0])
    np.testing.assert_allclose(info["state"], reached[:2], rtol=1e-6)
    assert info["cost"] == pytest.approx((float(y[1]) - 12.0) ** 2 + 0.02 * 9.0, rel=1e-5)
    assert reward == -info["cost"]


def test_inputs_act_late_and_no_faster_than_described() -> None:
    plant = two_tanks(inputs=[Input("pump", "V", 0, 6, rate=1.5, delay=2)])
    env, still = plant.env(noise=0.0, spread=0.0), plant.env(noise=0.0, spread=0.0)
    start = {"state": [10.0, 10.0]}
    env.reset(seed=0, options=start)
    still.reset(seed=0, options=start)
    applied, difference = [], []
    for _ in range(4):
        info, other = (e.step(np.array([a], np.float32))[-1] for e, a in ((env, 6.0), (still, 0.0)))
        applied.append(float(info["applied"][0]))
        difference.append(float(info["state"][0] - other["state"][0]))
    assert applied == [1.5, 3.0, 4.5, 6.0]
    assert difference[:2] == [0.0, 0.0]
    assert difference[2] > 0.4


def test_parameters_signals_and_noise_vary_with_the_seed_alone() -> None:
    plant = two_tanks()
    env = plant.env()
    drawn = [env.reset(seed=seed)[1]["parameters"] for seed in (3, 4, 3)]
    assert drawn[0] == drawn[2] != drawn[1]
    assert drawn[0]["c1"] == 0.07  # no spread
    ks = np.array([env.reset(seed=i)[1]["parameters"]["k"] for i in range(100)])
    assert 0.7 * 0.07 <= ks.min() < 0.8 * 0.07
    assert 1.2 * 0.07 < ks.max() <= 1.3 * 0.07
    noises = np.array([y[:2] - info["state"] for y, info in (env.reset(seed=i) for i in range(200))])
    assert noises.std() == pytest.approx(0.2, rel=0.15)  # 0.5 % of 40 cm


def test_signals_with_preview_and_clocks_follow_their_courses() -> None:
    signals = [Signal("day", period=24), Signal("set_point", "cm", preview=2)]
    env = two_tanks(signals=signals).env(signals={"set_point": [1.0, 2.0, 3.0, 4.0]})
    y, _ = env.reset(seed=0)
    np.testing.assert_allclose(y[4:], [1.0, 2.0, 3.0])
    first = np.arctan2(y[3], y[2])
    y, *_ = env.step(np.array([1.0], np.float32))
    y, *_ = env.step(np.array([1.0], np.float32))
    np.testing.assert_allclose(y[4:], [3.0, 4.0, 4.0])
    assert (np.arctan2(y[3], y[2]) - first) % (2 * np.pi) == pytest.approx(2 * np.pi / 12, abs=1e-5)


def test_policies_recorder_and_tables_take_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env, policy = two_tanks().env(steps=12), Constant()
    result = evaluate(policy, env, n_episodes=2)
    assert result.length.tolist() == [12, 12]
    dataset = record(env, policy, 2, "mine/tanks/mpc-v0", seed=0)
    table = TransitionTable.from_minari(dataset)
    assert (len(table), table.ny, table.nu) == (24, 3, 1)
    rows = table.values()
    by_hand = (rows.observations[:, 1] - rows.observations[:, 2]) ** 2 + 0.02 * rows.actions[:, 0] ** 2
    assert np.abs(by_hand - rows.costs).max() < 2 * 20 * 4 * 0.2  # the plant's cost is that of the true states
    again = dataset.recover_environment()
    assert isinstance(again.unwrapped, PlantEnv)


def test_what_cannot_be_simulated_is_refused() -> None:
    with pytest.raises(InvalidArgumentError, match="input pump: expected low and high"):
        two_tanks(inputs=[Input("pump", "V")]).env()
    with pytest.raises(UnknownIdError, match="signal: expected one of set_point"):
        two_tanks().env(signals={"setpoint": 1.0})
    with pytest.raises(UnknownIdError, match="load_plant"):
        PlantEnv("never described")
    env = two_tanks().env()
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(np.zeros(1, np.float32))
    with pytest.raises(ValueError, match="reset option 'state'"):
        env.unwrapped.reset(options={"state": [1.0]})


def test_states_stay_within_their_range() -> None:
    env = two_tanks(states=[State("h1", "cm", 0, 5), State("h2", "cm", 0, 40)], limits=[]).env(noise=0.0)
    env.reset(seed=0)
    for _ in range(60):
        *_, info = env.step(np.array([6.0], np.float32))
    assert info["state"][0] == 5.0
