"""evaluate() and record() around a plant: whose reward counts, in which units, for how long, and which environment."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from drift_plant import Drift, HalfAction, HalfObservation, Plain, Tenth, Twice, Zero, costly, unsafe
from gymnasium import spaces, wrappers
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from mpcoffline.control.evaluation import evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, UnknownIdError
from mpcoffline.datasets import record
from mpcoffline.datasets.check.rebuilding import rebuilt_spec
from mpcoffline.datasets.recording.plants import MAX_EPISODE_STEPS
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.sb3.model import EnvironmentEvaluator, MPCModel

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


@pytest.fixture
def drift() -> Iterator[str]:
    gym.register("test/Drift-v0", entry_point="drift_plant:Drift", disable_env_checker=True)
    yield "test/Drift-v0"
    gym.registry.pop("test/Drift-v0")


@pytest.fixture(scope="module")
def mpc_policy() -> MPCPolicy:
    return MPCPolicy(nominal_mpc(PENDULUM).replace(horizon=3))


REWARD_WRAPPERS = [
    lambda env: wrappers.TransformReward(env, lambda reward: 0.1 * reward),
    wrappers.NormalizeReward,
    lambda env: wrappers.ClipReward(env, -0.1, 0.1),
    Tenth,
    Monitor,
    Plain,
]


# ---------------------------------------------------------------- whose reward


@pytest.mark.parametrize("info", [None, costly, unsafe])
@pytest.mark.parametrize("wrap", REWARD_WRAPPERS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_plants_cost_is_judged_and_recorded(wrap: Any, info: Any) -> None:
    plant = Drift(info=info)
    result = evaluate(Zero(0.5), wrap(plant), 3, seed=2)
    assert result.cost.sum() == pytest.approx(-sum(plant.paid), rel=1e-12)
    plant.paid.clear()
    dataset = record(wrap(plant), Zero(0.5), 3, "test/paid-v0", seed=2, overwrite=True)
    assert [reward for episode in dataset for reward in episode.rewards] == plant.paid
    assert all(("cost" in episode.infos) == (info is costly) for episode in dataset)


def test_what_counts_is_told_once() -> None:
    env = Drift(info=unsafe)
    for run in (
        lambda: evaluate(Zero(0.5), env, 3),
        lambda: record(env, Zero(0.5), 3, "test/told-v0", seed=0, overwrite=True),
    ):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            run()
        assert len([each for each in told if "info['cost']" in str(each.message)]) == 1


def test_a_claimed_key_is_held_to() -> None:
    env = Drift(info=lambda k, cost: {"energy": cost})
    assert (evaluate(Zero(), env, 1, cost_key="energy").cost == evaluate(Zero(), env, 1).cost).all()
    for key, error in (("cost", InvalidArgumentError), ("energy", InvalidDataError)):
        wrong = Drift(info=lambda k, cost: {"energy": cost + 1.0})
        with pytest.raises(error, match=rf"info\['{key}'\]"):
            evaluate(Zero(), wrong, 1, cost_key=key)
        with pytest.raises(error, match=rf"info\['{key}'\]"):
            record(wrong, Zero(), 1, "test/claim-v0", cost_key=key)


def test_states_that_do_not_hold_are_observations() -> None:
    with pytest.warns(UserWarning, match=r"info\['state'\]"):
        result = evaluate(Zero(), Drift(info=lambda k, cost: {"state": np.zeros(1 + k % 2)}), 1)
    assert result.states[0].shape == (11, 1)


# ---------------------------------------------------------------- which units


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: wrappers.RescaleAction(env, np.float32(-10.0), np.float32(10.0)),
        lambda env: wrappers.RescaleObservation(env, np.float32(-1.0), np.float32(1.0)),
        wrappers.NormalizeObservation,
        lambda env: wrappers.TransformObservation(env, lambda y: 2.0 * y, env.observation_space),
        lambda env: wrappers.TransformAction(env, lambda u: 0.3 * u, env.action_space),
        HalfObservation,
        HalfAction,
        lambda env: Plain(HalfObservation(Monitor(env))),
    ],
)
def test_an_mpc_is_refused_wrappers_that_rescale(wrap: Any, mpc_policy: MPCPolicy) -> None:
    for policy in (mpc_policy, MPCModel(mpc_policy)):
        with pytest.raises(InvalidArgumentError, match=r"^env[.,:]"):
            evaluate(policy, wrap(gym.make(PENDULUM)), 1)
    for each in (mpc_policy, lambda y: np.full(1, 0.7, np.float32)):
        with pytest.raises(InvalidArgumentError, match=r"^env[.,:]"):
            record(wrap(gym.make(PENDULUM)), each, 1, "test/units-v0", seed=0)


def test_a_policy_that_learned_behind_wrappers_is_judged_by_the_plants_cost() -> None:
    plant = Drift()
    env = wrappers.RescaleAction(HalfObservation(plant), np.float32(-10.0), np.float32(10.0))
    with pytest.warns(UserWarning, match="a wrapper makes"):  # none of the reward: only where Tenth is around
        result = evaluate(Zero(5.0), Tenth(env), 2)
    np.testing.assert_allclose(np.concatenate(result.actions), 5.0)
    assert result.cost.sum() == pytest.approx(-sum(plant.paid))


def test_wrappers_that_add_to_the_observation_are_recorded_with_the_spec(drift: str) -> None:
    env = wrappers.TimeAwareObservation(gym.make(drift, max_episode_steps=10))
    dataset = record(env, Zero(), 1, "test/time-v0", seed=0)
    assert dataset.observation_space.shape == (2,)
    assert [each.name for each in dataset.env_spec.additional_wrappers] == ["TimeAwareObservation"]
    plain = record(Plain(gym.make(drift)), Zero(), 1, "test/plain-v0", seed=0)
    assert plain.env_spec.additional_wrappers == ()  # it could not be rebuilt


def test_a_wrapper_in_the_entry_point_is_part_of_the_plant() -> None:
    gym.register("test/Half-v0", entry_point="drift_plant:half_drift", disable_env_checker=True)
    try:
        dataset = record("test/Half-v0", Zero(), 1, "test/half-v0", seed=3)
        np.testing.assert_allclose(dataset[0].rewards, -((2.0 * dataset[0].observations[:-1, 0]) ** 2), rtol=1e-6)
    finally:
        gym.registry.pop("test/Half-v0")


@pytest.mark.parametrize("name", ["observation_space", "action_space"])
def test_a_policy_of_other_spaces_is_refused(name: str, mpc_policy: MPCPolicy) -> None:
    plant = Drift()
    size = {"observation_space": (3,), "action_space": (1,)}[name]
    setattr(plant, name, spaces.Box(-0.5, 0.5, size, np.float32))
    for run in (lambda p: evaluate(p, plant, 1), lambda p: record(plant, p, 1, "test/spaces-v0")):
        with pytest.raises(InvalidArgumentError, match=r"env\.(observation|action)_space.*the policy's"):
            run(mpc_policy)
    agent = DDPG("MlpPolicy", Drift(), device="cpu", buffer_size=10)
    with pytest.raises(InvalidArgumentError, match=rf"env\.{name}"):
        evaluate(agent, plant, 1)


def test_bounds_of_small_units_are_told_apart() -> None:
    policy = Zero()
    policy.action_space = spaces.Box(-2e-9, 2e-9, (1,), np.float32)  # type: ignore[attr-defined]
    plant = Drift()
    plant.action_space = spaces.Box(-1e-9, 1e-9, (1,), np.float32)
    with pytest.raises(InvalidArgumentError, match=r"env\.action_space"):
        evaluate(policy, plant, 1)


def test_an_mpc_may_keep_to_a_part_of_the_actions(mpc_policy: MPCPolicy) -> None:
    careful = MPCPolicy(mpc_policy.mpc, action_space=spaces.Box(-0.5, 1.0, (1,), np.float32))  # the plant: -2 to 2
    assert evaluate(careful, PENDULUM, 2).actions[0].max() <= 1.0
    assert record(PENDULUM, careful, 1, "test/part-v0").total_episodes == 1


# ---------------------------------------------------------------- statistics


def test_an_agent_sees_what_it_learned_from(tmp_path: Any) -> None:
    plant = Drift()
    venv = VecNormalize(DummyVecEnv([lambda: plant]))
    agent = DDPG("MlpPolicy", venv, learning_starts=10, train_freq=20, buffer_size=200, seed=0, device="cpu")
    agent.learn(100)
    before = venv.obs_rms.mean.copy()

    class Told(Zero):
        def predict(self, observation: Any, *rest: Any, **more: Any) -> Any:
            return agent.predict(venv.normalize_obs(np.asarray(observation)), deterministic=True)

    expected, found = (evaluate(policy, Drift(), 3, seed=5) for policy in (Told(), agent))
    np.testing.assert_array_equal(found.cost, expected.cost)
    stored = record(Drift(), agent, 3, "test/agent-v0", seed=5)
    assert [-episode.rewards.sum() for episode in stored] == pytest.approx(expected.cost)
    assert stored.storage.metadata["algorithm_name"] == "DDPG"
    np.testing.assert_array_equal(venv.obs_rms.mean, before)

    learner = PPO("MlpPolicy", venv, n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu")
    learner.learn(8)
    learner.save(tmp_path / "lost")
    with pytest.warns(UserWarning, match="learned under VecNormalize and is without its statistics"):
        evaluate(PPO.load(tmp_path / "lost", device="cpu"), Drift(), 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain = DDPG("MlpPolicy", Drift(), learning_starts=10, buffer_size=100, seed=0, device="cpu")
        plain.learn(20)
        plain.save(tmp_path / "plain")
        evaluate(DDPG.load(tmp_path / "plain", device="cpu"), Drift(), 1)


def test_an_mpc_that_undoes_a_normalisation_gets_plain_observations(mpc_policy: MPCPolicy) -> None:
    venv = VecNormalize(DummyVecEnv([lambda: gym.make(PENDULUM)]))
    venv.obs_rms.mean[:] = 5.0
    expected = evaluate(mpc_policy, PENDULUM, 2).cost
    for policy in (mpc_policy.with_normalization(venv), MPCModel(mpc_policy, venv)):
        np.testing.assert_allclose(evaluate(policy, PENDULUM, 2).cost, expected, rtol=1e-9)


def test_an_evaluator_counts_the_environments_own_reward(mpc_policy: MPCPolicy) -> None:
    class Learner:
        policy = mpc_policy

    venv = VecNormalize(DummyVecEnv([lambda: gym.make(PENDULUM)]))
    plain, normalised = (
        EnvironmentEvaluator(env, 2, seed=np.int64(3))(Learner(), None)  # type: ignore[arg-type]
        for env in (DummyVecEnv([lambda: gym.make(PENDULUM)]), venv)
    )
    assert normalised == pytest.approx(plain, rel=1e-5)
    assert (venv.training, venv.norm_reward, float(venv.obs_rms.count)) == (True, True, 1e-4)


# ---------------------------------------------------------------- which environment


def test_attributes_that_were_set_count() -> None:
    changed, made = gym.make(PENDULUM), gym.make(PENDULUM, m=3.0)
    changed.unwrapped.m = 3.0  # type: ignore[attr-defined]
    for start in (None, {"state": [1.0, 0.5]}):
        found, expected = (evaluate(Zero(0.5), env, 2, options=start).cost for env in (changed, made))
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def _weighted(weight: float) -> Any:
    return lambda k, cost: {"weight": weight}


class _Weights:
    def __init__(self, weight: float) -> None:
        self.weight = weight

    def info(self, k: int, cost: float) -> dict[str, Any]:
        return {"weight": self.weight}


class _Weighted(Drift):
    """Functions that hold something: a closure, a method of another object, and what holds the plant itself."""

    def __init__(self) -> None:
        super().__init__(info=_weighted(1.0))
        self.other, self.own, self.within = _Weights(1.0).info, self._observed, lambda: self.x


def test_what_functions_hold_counts() -> None:
    gym.register("test/Weighted-v0", _Weighted)
    try:
        assert rebuilt_spec(gym.make("test/Weighted-v0")) is not None
        for name, same, other in (
            ("info", _weighted(1.0), _weighted(5.0)),
            ("other", _Weights(1.0).info, _Weights(5.0).info),
        ):
            for value, rebuilt in ((same, True), (other, False)):
                env = gym.make("test/Weighted-v0")
                setattr(env.unwrapped, name, value)
                assert (rebuilt_spec(env) is not None) == rebuilt
    finally:
        gym.registry.pop("test/Weighted-v0")


def test_what_cannot_be_rebuilt_is_stepped_itself(drift: str) -> None:
    for env in (Plain(gym.make(drift)), Monitor(gym.make(drift)), Drift(), wrappers.RecordEpisodeStatistics(Drift())):
        result = evaluate(Zero(0.5), env, 3, seed=1)
        assert len(env.unwrapped.paid) == 30  # type: ignore[attr-defined]
        assert result.cost.sum() == pytest.approx(-sum(env.unwrapped.paid))  # type: ignore[attr-defined]
        assert "step" not in vars(env.unwrapped)
    untouched = gym.make(drift)
    np.testing.assert_array_equal(evaluate(Zero(0.5), untouched, 3, seed=1).cost, result.cost)
    assert untouched.unwrapped.paid == []  # type: ignore[attr-defined]


def test_copies_open_no_windows() -> None:
    class Windowed(Drift):
        metadata = {"render_modes": ["human"], "render_fps": 50}  # noqa: RUF012 -- gymnasium's
        windows = 0

        def __init__(self, render_mode: str | None = None) -> None:
            super().__init__()
            self.render_mode = render_mode
            Windowed.windows += render_mode == "human"

    gym.register("test/Windowed-v0", entry_point=Windowed, disable_env_checker=True)
    try:
        env = gym.make("test/Windowed-v0", render_mode="human")
        assert len(evaluate(Zero(), env, 3).cost) == 3
        assert Windowed.windows == 1
    finally:
        gym.registry.pop("test/Windowed-v0")


def test_repeated_actions_cost_their_sum() -> None:
    plant = Drift(length=20)
    assert evaluate(Zero(0.5), Twice(plant), 1).cost[0] == pytest.approx(-sum(plant.paid))


def test_arguments_that_cannot_be_stored_are_refused_before_the_first_step(drift: str) -> None:
    env = gym.make(drift, info=costly)
    with pytest.raises(InvalidArgumentError, match=r"environment 'test/Drift-v0': .*stored as JSON"):
        record(env, Zero(), 1, "test/callable-v0")
    assert env.unwrapped.paid == []  # type: ignore[attr-defined]


# ---------------------------------------------------------------- for how long


def test_an_episode_without_end_is_an_error_that_names_the_cap(drift: str) -> None:
    endless = gym.make(drift, length=0)
    for env in (endless, Plain(endless)):
        with pytest.raises(InvalidArgumentError, match=r"episode 0: .*max_episode_steps=25 .*gym\.make"):
            evaluate(Zero(), env, 2, max_episode_steps=25)
        with pytest.raises(InvalidArgumentError, match=r"episode 0: .*max_episode_steps=25 .*gym\.make"):
            record(env, Zero(), 2, "test/endless-v0", max_episode_steps=25)
    with pytest.raises(InvalidArgumentError, match=r"max_episode_steps=40"):
        evaluate(Zero(), gym.make(PENDULUM, max_episode_steps=-1), 2, max_episode_steps=40)
    with pytest.raises(InvalidArgumentError, match=f"max_episode_steps={MAX_EPISODE_STEPS}"):
        evaluate(Zero(), Drift(length=0), 1)


def test_environments_that_end_themselves_are_fine(drift: str) -> None:
    for length in (24, 25):
        assert evaluate(Zero(), gym.make(drift, length=length), 1, max_episode_steps=25).length.tolist() == [length]
        dataset = record(gym.make(drift, length=length), Zero(), 1, "test/end-v0", max_episode_steps=25, overwrite=True)
        assert dataset.total_steps == length
    longer = MAX_EPISODE_STEPS + 5
    limited = gym.make(drift, length=0, max_episode_steps=longer)
    assert evaluate(Zero(), limited, 1).length.tolist() == [longer]


@pytest.mark.parametrize("cap", [0, -1, 2.5, "many", True])
def test_a_cap_is_a_positive_integer(cap: Any) -> None:
    with pytest.raises(InvalidArgumentError, match="max_episode_steps"):
        evaluate(Zero(), Drift(), 1, max_episode_steps=cap)


# ---------------------------------------------------------------- what is no environment, and seeds


@pytest.mark.parametrize("env", [None, 3, DummyVecEnv([Drift]), gym.vector.SyncVectorEnv([Drift])])
def test_what_is_no_environment_is_refused(env: Any) -> None:
    for run in (lambda: evaluate(Zero(), env, 1), lambda: record(env, Zero(), 1, "test/none-v0")):
        with pytest.raises(InvalidArgumentError, match="env: expected a Gymnasium environment or the id of one"):
            run()


@pytest.mark.parametrize("env_id", ["nowhere/Nothing-v0", "no id at all", "", "no_such_module:Thing-v0"])
def test_unknown_ids_are_refused(env_id: str, mpc_policy: MPCPolicy) -> None:
    for run in (
        lambda: evaluate(Zero(), env_id, 1),
        lambda: record(env_id, Zero(), 1, "test/none-v0"),
        lambda: EnvironmentEvaluator(env_id),
        lambda: MPCModel(mpc_policy, env_id),
    ):
        with pytest.raises(UnknownIdError, match="environment id"):
            run()


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8])
def test_seeds_of_numpy_are_seeds(kind: Any, mpc_policy: MPCPolicy) -> None:
    found, expected = (evaluate(Zero(), Drift(), kind(2), seed=seed).cost for seed in (kind(7), 7))
    np.testing.assert_array_equal(found, expected)
    a, b = (
        record(Drift(), Zero(), 2, f"test/seed-v{i}", seed=seed)[1].observations for i, seed in enumerate((kind(7), 7))
    )
    np.testing.assert_array_equal(a, b)
    assert MPCModel(mpc_policy, seed=kind(3)).seed == 3


@pytest.mark.parametrize("seed", [-1, 1.5, "7", True, np.array([1, 2])])
def test_what_is_no_seed_is_refused(seed: Any, mpc_policy: MPCPolicy) -> None:
    for run in (
        lambda: evaluate(Zero(), Drift(), 1, seed=seed),
        lambda: record(Drift(), Zero(), 1, "test/noseed-v0", seed=seed),
        lambda: EnvironmentEvaluator(Drift(), seed=seed),
        lambda: MPCModel(mpc_policy, seed=seed),
    ):
        with pytest.raises(InvalidArgumentError, match="seed: expected an integer >= 0"):
            run()
