"""The learned MPC where other libraries predict and collect: d3rlpy and Minari."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import lq_plant
import minari
import numpy as np
import pytest
from riccati import optimum

from mpcoffline.control.evaluation import evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.control.predictors import D3rlpyPredictor
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import TransitionTable, record
from mpcoffline.datasets.interop.convert import to_d3rlpy
from mpcoffline.plants.nominal import nominal_mpc

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
STEPS = 12


@pytest.fixture(scope="module")
def pendulum() -> MPCPolicy:
    return MPCPolicy(nominal_mpc(PENDULUM, alpha=0.5, seed=0).replace(horizon=15))


def make_env(**arguments: Any) -> gym.Env[Any, Any]:
    return gym.make(PENDULUM, max_episode_steps=STEPS, **arguments)


def test_predicts_actions_and_returns_of_the_optimum() -> None:
    """True model and cost, T = V*: u = K x, Q(x, u) = x'Wx + u'Ru + gamma V(Ax + Bu), and returns are minus costs."""
    predictor = D3rlpyPredictor(MPCPolicy(lq_plant.make_mpc(model=(lq_plant.A, lq_plant.B))))
    best = optimum(lq_plant.A, lq_plant.B, lq_plant.W, lq_plant.R, lq_plant.DISCOUNT)
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1, 1, (6, 2)).astype(np.float32), rng.uniform(-1, 1, (6, 1)).astype(np.float32)
    np.testing.assert_allclose(predictor.predict(x), x @ best.K.T, atol=1e-5)
    after = x @ lq_plant.A.T + u @ lq_plant.B.T
    stage = lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)
    cost = stage + lq_plant.DISCOUNT * lq_plant.quadratic(best.P, after)
    np.testing.assert_allclose(predictor.predict_value(x, u), -cost, rtol=1e-6)
    assert (predictor.gamma, predictor.action_size) == (lq_plant.DISCOUNT, 1)
    with pytest.raises(InvalidArgumentError, match="observation: expected shape"):
        predictor.predict(u)


def test_samples_with_the_policy_s_noise(pendulum: MPCPolicy) -> None:
    y = np.array([[1.0, 0.0, 0.0]] * 3)
    pendulum.set_random_seed(4)
    sampled = D3rlpyPredictor(pendulum).sample_action(y)
    pendulum.set_random_seed(4)
    np.testing.assert_array_equal(sampled, pendulum(y, deterministic=False))
    assert len(np.unique(sampled)) == 3


@pytest.mark.interop
@pytest.mark.skipif(find_spec("d3rlpy") is None, reason="runs in an environment of its own: scripts/test_interop")
def test_d3rlpy_evaluates_the_policy(pendulum: MPCPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import d3rlpy
    from pendulum_data import stored

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    class Seeded(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **_: Any) -> Any:
            return self.env.reset(seed=5)

    predictor = D3rlpyPredictor(pendulum)
    data = to_d3rlpy(stored())
    found = d3rlpy.metrics.EnvironmentEvaluator(Seeded(make_env()), n_trials=1)(predictor, data)
    np.testing.assert_allclose(found, -evaluate(pendulum, make_env(), 1, seed=5).cost, rtol=1e-5)
    table = TransitionTable.from_minari(minari.load_dataset("test/set-v0"))
    y, u, cost, after = table.observations, table.actions, table.costs, table.next_observations
    errors = -cost + predictor.gamma * predictor.predict_value(after, pendulum(after)) - predictor.predict_value(y, u)
    td = d3rlpy.metrics.TDErrorEvaluator()(predictor, data)
    np.testing.assert_allclose(td, np.mean(errors**2), rtol=1e-3)
    assert d3rlpy.metrics.ContinuousActionDiffEvaluator()(predictor, data) > 0.0


@pytest.mark.interop
@pytest.mark.skipif(find_spec("jax") is None, reason='Minari\'s collector needs pip install "minari[create]" (jax)')
def test_minari_s_data_collector_records_the_exploring_policy(
    pendulum: MPCPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = minari.DataCollector(make_env(), record_infos=True)
    pendulum.set_random_seed(0)
    applied = []
    for episode in range(3):
        observation, _ = env.reset(seed=episode)
        state, done = None, False
        while not done:
            action, state = pendulum.predict(observation, state, deterministic=False)
            observation, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
            applied.append(action)
    dataset = env.create_dataset("mine/pendulum/mpc-v0", eval_env=PENDULUM)
    env.close()
    assert (dataset.total_episodes, dataset.total_steps) == (3, 3 * STEPS)
    np.testing.assert_array_equal(TransitionTable.from_minari(dataset).actions, np.stack(applied))


def test_the_exploring_policy_is_recorded(pendulum: MPCPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    pendulum.set_random_seed(0)
    dataset = record(make_env(), pendulum, 3, "mine/pendulum/mpc-v0", seed=0, deterministic=False)
    table = TransitionTable.from_minari(dataset)
    assert len(table) == 3 * STEPS
    spread = table.actions - pendulum(table.observations)
    assert 0.1 < spread.std() < 0.8  # 0.1 of the range of 4, clipped here and there
