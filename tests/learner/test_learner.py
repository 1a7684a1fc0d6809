"""OfflineMPCLearner: the same numbers from every kind of data, files, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import gymnasium as gym
import lq_plant
import minari
import numpy as np
import pytest
import torch
from gymnasium import spaces
from lq_plant import make_mpc
from minari.data_collector import EpisodeBuffer

import mpcoffline.control.policy
import mpcoffline.solvers
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import (
    FileFormatError,
    InvalidArgumentError,
    InvalidDataError,
    MPCOfflineError,
    UnknownIdError,
)
from mpcoffline.datasets import TransitionTable, load_dataset
from mpcoffline.datasets.store.writing import write_dataset
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learner.presets import PRESETS
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC
from mpcoffline.plants.nominal import nominal_mpc

QUICK: dict[str, Any] = {
    "hidden": (16, 16),
    "value_n_steps": 60,
    "value_batch_size": 64,
    "fit_n_steps": 30,
    "fit_batch_size": 64,
    "refit_iterations": 20,
}


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty Minari store, and one torch thread."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "store"))
    torch.set_num_threads(1)


def quick(mpc: MPC | None = None, **options: Any) -> OfflineMPCLearner:
    how = {} if "preset" in options else {"method": "bellman"}  # whose options are the published ones
    return OfflineMPCLearner(mpc or make_mpc(), **({"candidate": "full"} | QUICK | how | options))


def fitted(table: TransitionTable | None = None, **options: Any) -> OfflineMPCLearner:
    learner = quick(**options)
    learner.fit(table or lq_plant.random_log(400), show_progress=False)
    return learner


def same_fit(first: OfflineMPCLearner, second: OfflineMPCLearner) -> None:
    """Everything that was learned is equal, bit for bit."""
    np.testing.assert_array_equal(first.theta, second.theta)
    assert first.value_function is not None
    assert second.value_function is not None
    arrays = second.value_function.to_arrays()
    for name, array in first.value_function.to_arrays().items():
        np.testing.assert_array_equal(array, arrays[name])
    assert first.history == second.history


# ---------------------------------------------------------------- data


def linear_episodes(n: int = 6, length: int = 20) -> list[EpisodeBuffer]:
    """Episodes of the linear task under noise, recorded without the recorder."""
    env, rng, episodes = gym.make("mpcoffline/LinearTracking-v0"), np.random.default_rng(0), []
    for i in range(n):
        y, _ = env.reset(seed=i)
        seen, actions, rewards = [y], [], []
        for _ in range(length):
            action = (np.array([[-3, 0, -2, 0], [0, -3, 0, -2]]) @ y + rng.normal(size=2)).astype(np.float32)
            y, reward, *_ = env.step(action)
            seen.append(y)
            actions.append(action)
            rewards.append(float(reward))
        ends = np.arange(length) == length - 1
        episodes.append(
            EpisodeBuffer(
                observations=np.array(seen),
                actions=np.array(actions),
                rewards=rewards,
                terminations=np.zeros(length, bool),
                truncations=ends,
                infos={},
            )
        )
    return episodes


def stored(episodes: list[EpisodeBuffer], dataset_id: str = "test/linear-v0") -> minari.MinariDataset:
    env = gym.make("mpcoffline/LinearTracking-v0")
    return write_dataset(
        dataset_id,
        episodes,
        env_spec=env.spec,
        observation_space=env.observation_space,
        action_space=env.action_space,
    )


def test_table_id_and_dataset_give_the_same_bits() -> None:
    dataset = stored(linear_episodes())
    mpc = nominal_mpc("mpcoffline/LinearTracking-v0").replace(horizon=5)
    learners = []
    for data in (TransitionTable.from_minari(dataset), "test/linear-v0", dataset):
        learner = quick(mpc)
        learner.fit(data, show_progress=False)
        learners.append(learner)
    same_fit(learners[0], learners[1])
    same_fit(learners[0], learners[2])
    # With a data set the policy knows the environment's observation space.
    assert learners[1].policy.observation_space == dataset.observation_space
    assert isinstance(learners[0].policy.observation_space, spaces.Box)


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_shipped_data_are_known_by_id() -> None:
    learner = quick(nominal_mpc("mpcoffline/PendulumSwingUp-v0", 0.5, 0), learn="cost")
    learner.fit("mpcoffline/pendulum/ddpg-v0", show_progress=False)
    assert learner.policy.observation_space == load_dataset("mpcoffline/pendulum/ddpg-v0").observation_space


def test_the_same_seed_learns_the_same() -> None:
    first, again, other = fitted(seed=3), fitted(seed=3), fitted(seed=4)
    same_fit(first, again)
    assert (first.theta != other.theta).any()


def test_a_second_fit_is_a_first_fit() -> None:
    """Nothing of earlier data is left in what is learned."""
    learner = fitted(lq_plant.random_log(400, seed=1))
    learner.fit(lq_plant.random_log(400, seed=2), show_progress=False)
    same_fit(learner, fitted(lq_plant.random_log(400, seed=2)))


def test_a_second_fit_gives_a_new_policy() -> None:
    learner = fitted()
    before = learner.policy
    assert learner.policy is before
    learner.fit(lq_plant.random_log(400, seed=9), show_progress=False)
    assert learner.policy is not before
    np.testing.assert_array_equal(learner.policy.mpc.theta, learner.theta)


# ---------------------------------------------------------------- what is learned


@pytest.mark.parametrize("learn", ["cost", "cost+model"])
def test_the_given_mpc_is_never_changed(learn: Any) -> None:
    mpc = make_mpc()
    before, text = mpc.theta, str(mpc.to_json())
    learner = quick(mpc, learn=learn)
    learner.fit(lq_plant.random_log(400), show_progress=False)
    np.testing.assert_array_equal(mpc.theta, before)
    assert str(mpc.to_json()) == text
    assert learner.nominal_mpc is mpc
    assert learner.mpc is not mpc
    model = mpc.space.mask(("model",))
    assert (learner.theta[model] != before[model]).any() == (learn == "cost+model")
    assert (learner.theta[mpc.space.mask(("cost",))] != before[mpc.space.mask(("cost",))]).any()
    learned = learner.mpc
    assert (learned.horizon, learned.discount) == (mpc.horizon, mpc.discount)  # the paper preset keeps these


def test_theta_is_the_callers_own_copy() -> None:
    learner = fitted()
    theta = learner.theta
    theta[:] = 0.0
    assert (learner.theta != 0.0).any()


@pytest.mark.slow
def test_the_history_counts_epochs_of_both_regressions() -> None:
    learner = fitted(value_n_steps=600, fit_n_steps=150)
    epochs, metrics = zip(*learner.history, strict=True)
    assert epochs == tuple(range(1, len(epochs) + 1))
    names = [next(iter(entry)) for entry in metrics]
    assert names == ["value_loss"] * 2 + ["fit_loss"] * 3
    assert all(np.isfinite(list(entry.values())).all() for entry in metrics)
    assert learner.result is not None
    assert metrics[-1]["fit_loss"] == learner.result.loss_after < learner.result.loss_before


def test_fit_returns_the_history() -> None:
    learner = quick(learn="cost")
    history = learner.fit(lq_plant.random_log(100), show_progress=False)
    assert history == learner.history
    assert [set(metrics) for _, metrics in history] == [{"value_loss"}, {"fit_loss"}]


def test_a_progress_bar_can_be_drawn(capsys: pytest.CaptureFixture[str]) -> None:
    quick().fit(lq_plant.random_log(100))
    output = "".join(capsys.readouterr())  # the command line sends it to the standard error
    assert "(VALUE) learning V" in output
    assert "(FIT) learning cost+model" in output
    quick().fit(lq_plant.random_log(100), show_progress=False)
    assert "".join(capsys.readouterr()) == ""


def test_a_given_value_function_is_used_as_it_is() -> None:
    value = lq_plant.QuadraticValue(lq_plant.BEST.P)
    learner = quick(value_function=value, learn="cost")
    history = learner.fit(lq_plant.random_log(200), show_progress=False)
    assert learner.value_function is value
    assert [set(metrics) for _, metrics in history] == [{"fit_loss"}]


def test_a_value_function_of_another_discount_is_refused() -> None:
    table = lq_plant.random_log(200)
    value = fitted(table).value_function
    assert value is not None
    assert value.discount == lq_plant.DISCOUNT
    message = r"value_function: expected .* of this fit, 0\.95, got one of 0\.9\."
    with pytest.raises(InvalidArgumentError, match=message):
        quick(preset="default", discount=0.95, value_function=value).fit(table, show_progress=False)
    quick(value_function=value, learn="cost").fit(table, show_progress=False)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_the_tails_are_left_out(preset: str) -> None:
    """A tenth of the rows lies far out with absurd costs: with the default trim they count for nothing."""
    near = lq_plant.random_log(900, seed=5)
    rows = np.concatenate([near.rows, near.rows[:100]])
    rows[900:, :2] *= 1e3
    rows[900:, 3] = 1e6
    table = TransitionTable(rows, 2, 1, np.arange(1_000))
    options: dict[str, Any] = {"preset": preset} | ({} if preset == "paper" else {"terminal": "quadratic"})
    np.testing.assert_array_equal(fitted(table, **options).theta, fitted(near, trim=1.0, **options).theta)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_tables_larger_than_memory_are_learned_from(preset: str, tmp_path: Path) -> None:
    dataset = stored(linear_episodes())
    mapped = TransitionTable.from_minari(dataset, memory=2_000, cache=tmp_path / "tables")
    assert mapped.is_mapped
    mpc = nominal_mpc("mpcoffline/LinearTracking-v0").replace(horizon=5)
    options: dict[str, Any] = {"fit_n_steps": 5, "trim": 1.0, "preset": preset}
    options |= {} if preset == "paper" else {"terminal": "quadratic"}
    learner = quick(mpc, **options)
    learner.fit(mapped, show_progress=False)
    assert np.isfinite(learner.theta).all()
    in_memory = quick(mpc, **options)
    in_memory.fit(dataset, show_progress=False)
    # Rows are shuffled block by block: other minibatches, the same problem.
    np.testing.assert_allclose(learner.mpc.values["model.A"], in_memory.mpc.values["model.A"], atol=0.2)


def test_learning_solves_no_mpc(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: Any, **__: Any) -> Any:
        raise AssertionError("an optimal control problem was set up while learning")

    for module in (mpcoffline.solvers, mpcoffline.control.policy):
        monkeypatch.setattr(module, "make_solver", forbidden)
    for name in ("nlpsol", "qpsol", "conic", "rootfinder"):
        monkeypatch.setattr(ca, name, forbidden)
    monkeypatch.setattr(mpcoffline.solvers.Solver, "solve", forbidden)
    monkeypatch.setattr(mpcoffline.solvers.Solver, "__init__", forbidden)
    learner = fitted()
    with pytest.raises(AssertionError):  # the policy needs one
        learner.policy.predict(np.zeros(2))


# ---------------------------------------------------------------- options


def test_the_preset_is_the_default_one() -> None:
    assert OfflineMPCLearner(make_mpc()).method == PRESETS["default"]
    assert OfflineMPCLearner(make_mpc(), value="td", horizon=7).method == PRESETS["default"].replaced(
        {"value": "td", "horizon": 7}
    )


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"learn": "model"}, InvalidArgumentError, r"learn: expected 'cost' or 'cost\+model' or .*, got 'model'"),
        ({"preset": "papr"}, UnknownIdError, "Did you mean 'paper'"),
        ({"value": "expectil"}, UnknownIdError, "Did you mean 'expectile'"),
        ({"priors": 1.0}, UnknownIdError, "option of the learning method Bellman: .*Did you mean 'prior'"),
        ({"n_steps": 5}, UnknownIdError, "value_n_steps|fit_n_steps"),
        ({"prior": -1.0}, InvalidArgumentError, "prior"),
        ({"trim": 0.0}, InvalidArgumentError, "trim"),
        ({"trim": 1.5}, InvalidArgumentError, "trim"),
        ({"seed": -1}, InvalidArgumentError, "seed: expected an integer >= 0, got -1"),
        ({"seed": 0.5}, InvalidArgumentError, "seed"),
        ({"method": "papr"}, UnknownIdError, "learning method: .*Did you mean 'paper'"),
        ({"method": "paper", "preset": "paper"}, InvalidArgumentError, "preset: expected none beside a method"),
        ({"method": "paper", "init": "identified"}, UnknownIdError, "got 'init'.* method 'bellman' has it"),
        ({"method": "bellman", "potential": True}, InvalidArgumentError, "got terminal='given'"),
        ({"preset": "paper", "potential": True}, InvalidArgumentError, "potential: expected a terminal cost from V"),
        ({"value_function": lq_plant.QuadraticValue(np.eye(3))}, InvalidArgumentError, "value_function: .* 2 coord"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        OfflineMPCLearner(make_mpc(), **options)


def test_an_unknown_device_is_refused_before_the_work() -> None:
    with pytest.raises(InvalidArgumentError, match="device: expected a torch device of this machine"):
        quick(device="cuda:77").fit(lq_plant.random_log(100), show_progress=False)


def test_numpy_numbers_can_be_saved(tmp_path: Path) -> None:
    learner = quick(prior=np.float32(0.5), horizon=np.int64(7))
    learner.save(tmp_path / "l.zip")
    assert OfflineMPCLearner.load(tmp_path / "l.zip").method == learner.method


def test_before_fit_there_is_nothing_to_hand_out() -> None:
    learner = quick()
    for name in ("mpc", "theta", "policy"):
        with pytest.raises(MPCOfflineError, match=r"expected a fitted learner, got no fit yet. Call fit\(dataset\)"):
            getattr(learner, name)


# ---------------------------------------------------------------- epochs


def test_fitter_yields_what_fit_returns() -> None:
    table = lq_plant.random_log(300)
    learner, other = quick(), quick()
    epochs = list(learner.fitter(table, show_progress=False))
    assert epochs == other.fit(table, show_progress=False) == learner.history
    same_fit(learner, other)


def test_callbacks_and_evaluators_see_every_epoch() -> None:
    seen: list[tuple[int, int]] = []
    lengths: list[int] = []

    def evaluator(learner: OfflineMPCLearner, table: TransitionTable) -> float:
        lengths.append(len(table))
        return float(np.abs(learner.theta - learner.nominal_mpc.theta).max())

    history = quick().fit(
        lq_plant.random_log(300),
        n_steps=50,
        n_steps_per_epoch=20,
        evaluators={"moved": evaluator},
        callbacks=[lambda learner, epoch, total_step: seen.append((epoch, total_step))],
        show_progress=False,
    )
    assert seen == [(1, 20), (2, 40), (3, 50), (4, 70), (5, 80), (6, 81)]
    assert [set(metrics) for _, metrics in history] == [{"value_loss"}] * 3 + [{"fit_loss", "moved"}] * 3
    assert lengths == [300] * 3
    assert all(metrics["moved"] > 0.0 for _, metrics in history[3:])


class InterruptionError(Exception):
    """What a callback raises to end a fit."""


@pytest.mark.parametrize("stop_after", [1, 3, 4, 5])
def test_an_interrupted_fit_ends_at_the_same_bits(tmp_path: Path, stop_after: int) -> None:
    table, file = lq_plant.random_log(300), tmp_path / "fit.zip"

    def stop(learner: OfflineMPCLearner, epoch: int, total_step: int) -> None:
        if epoch == stop_after + 1:
            raise InterruptionError

    options: dict[str, Any] = {"n_steps_per_epoch": 20, "show_progress": False}
    whole = quick()
    whole.fit(table, **options)
    with pytest.raises(InterruptionError):
        quick().fit(table, callbacks=[stop], checkpoint=file, **options)
    resumed = quick()
    resumed.fit(table, checkpoint=file, **options)
    same_fit(whole, resumed)
    assert resumed.history == whole.history
    again = quick()
    again.fit(table, checkpoint=file, **options)  # nothing is left to do but the last epoch
    same_fit(whole, again)
    assert again.history == whole.history


def test_a_checkpoint_of_another_fit_is_refused_and_kept(tmp_path: Path) -> None:
    file = tmp_path / "fit.zip"
    quick().fit(lq_plant.random_log(300), checkpoint=file, show_progress=False)
    content = file.read_bytes()
    for learner, table in (
        (quick(seed=1), lq_plant.random_log(300)),
        (quick(prior=0.5), lq_plant.random_log(300)),
        (quick(learn="cost"), lq_plant.random_log(300)),
        (quick(), lq_plant.random_log(301)),
    ):
        with pytest.raises(InvalidArgumentError, match="checkpoint: expected a checkpoint of the same data"):
            learner.fit(table, checkpoint=file, show_progress=False)
    assert file.read_bytes() == content


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "fit.zip"
    file.write_bytes(b"PK no zip")
    with pytest.raises(FileFormatError, match="an mpcoffline checkpoint file"):
        quick().fit(lq_plant.random_log(300), checkpoint=file, show_progress=False)


# ---------------------------------------------------------------- bad data


def untouched(learner: OfflineMPCLearner, data: Any, error: type[Exception], message: str) -> None:
    """The data are refused; what the learner knew, it still knows."""
    theta, history = learner.theta, learner.history
    with pytest.raises(error, match=message):
        learner.fit(data, show_progress=False)
    np.testing.assert_array_equal(learner.theta, theta)
    assert learner.history == history


def test_arrays_are_no_data_set() -> None:
    untouched(
        fitted(), np.zeros((5, 7)), InvalidArgumentError, r"data set: .* got ndarray\. TransitionTable\.from_arrays"
    )


def test_data_of_another_plant_are_refused() -> None:
    zeros = np.zeros(5)
    learner = fitted()
    wide = TransitionTable.from_arrays(np.zeros((5, 3)), np.zeros((5, 1)), zeros, np.zeros((5, 3)), zeros)
    untouched(learner, wide, InvalidDataError, "observations: expected 2 coordinates, as in the MPC, got 3")
    more = TransitionTable.from_arrays(np.zeros((5, 2)), np.zeros((5, 2)), zeros, np.zeros((5, 2)), zeros)
    untouched(learner, more, InvalidDataError, "actions: expected 1 coordinates, as in the MPC, got 2")
    stored(linear_episodes(2, 3))
    untouched(learner, "test/linear-v0", InvalidDataError, "observations: expected 2 coordinates, as in the MPC, got 4")


def test_an_unknown_dataset_is_refused_with_the_nearest() -> None:
    untouched(fitted(), "mpcoffline/pendulum/dpg-v0", UnknownIdError, "mpcoffline/pendulum/ddpg-v0")


def test_actions_beyond_the_mpcs_bounds_are_refused() -> None:
    x = np.zeros((6, 2))
    u = np.array([[0.0], [1.0], [-1.0], [0.5], [1.25], [0.0]])
    ids = [7, 7, 7, 9, 9, 9]
    table = TransitionTable.from_arrays(x, u, np.zeros(6), x, np.zeros(6), ids)
    learner = quick(make_mpc(action_low=[-1.0], action_high=[1.0]))
    with pytest.raises(InvalidDataError, match=r"episode 9, step 1: action 0: expected a value below .* 1, got 1\.25"):
        learner.fit(table, show_progress=False)


@pytest.mark.parametrize(("bad", "word"), [(np.nan, "nan"), (np.inf, "inf")])
def test_numbers_that_are_none_are_named_by_episode_and_step(bad: float, word: str) -> None:
    episodes = linear_episodes(3, 8)
    episodes[1].rewards[5] = bad
    dataset = stored(episodes)
    learner = quick(nominal_mpc("mpcoffline/LinearTracking-v0"))
    with pytest.raises(InvalidDataError, match=f"episode 1, step 5.*{word}"):
        learner.fit(dataset, show_progress=False)


# ---------------------------------------------------------------- files


def test_a_saved_learner_is_the_same_learner(tmp_path: Path) -> None:
    learner = fitted(value="td", seed=5, trim=0.95)
    learner.save(tmp_path / "l.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "l.zip")
    same_fit(learner, loaded)
    assert loaded.method == learner.method
    assert (loaded.learn, loaded.preset, loaded.seed) == (learner.learn, learner.preset, learner.seed)
    assert loaded.result is not None
    assert learner.result is not None
    assert (loaded.result.loss_before, loaded.result.loss_after) == (
        learner.result.loss_before,
        learner.result.loss_after,
    )
    np.testing.assert_array_equal(loaded.nominal_mpc.theta, learner.nominal_mpc.theta)
    x = np.random.default_rng(0).uniform(-1, 1, size=(5, 2))
    assert loaded.value_function is not None
    assert learner.value_function is not None
    np.testing.assert_array_equal(loaded.value_function.predict(x), learner.value_function.predict(x))
    np.testing.assert_array_equal(loaded.policy.predict(x)[0], learner.policy.predict(x)[0])


def test_a_loaded_learner_learns_as_a_new_one(tmp_path: Path) -> None:
    learner = fitted(lq_plant.random_log(400, seed=1))
    learner.save(tmp_path / "l.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "l.zip")
    loaded.fit(lq_plant.random_log(400, seed=2), show_progress=False)
    same_fit(loaded, fitted(lq_plant.random_log(400, seed=2)))


def test_a_fit_that_a_callback_ended_keeps_what_it_learned(tmp_path: Path) -> None:
    learner = quick()
    learner.fit(
        lq_plant.random_log(400),
        n_steps_per_epoch=20,
        callbacks=[lambda learner, epoch, total_step: total_step < 80],  # 60 steps are (VALUE)'s
        show_progress=False,
    )
    assert learner.result is None
    assert np.abs(learner.theta - learner.nominal_mpc.theta).max() > 0.0
    learner.save(tmp_path / "l.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "l.zip")
    assert loaded.result is None
    same_fit(learner, loaded)


def test_a_learner_can_be_saved_before_it_has_learned(tmp_path: Path) -> None:
    quick(seed=2).save(tmp_path / "l.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "l.zip")
    assert (loaded.result, loaded.value_function, loaded.history, loaded.seed) == (None, None, [], 2)


def test_the_environments_observation_space_is_kept(tmp_path: Path) -> None:
    dataset = stored(linear_episodes())
    learner = quick(nominal_mpc("mpcoffline/LinearTracking-v0").replace(horizon=5))
    learner.fit(dataset, show_progress=False)
    learner.save(tmp_path / "l.zip")
    assert OfflineMPCLearner.load(tmp_path / "l.zip").policy.observation_space == dataset.observation_space
    policy = MPCPolicy.load(tmp_path / "l.zip")  # a learner's file has its policy
    assert policy.observation_space == dataset.observation_space
    assert policy.mpc.theta.tolist() == learner.theta.tolist()


def test_saving_over_a_learner_replaces_it(tmp_path: Path) -> None:
    fitted(seed=1).save(tmp_path / "l.zip")
    second = fitted(seed=2)
    second.save(tmp_path / "l.zip")
    same_fit(OfflineMPCLearner.load(tmp_path / "l.zip"), second)


def test_a_value_function_of_other_coordinates_in_a_file_is_refused(tmp_path: Path) -> None:
    learner = fitted()
    learner.value_function = ValueFunction(3, (4,))
    learner.save(tmp_path / "l.zip")
    with pytest.raises(FileFormatError, match="value function"):
        OfflineMPCLearner.load(tmp_path / "l.zip")


def test_a_policys_file_is_not_a_learner(tmp_path: Path) -> None:
    fitted().policy.save(tmp_path / "p.zip")
    before = (tmp_path / "p.zip").read_bytes()
    with pytest.raises(FileFormatError, match=r"expected an mpcoffline learner file, got .*'policy'"):
        OfflineMPCLearner.load(tmp_path / "p.zip")
    assert (tmp_path / "p.zip").read_bytes() == before


def test_an_identified_model_that_predicts_well_is_left_alone(caplog: pytest.LogCaptureFixture) -> None:
    """The plant is in the model's family here; adapting begins where the error is above the limit."""
    table = lq_plant.random_log(600)
    options: dict[str, Any] = {"init": "identified", "fit_n_steps": 50, "hidden": (16, 16), "value_n_steps": 60}
    kept = quick(**(options | {"adapt_above": 0.03}))
    caplog.set_level("INFO")
    kept.fit(table, show_progress=False)
    np.testing.assert_allclose(kept.mpc.values["model.A"], lq_plant.A, atol=1e-3)
    assert "it stays" in caplog.text
    caplog.clear()
    adapted = quick(**(options | {"adapt_above": 0.0}))
    adapted.fit(table, show_progress=False)
    assert "(FIT) adapts it with the cost" in caplog.text
    assert len(adapted.history) > len(kept.history)  # the steps on cost and model, though they may end where they began
