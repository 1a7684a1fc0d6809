"""The learned MPC as an SB3 model: scripts, VecNormalize, callbacks, evaluation during a fit, videos, the zoo."""

from __future__ import annotations

import runpy
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import lq_plant
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DDPG
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from mpcoffline.control.evaluation import evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError
from mpcoffline.datasets import TransitionTable
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.mpc import MPC
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.sb3.model import EnvironmentEvaluator, MPCModel, SB3Callback, register_with_rl_zoo

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
STEPS = 12


def short_pendulum() -> MPC:
    return nominal_mpc(PENDULUM, alpha=0.5, seed=0).replace(horizon=15)


def make_env(**arguments: Any) -> gym.Env[Any, Any]:
    return gym.make(PENDULUM, max_episode_steps=STEPS, **arguments)


def make_vec(n: int = 2) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(make_env())] * n)


@pytest.fixture(scope="module")
def policy() -> MPCPolicy:
    """With the spaces of the environment, as that of a learner that saw a data set of it."""
    env = make_env()
    assert isinstance(env.observation_space, spaces.Box)
    assert isinstance(env.action_space, spaces.Box)
    return MPCPolicy(short_pendulum(), observation_space=env.observation_space, action_space=env.action_space)


@pytest.fixture
def file(tmp_path: Path, policy: MPCPolicy) -> Path:
    policy.save(tmp_path / "p.zip")
    return tmp_path / "p.zip"


def returns(model: Any, env: VecEnv, seed: int = 5) -> NDArray[np.float64]:
    """Returns of one episode of each environment, which start from the seed and its successors."""
    env.seed(seed)
    found, _ = evaluate_policy(model, env, env.num_envs, return_episode_rewards=True)
    return np.sort(found)


def true_returns(policy: MPCPolicy, n: int, seed: int = 5) -> NDArray[np.float64]:
    return np.sort(-evaluate(policy, make_env(), n, seed=seed).cost)


# ---------------------------------------------------------------- the face of a model


def test_has_the_face_of_an_sb3_model(file: Path) -> None:
    model = MPCModel.load(file, env=make_env())
    assert isinstance(model, BaseAlgorithm)
    env = model.get_env()
    assert isinstance(env, DummyVecEnv)
    assert env.env_is_wrapped(Monitor) == [True]
    assert (model.n_envs, model.device.type) == (1, "cpu")
    assert (model.observation_space, model.action_space) == (env.observation_space, env.action_space)
    assert model.get_vec_normalize_env() is None
    assert isinstance(model.policy, MPCPolicy)
    model.set_env(make_vec(3))
    assert model.n_envs == 3


def test_without_an_environment_it_predicts(file: Path, policy: MPCPolicy) -> None:
    model = MPCModel.load(str(file), device="cpu", custom_objects={"learning_rate": 0.0})
    assert (model.get_env(), model.n_envs) == (None, 1)
    assert model.observation_space == policy.observation_space
    y = make_env().reset(seed=0)[0]
    np.testing.assert_array_equal(model.predict(y)[0], policy.predict(y)[0])


def test_sb3_evaluates_the_model_to_the_costs_of_the_policy(file: Path, policy: MPCPolicy) -> None:
    model = MPCModel.load(file, env=make_vec(3))
    env = model.get_env()
    assert env is not None
    np.testing.assert_allclose(returns(model, env), true_returns(policy, 3), rtol=1e-5)
    np.testing.assert_allclose(returns(model.policy, env), true_returns(policy, 3), rtol=1e-5)


def test_ids_name_environments(policy: MPCPolicy) -> None:
    assert MPCModel(policy, PENDULUM).n_envs == 1


def test_names_of_files_are_those_of_sb3(tmp_path: Path, policy: MPCPolicy) -> None:
    MPCModel(policy).save(tmp_path / "new" / "best_model")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["best_model.zip"]
    loaded = MPCModel.load(tmp_path / "new" / "best_model")
    np.testing.assert_array_equal(loaded.policy.mpc.theta, policy.mpc.theta)
    with pytest.raises(FileNotFoundError, match=r"missing\.zip"):
        MPCModel.load(tmp_path / "missing")


def test_seeds_start_the_noise(file: Path) -> None:
    y = make_env().reset(seed=0)[0]
    model = MPCModel.load(file, seed=7)
    first = model.predict(y, deterministic=False)[0]
    assert first != model.predict(y, deterministic=False)[0]
    model.set_random_seed(7)
    assert first == model.predict(y, deterministic=False)[0]
    model.set_random_seed(None)
    assert first == MPCModel.load(file, seed=7).predict(y, deterministic=False)[0]


def test_system_info_is_printed_on_request(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    MPCModel.load(file, print_system_info=True)
    assert "Stable-Baselines3" in capsys.readouterr().out


# ---------------------------------------------------------------- refusals


def test_a_policy_for_another_environment_is_refused(file: Path, policy: MPCPolicy) -> None:
    cartpole = gym.make("mpcoffline/CartPoleSwingUp-v0")
    with pytest.raises(InvalidArgumentError) as refused:
        MPCModel.load(file, env=cartpole)
    assert str(refused.value).startswith("env.observation_space: expected the policy's Box")
    assert str(policy.observation_space) in str(refused.value)
    assert str(cartpole.observation_space) in str(refused.value)
    scaled = gym.wrappers.RescaleAction(make_env(), np.float32(-1.0), np.float32(1.0))
    with pytest.raises(InvalidArgumentError, match=r"env.action_space: expected the policy's Box\(-2.* got Box\(-1"):
        MPCModel.load(file, env=scaled)
    model = MPCModel(policy, make_env())
    with pytest.raises(InvalidArgumentError, match=r"env\.observation_space"):
        model.set_env(cartpole)
    with pytest.raises(InvalidArgumentError, match=r"env\.observation_space"):
        model.set_policy(MPCPolicy(lq_plant.make_mpc()))
    assert model.policy.mpc is policy.mpc


def test_a_policy_that_knows_no_bounds_takes_any_environment_of_its_shape() -> None:
    """As that of a learner that was fitted to a table."""
    assert MPCModel(MPCPolicy(short_pendulum()), make_env()).observation_space == make_env().observation_space


def test_observations_normalised_by_gymnasium_are_refused() -> None:
    policy = MPCPolicy(short_pendulum())
    with pytest.raises(InvalidArgumentError, match=r"env: .* in their units, or .* got gymnasium\.wrappers\.Normalize"):
        MPCModel(policy, gym.wrappers.NormalizeObservation(make_env()))


def test_learning_is_refused_by_naming_who_learns(policy: MPCPolicy) -> None:
    with pytest.raises(MPCOfflineError, match=r"OfflineMPCLearner\(mpc\)\.fit\(dataset\)"):
        MPCModel(policy).learn(1000)
    with pytest.raises(MPCOfflineError, match=r"no networks.*MPCModel\.load"):
        MPCModel(policy).set_parameters({})


def test_other_files_are_refused(tmp_path: Path, file: Path) -> None:
    DDPG("MlpPolicy", make_env(), buffer_size=10).save(tmp_path / "ddpg")
    with pytest.raises(FileFormatError, match="expected an mpcoffline policy file"):
        MPCModel.load(tmp_path / "ddpg")
    (tmp_path / "cut.zip").write_bytes(file.read_bytes()[:-200])
    with pytest.raises(FileFormatError, match=r"cut\.zip: expected an mpcoffline policy file"):
        MPCModel.load(tmp_path / "cut")
    OfflineMPCLearner(lq_plant.make_mpc()).save(tmp_path / "unfitted.zip")
    with pytest.raises(MPCOfflineError, match="expected a learner that has learned"):
        MPCModel.load(tmp_path / "unfitted")


# ---------------------------------------------------------------- VecNormalize


def test_normalised_observations_are_un_normalised(policy: MPCPolicy) -> None:
    """While the statistics still change, under normalised rewards; the Monitor inside reports the true ones."""
    env = VecNormalize(make_vec(3), clip_obs=100.0)
    model = MPCModel(policy, env)
    assert model.get_vec_normalize_env() is env
    expected = true_returns(policy, 3)
    np.testing.assert_allclose(returns(model, env), expected, rtol=1e-4)
    np.testing.assert_allclose(returns(policy.with_normalization(env), env), expected, rtol=1e-4)
    assert np.abs(returns(policy, env) - expected).max() > 0.1  # the policy alone cannot know
    raw = make_vec(3)
    model.set_env(raw)
    np.testing.assert_allclose(returns(model, raw), expected, rtol=1e-5)


def test_rewards_alone_may_be_normalised(policy: MPCPolicy) -> None:
    env = VecNormalize(make_vec(2), norm_obs=False)
    np.testing.assert_array_equal(returns(MPCModel(policy, env), env), returns(policy, env))


def test_clipped_observations_are_reported_once(policy: MPCPolicy, caplog: pytest.LogCaptureFixture) -> None:
    env = VecNormalize(make_vec(2), clip_obs=0.7)
    returns(MPCModel(policy, env), env)
    assert [record.getMessage() for record in caplog.records] == [
        "VecNormalize clipped an observation at 0.7: the MPC sees another state."
    ]


# ---------------------------------------------------------------- during a fit


@pytest.fixture(scope="module")
def table() -> TransitionTable:
    """Steps of the pendulum from anywhere under random inputs."""
    env, rng = make_env(), np.random.default_rng(0)
    env.reset(seed=0)
    rows = []
    for _ in range(20):
        y, _ = env.reset()
        for _ in range(STEPS):
            u = rng.uniform(-2.0, 2.0, 1).astype(np.float32)
            after, _, _, _, info = env.step(u)
            rows.append((y, u, info["cost"], after))
            y = after
    y, u, cost, after = (np.stack(column) for column in zip(*rows, strict=True))
    return TransitionTable.from_arrays(y, u, cost, after, np.zeros(len(y), dtype=bool))


def quick() -> OfflineMPCLearner:
    return OfflineMPCLearner(short_pendulum(), preset="paper", value_n_steps=4, fit_n_steps=4, seed=0)


def test_a_policy_is_evaluated_at_each_epoch_of_a_fit(table: TransitionTable, tmp_path: Path) -> None:
    costs: list[float] = []

    def cost(learner: OfflineMPCLearner, table: TransitionTable) -> float:
        costs.append(float(evaluate(learner.policy, make_env(), 3, seed=2).cost.mean()))
        return costs[-1]

    evaluators = {"return": EnvironmentEvaluator(make_vec(3), 3, seed=2), "cost": cost}
    learner = quick()
    history = learner.fit(table, n_steps_per_epoch=2, evaluators=evaluators, show_progress=False)
    assert ["return" in metrics for _, metrics in history] == [False, False, True, True, True]
    np.testing.assert_allclose([metrics["return"] for _, metrics in history[2:]], -np.array(costs), rtol=1e-5)
    learner.save(tmp_path / "learner.zip")
    model = MPCModel.load(tmp_path / "learner", env=make_vec(3))
    env = model.get_env()
    assert env is not None
    np.testing.assert_allclose(returns(model, env, seed=2).mean(), history[-1][1]["return"], rtol=1e-9)


def test_evaluators_take_an_environment_or_its_id(table: TransitionTable) -> None:
    """One environment, normalised or not: its first episode starts from the seed."""
    learner = quick()
    learner.fit(table, show_progress=False)
    expected = true_returns(learner.policy, 1)
    for env in (make_env(), VecNormalize(make_vec(1), clip_obs=100.0)):
        np.testing.assert_allclose(EnvironmentEvaluator(env, 1, seed=5)(learner, table), expected, rtol=1e-4)
    whole = -evaluate(learner.policy, PENDULUM, 1, seed=5).cost
    np.testing.assert_allclose(EnvironmentEvaluator(PENDULUM, 1, seed=5)(learner, table), whole, rtol=1e-5)
    with pytest.raises(InvalidArgumentError, match="n_episodes: expected a positive integer"):
        EnvironmentEvaluator(PENDULUM, 0)


class Recorded(KVWriter):
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, dict[str, Any]]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows.append((step, dict(key_values)))

    def close(self) -> None:
        pass


def test_eval_callback_evaluates_logs_and_keeps_the_best(table: TransitionTable, tmp_path: Path) -> None:
    env, output = make_vec(2), Recorded()
    best = EvalCallback(env, n_eval_episodes=2, eval_freq=1, best_model_save_path=str(tmp_path), log_path=str(tmp_path))
    steps: list[int] = []
    quick().fit(
        table,
        n_steps_per_epoch=2,
        callbacks=[
            SB3Callback(best, logger=Logger(None, [output])),
            lambda learner, epoch, total_step: steps.append(total_step),
        ],
        show_progress=False,
    )
    with np.load(tmp_path / "evaluations.npz") as stored:
        assert stored["timesteps"].tolist() == steps[2:] == [step for step, _ in output.rows]
        assert stored["results"].shape == (3, 2)
        means = stored["results"].mean(axis=1)
    np.testing.assert_allclose([values["eval/mean_reward"] for _, values in output.rows], means)
    assert best.best_mean_reward == means.max()
    assert MPCModel.load(tmp_path / "best_model", env=env).policy.mpc.horizon == 15


def test_other_callbacks_save_and_ask_to_stop(
    table: TransitionTable, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    enough = EvalCallback(
        make_vec(1), callback_on_new_best=StopTrainingOnRewardThreshold(-1e9), n_eval_episodes=1, eval_freq=1
    )
    checkpoints, stopping = SB3Callback(CheckpointCallback(1, str(tmp_path), "mpc")), SB3Callback(enough)
    learner = quick()
    with caplog.at_level("INFO"):
        history = learner.fit(table, n_steps_per_epoch=2, callbacks=[checkpoints, stopping], show_progress=False)
    assert learner.result is None  # not at the end
    assert len(history) == 3
    assert "EvalCallback ends the fit after epoch 3" in caplog.text
    (saved,) = tmp_path.iterdir()
    np.testing.assert_array_equal(MPCModel.load(saved).policy.mpc.theta, learner.mpc.theta)


# ---------------------------------------------------------------- videos


def test_frames_are_rendered_from_the_model_s_environment(policy: MPCPolicy) -> None:
    env = MPCModel(policy, make_env(render_mode="rgb_array")).get_env()
    assert env is not None
    env.reset()
    frame = env.render("rgb_array")
    assert frame is not None
    assert frame.ndim == 3
    assert frame.dtype == np.uint8


@pytest.mark.skipif(find_spec("moviepy") is None, reason='needs pip install "mpcoffline[video]"')
@pytest.mark.parametrize("by", ["gymnasium", "sb3"])
def test_videos_are_recorded(policy: MPCPolicy, tmp_path: Path, by: str) -> None:
    from stable_baselines3.common.vec_env import VecVideoRecorder

    env = make_env(render_mode="rgb_array")
    if by == "gymnasium":
        evaluate_policy(policy, gym.wrappers.RecordVideo(env, str(tmp_path)), n_eval_episodes=1, warn=False)
    else:
        model = MPCModel(policy, env)
        vec_env = VecVideoRecorder(model.get_env(), str(tmp_path), lambda step: step == 0, video_length=STEPS)
        observations, state = vec_env.reset(), None
        for _ in range(STEPS + 1):
            actions, state = model.predict(observations, state)
            observations, *_ = vec_env.step(actions)
        vec_env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


# ---------------------------------------------------------------- the zoo


def test_the_model_joins_the_zoo_s_algorithms(monkeypatch: pytest.MonkeyPatch) -> None:
    zoo = SimpleNamespace(ALGOS={"ddpg": DDPG})
    monkeypatch.setitem(sys.modules, "rl_zoo3", zoo)  # type: ignore[arg-type]
    register_with_rl_zoo()
    register_with_rl_zoo()
    assert zoo.ALGOS["mpc"] is MPCModel
    with pytest.raises(InvalidArgumentError, match="name: expected one that rl_zoo3 does not use, got 'ddpg'"):
        register_with_rl_zoo("ddpg")
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgumentError, match=r"expected the package rl_zoo3.*pip install rl_zoo3"):
        register_with_rl_zoo()


@pytest.fixture
def zoo_arguments(policy: MPCPolicy, tmp_path: Path) -> str:
    """Of the zoo's programs, for a folder as they know it."""
    pytest.importorskip("rl_zoo3", reason="needs pip install rl_zoo3")
    register_with_rl_zoo()
    name = PENDULUM.replace("/", "-")
    MPCModel(policy).save(tmp_path / "mpc" / f"{name}_1" / name)
    return f"--algo mpc --env {PENDULUM} --folder {tmp_path} --seed 3"


@pytest.mark.interop
def test_the_zoo_s_enjoy_runs_the_model(
    policy: MPCPolicy, zoo_arguments: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from rl_zoo3.enjoy import enjoy

    options = f"{zoo_arguments} --gym-packages mpcoffline -n 150 --no-render"
    monkeypatch.setattr(sys, "argv", ["enjoy", *options.split()])
    enjoy()
    reported = capsys.readouterr().out
    assert f"Episode Reward: {-evaluate(policy, PENDULUM, 1, seed=3).cost[0]:.2f}\nEpisode Length 100" in reported


@pytest.mark.interop
def test_the_zoo_s_record_video_films_the_model(
    zoo_arguments: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("moviepy")
    monkeypatch.setattr(sys, "argv", ["record_video", *f"{zoo_arguments} -n 5 -o {tmp_path}/videos".split()])
    runpy.run_module("rl_zoo3.record_video", run_name="__main__")
    (video,) = (tmp_path / "videos").glob("*.mp4")
    assert video.stat().st_size > 1000
