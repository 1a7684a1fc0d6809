"""MPCPolicy as Stable-Baselines3 sees it, in closed loops, when solves fail, and as a file."""

from __future__ import annotations

import copy
import logging
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import lq_plant
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from scipy import stats
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from mpcoffline.control.evaluation import evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError, UnknownIdError
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.mpc import MPC
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import SOLVERS, IpoptSolver, Plan, Solution, Solver

Array = NDArray[np.float64]
PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def short_pendulum() -> MPC:
    return nominal_mpc(PENDULUM, alpha=0.5, seed=0).replace(horizon=15)


@pytest.fixture(scope="module")
def pendulum() -> MPCPolicy:
    return MPCPolicy(short_pendulum())


@pytest.fixture(scope="module")
def linear() -> MPCPolicy:
    return MPCPolicy(lq_plant.make_mpc(), "ipopt")


def observations(n: int, seed: int = 0) -> Array:
    """States y of the pendulum ``(n, 3)``."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, n)
    return np.stack([np.cos(angle), np.sin(angle), rng.uniform(-1, 1, n)], axis=1)


# ---------------------------------------------------------------- as an SB3 policy


def test_is_an_sb3_policy(pendulum: MPCPolicy) -> None:
    assert isinstance(pendulum, BasePolicy)
    env = gym.make(PENDULUM)
    assert pendulum.action_space == env.action_space
    assert pendulum.observation_space.shape == env.observation_space.shape
    assert not list(pendulum.parameters())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_observation_or_many(pendulum: MPCPolicy, dtype: Any) -> None:
    y = observations(4).astype(dtype)
    actions, plan = pendulum.predict(y)
    assert actions.shape == (4, 1)
    assert actions.dtype == np.float32
    assert (plan.x.shape, plan.u.shape) == ((4, 16, 3), (4, 15, 1))
    for i in range(4):
        action, one = pendulum.predict(y[i])
        assert action.shape == (1,)
        assert action.dtype == np.float32
        np.testing.assert_array_equal(action, actions[i])
        np.testing.assert_array_equal(one.u[0], plan.u[i])
        assert pendulum.action_space.contains(action)


def test_actions_touch_their_bounds_and_stay_within(pendulum: MPCPolicy) -> None:
    actions, _ = pendulum.predict(observations(64))
    assert float(np.abs(actions).max()) == 2.0
    assert all(pendulum.action_space.contains(action) for action in actions)


def test_the_policy_is_the_optimal_gain_where_the_mpc_is_optimal() -> None:
    """True model and cost, T = V*: u = K x (Riccati), whatever the solver."""
    x = np.random.default_rng(0).uniform(-1, 1, size=(6, 2))
    for name in ("auto", "ipopt"):
        policy = MPCPolicy(lq_plant.make_mpc(model=(lq_plant.A, lq_plant.B)), name)
        actions, _ = policy.predict(x)
        np.testing.assert_allclose(actions, x @ lq_plant.BEST.K.T, atol=1e-5)


def test_tensors_go_in_and_come_out(pendulum: MPCPolicy) -> None:
    y = observations(3)
    expected, _ = pendulum.predict(y)
    tensor = torch.as_tensor(y, dtype=torch.float64)
    for found in (pendulum(tensor), pendulum._predict(tensor, deterministic=True)):
        assert isinstance(found, torch.Tensor)
        assert found.dtype == torch.float32
        np.testing.assert_array_equal(found.numpy(), expected)
    with pytest.raises(InvalidArgumentError, match="observation: expected a tensor, got a dictionary"):
        pendulum._predict({"y": tensor})


def test_is_a_plain_function(pendulum: MPCPolicy) -> None:
    y = observations(3)
    expected, _ = pendulum.predict(y)
    np.testing.assert_array_equal(pendulum(y), expected)
    np.testing.assert_array_equal(pendulum(y[1]), expected[1])
    np.testing.assert_array_equal(pendulum(list(y[1])), expected[1])


def plain() -> gym.Env[Any, Any]:
    return gym.make(PENDULUM)


def vector(n: int) -> Callable[[], VecEnv]:
    return lambda: DummyVecEnv([lambda: Monitor(plain())] * n)


def processes() -> VecEnv:
    """Two processes, which import what the environment's id names."""
    return make_vec_env(f"mpcoffline:{PENDULUM}", n_envs=2, vec_env_cls=SubprocVecEnv)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(plain, id="plain"),
        pytest.param(lambda: Monitor(plain()), id="Monitor"),
        pytest.param(vector(1), id="DummyVecEnv"),
        pytest.param(vector(3), id="three"),
        pytest.param(lambda: VecMonitor(DummyVecEnv([plain] * 4)), id="VecMonitor"),
        pytest.param(processes, id="SubprocVecEnv", marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped")
def test_sb3_evaluates_to_the_same_costs_as_evaluate(pendulum: MPCPolicy, make: Callable[[], Any]) -> None:
    """A VecEnv seeded with 5 resets its first episodes with 5, 6, ...; a plain one is always reset with 5 here."""
    env = make()
    if isinstance(env, VecEnv):
        n = env.num_envs
        env.seed(5)
        expected = evaluate(pendulum, PENDULUM, n, seed=5).cost
    else:
        n = 1
        expected = evaluate(pendulum, PENDULUM, 1, seed=5).cost

        class Seeded(gym.Wrapper[Any, Any, Any, Any]):
            def reset(self, **_: Any) -> Any:
                return self.env.reset(seed=5)

        env = Seeded(env)
    returns, lengths = evaluate_policy(pendulum, env, n_eval_episodes=n, return_episode_rewards=True)
    assert lengths == [100] * n
    # float32 rewards of a VecEnv
    np.testing.assert_allclose(np.sort(-np.array(returns)), np.sort(expected), rtol=1e-5)
    env.close()


# ---------------------------------------------------------------- exploration


def test_noise_is_gaussian_in_fractions_of_the_range_and_clipped() -> None:
    """At x = 0 the optimal input is 0; bounds -20 and 20."""
    policy = MPCPolicy(lq_plant.make_mpc(), exploration_noise=0.2, seed=3)
    actions, plan = policy.predict(np.zeros((4000, 2)), deterministic=False)
    inside = np.abs(actions) < 20.0
    assert stats.kstest(actions[inside] / 8.0, stats.truncnorm(-2.5, 2.5).cdf).pvalue > 0.01
    np.testing.assert_allclose((actions == 20.0).mean(), stats.norm.sf(2.5), atol=0.004)
    assert all(policy.action_space.contains(action) for action in actions)
    np.testing.assert_allclose(plan.u, 0.0, atol=1e-9)  # what is carried on is the plan without noise


def test_the_same_seed_gives_the_same_noise() -> None:
    policy, x = MPCPolicy(lq_plant.make_mpc(), seed=1), np.zeros((5, 2))
    first = policy.predict(x, deterministic=False)[0]
    second = policy.predict(x, deterministic=False)[0]
    assert (first != second).all()
    policy.set_random_seed(1)
    np.testing.assert_array_equal(policy.predict(x, deterministic=False)[0], first)
    np.testing.assert_array_equal(policy(x, deterministic=False), second)
    policy.exploration_noise = 0.0
    np.testing.assert_array_equal(policy.predict(x, deterministic=False)[0], policy.predict(x)[0])


@pytest.mark.parametrize("noise", [-0.1, np.nan, np.inf])
def test_noise_out_of_range_is_refused(noise: float) -> None:
    with pytest.raises(InvalidArgumentError, match="exploration_noise: expected a finite number from 0"):
        MPCPolicy(lq_plant.make_mpc(), exploration_noise=noise)


def test_noise_without_bounds_is_refused() -> None:
    policy = MPCPolicy(lq_plant.make_mpc(action_low=[-np.inf], action_high=[np.inf]))
    policy.predict(np.zeros(2))
    with pytest.raises(InvalidArgumentError, match="deterministic: expected True where an action is unbounded"):
        policy.predict(np.zeros(2), deterministic=False)


# ---------------------------------------------------------------- the warm start


def test_nothing_is_hidden_in_the_policy(pendulum: MPCPolicy) -> None:
    y = observations(3)
    first, plan = pendulum.predict(y)
    pendulum.predict(observations(3, seed=9), state=plan)
    again, same = pendulum.predict(y)
    np.testing.assert_array_equal(first, again)
    for a, b in zip(plan, same, strict=True):
        np.testing.assert_array_equal(a, b)


class Recording(Solver):
    """Notes what it is asked; solves nothing: the first input is the problem's number in the batch."""

    name = "recording"
    calls: list[Plan] = []  # noqa: RUF012 -- emptied by the fixture
    fail: set[int] = set()  # noqa: RUF012

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan) -> Solution:
        self.calls.append(warm_start)
        n, mpc = len(x), self.mpc
        rows, steps = np.arange(n)[:, None, None], np.arange(mpc.horizon)[None, :, None]
        u = np.broadcast_to(rows + 0.1 * steps, (n, mpc.horizon, mpc.nu)).copy()
        success = np.array([i not in self.fail for i in range(n)])
        u[~success] = np.nan
        states = np.repeat(x[:, None], mpc.horizon + 1, axis=1)
        status = ["solved" if ok else "gave_up" for ok in success]
        stats = {"iterations": np.full(n, 7), "time": 0.5}
        return Solution(u[:, 0].copy(), states, u, np.zeros(n), success, status, stats)


@pytest.fixture
def recording(monkeypatch: pytest.MonkeyPatch) -> MPCPolicy:
    """A policy with the solver above."""
    monkeypatch.setitem(SOLVERS._things, "recording", Recording)
    monkeypatch.setattr(Recording, "calls", [])
    monkeypatch.setattr(Recording, "fail", set())
    return MPCPolicy(lq_plant.make_mpc(action_low=[-1.5], action_high=[1.75]), "recording")


def test_the_plan_travels_in_the_state_shifted_by_one_step(recording: MPCPolicy) -> None:
    x = np.zeros((2, 2))
    actions, state = recording.predict(x)
    np.testing.assert_array_equal(actions, [[0.0], [1.0]])
    assert not Recording.calls[0].known.any()
    np.testing.assert_allclose(state.u[1, :, 0], 1 + 0.1 * np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 9]))
    recording.predict(x, state=state)
    np.testing.assert_array_equal(Recording.calls[1].u, state.u)
    recording.predict(x, state=tuple(state))  # SB3 may hand on a plain tuple
    np.testing.assert_array_equal(Recording.calls[2].x, state.x)


def test_an_episode_that_starts_is_solved_cold(recording: MPCPolicy) -> None:
    x = np.zeros((3, 2))
    _, state = recording.predict(x)
    recording.predict(x, state=state, episode_start=np.array([False, True, False]))
    np.testing.assert_array_equal(Recording.calls[1].known, [True, False, True])
    np.testing.assert_array_equal(Recording.calls[1].u[[0, 2]], state.u[[0, 2]])
    recording.predict(x, state=state, episode_start=np.ones(3, dtype=bool))
    assert not Recording.calls[2].known.any()
    assert state.known.all()  # what the caller holds is never written to


@pytest.mark.parametrize("solver", ["auto", "ipopt"])
def test_a_reset_row_equals_a_cold_solve(solver: str) -> None:
    policy, y = MPCPolicy(short_pendulum(), solver), observations(3)
    _, state = policy.predict(observations(3, seed=4))
    actions, _ = policy.predict(y, state=state, episode_start=np.array([True, False, True]))
    cold, _ = policy.predict(y)
    np.testing.assert_array_equal(actions[[0, 2]], cold[[0, 2]])


@pytest.mark.parametrize("solver", ["auto", "ipopt"])
def test_a_warm_start_saves_iterations(solver: str) -> None:
    policy, env = MPCPolicy(short_pendulum(), solver), gym.make(PENDULUM)
    y, _ = env.reset(seed=0, options={"start": "hanging"})
    _, state = policy.predict(y)
    counts: dict[str, int] = {"warm": 0, "cold": 0}
    for _ in range(10):
        for kind, start in (("cold", None), ("warm", state)):
            before = policy.solver_stats.iterations
            action, plan = policy.predict(y, state=start)
            counts[kind] += policy.solver_stats.iterations - before
        state = plan
        y, *_ = env.step(action)
    assert counts["warm"] < 0.5 * counts["cold"]


def test_each_environment_of_a_vec_env_has_its_own_warm_start(pendulum: MPCPolicy) -> None:
    """Episodes that end at different steps: the same actions, bit for bit, as in loops of their own."""
    lengths = (4, 6, 9)

    def loop(lengths: tuple[int, ...], seed: int) -> Array:
        env = DummyVecEnv([partial(gym.make, PENDULUM, max_episode_steps=length) for length in lengths])
        env.seed(seed)
        y, state, start = env.reset(), None, np.ones(len(lengths), dtype=bool)
        actions = []
        for _ in range(15):
            action, state = pendulum.predict(y, state=state, episode_start=start, deterministic=True)
            y, _, start, _ = env.step(action)
            actions.append(action)
        return np.stack(actions, axis=1)

    together = loop(lengths, seed=5)
    for i, length in enumerate(lengths):
        np.testing.assert_array_equal(together[i], loop((length,), seed=5 + i)[0])


def test_a_state_of_another_batch_is_refused(recording: MPCPolicy) -> None:
    _, state = recording.predict(np.zeros((2, 2)))
    with pytest.raises(InvalidArgumentError, match="state: expected the state of 3 environments, got that of 2"):
        recording.predict(np.zeros((3, 2)), state=state)
    with pytest.raises(InvalidArgumentError, match="state"):
        recording.predict(np.zeros((2, 2)), state=(np.zeros(3),))
    with pytest.raises(InvalidArgumentError, match="episode_start"):
        recording.predict(np.zeros((2, 2)), state=state, episode_start=np.zeros(3, dtype=bool))


def test_a_plan_of_another_horizon_is_refused(pendulum: MPCPolicy) -> None:
    other = MPCPolicy(short_pendulum().replace(horizon=8))
    _, state = other.predict(observations(1))
    with pytest.raises(InvalidArgumentError, match="warm_start"):
        pendulum.predict(observations(1), state=state)


# ---------------------------------------------------------------- failures


def test_a_failed_solve_applies_the_previous_plan(recording: MPCPolicy, caplog: pytest.LogCaptureFixture) -> None:
    x = np.zeros((3, 2))
    _, state = recording.predict(x)
    Recording.fail.update({0, 1})  # 0 too, as a retry is a batch of its own
    with caplog.at_level(logging.WARNING):
        actions, state = recording.predict(x, state=state)
        np.testing.assert_allclose(actions[:, 0], [0.1, 1.1, 1.75])  # what the plan held; the other's own, clipped
        actions, state = recording.predict(x, state=state)
        np.testing.assert_allclose(actions[:, 0], [0.2, 1.2, 1.75])
    assert state.known.all()
    assert [record.getMessage() for record in caplog.records] == [
        "An MPC was not solved (gave_up): applying the previous plan."
    ]
    stats = recording.solver_stats
    assert (stats.n_solves, stats.n_failures, stats.n_previous_plan) == (9, 4, 4)
    assert (stats.iterations, stats.time) == (63 + 28, 2.5)  # the retries of two rows, twice


@pytest.mark.parametrize(("low", "high", "expected"), [(-1.0, 1.0, 0.0), (0.5, 2.0, 0.5), (-2.0, -0.25, -0.25)])
def test_without_a_plan_a_failure_gives_zero_within_bounds(
    monkeypatch: pytest.MonkeyPatch, low: float, high: float, expected: float
) -> None:
    monkeypatch.setitem(SOLVERS._things, "recording", Recording)
    monkeypatch.setattr(Recording, "calls", [])
    monkeypatch.setattr(Recording, "fail", {0, 1})
    policy = MPCPolicy(lq_plant.make_mpc(action_low=[low], action_high=[high]), "recording")
    actions, state = policy.predict(np.zeros((2, 2)))
    np.testing.assert_array_equal(actions, [[expected]] * 2)
    assert actions.dtype == np.float32
    actions, _ = policy.predict(np.zeros((2, 2)), state=state)  # and again from there
    np.testing.assert_array_equal(actions, [[expected]] * 2)
    assert not Recording.calls[1].known.any()
    assert policy.solver_stats.n_failures == 4


def test_a_closed_loop_survives_a_solver_that_always_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    class Hopeless(IpoptSolver):
        def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan) -> Solution:
            n, mpc = len(x), self.mpc
            u = np.full((n, mpc.horizon, mpc.nu), np.nan)
            states = np.full((n, mpc.horizon + 1, mpc.nx), np.nan)
            stats = {"iterations": np.zeros(n, dtype=int), "time": 0.0}
            return Solution(u[:, 0], states, u, np.full(n, np.nan), np.zeros(n, dtype=bool), ["no"] * n, stats)

    monkeypatch.setitem(SOLVERS._things, "hopeless", Hopeless)
    policy = MPCPolicy(short_pendulum(), "hopeless")
    result = evaluate(policy, PENDULUM, 2)
    assert (np.concatenate(result.actions) == 0.0).all()
    assert policy.solver_stats.n_failures == policy.solver_stats.n_solves == 200


# ---------------------------------------------------------------- a solver that is made already


def test_a_solver_stands_where_its_name_does(tmp_path: Path) -> None:
    mpc = short_pendulum()
    solver = IpoptSolver(mpc, n_starts=2, max_iterations=50)
    policy, named = MPCPolicy(mpc, solver), MPCPolicy(mpc, "ipopt", n_starts=2, max_iterations=50)
    assert policy.solver is solver
    assert (policy.solver_name, policy.solver_options) == (named.solver_name, named.solver_options)
    policy.save(tmp_path / "policy.zip")
    x = np.array([0.3, 0.9, 0.1])
    expected = named.predict(x)[0]
    for again in (policy, MPCPolicy.load(tmp_path / "policy.zip"), copy.deepcopy(policy)):
        np.testing.assert_array_equal(again.predict(x)[0], expected)
    with pytest.raises(
        InvalidArgumentError, match="solver: expected a name with options, or a solver of this very MPC"
    ):
        MPCPolicy(mpc, solver, n_starts=3)
    with pytest.raises(InvalidArgumentError, match="of another MPC"):
        MPCPolicy(short_pendulum(), solver)


def test_a_policy_whose_solver_no_file_can_name_is_not_saved(tmp_path: Path) -> None:
    class Mine(IpoptSolver):
        pass

    mpc = short_pendulum()
    policy = MPCPolicy(mpc, Mine(mpc))
    with pytest.raises(InvalidArgumentError, match=r"solver: expected one that is registered, .* got Mine"):
        policy.save(tmp_path / "policy.zip")
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros(4), r"observation: expected shape \(3,\) or \(B, 3\), got shape \(4,\)"),
        (np.zeros((2, 2)), "observation"),
        (np.zeros((2, 2, 3)), "observation"),
        (1.0, "observation"),
        (np.zeros((0, 3)), "observation"),
        ([1.0, np.nan, 0.0], r"observation: expected finite numbers, got nan at index \[1\] of"),
        ([[1.0, 0.0, 0.0], [1.0, 0.0, np.inf]], r"observation: expected finite numbers, got inf at index \[1, 2\] of"),
        (
            (np.zeros(3), {"state": 0}),
            r"observation: expected an array .* got tuple.*reset\(\) returns observation and info",
        ),
        ({"y": np.zeros(3)}, "observation: expected an array .* got dict"),
        ("upright", "observation: expected an array .* got str"),
    ],
)
def test_wrong_observations_are_refused(pendulum: MPCPolicy, bad: Any, message: str) -> None:
    before = pendulum.solver_stats.n_solves
    with pytest.raises(InvalidArgumentError, match=message):
        pendulum.predict(bad)
    assert pendulum.solver_stats.n_solves == before


@pytest.mark.parametrize(
    "arguments",
    [
        {"observation_space": spaces.Box(-1, 1, (3,))},
        {"observation_space": spaces.Box(-1, 1, (2, 1))},
        {"observation_space": spaces.Discrete(2)},
        {"action_space": spaces.Box(-1, 1, (2,))},
        {"action_space": spaces.MultiDiscrete([3])},
    ],
)
def test_spaces_that_do_not_fit_the_mpc_are_refused(arguments: dict[str, Any]) -> None:
    name = next(iter(arguments))
    with pytest.raises(InvalidArgumentError, match=f"{name}: expected a Box of shape"):
        MPCPolicy(lq_plant.make_mpc(), **arguments)


def test_an_unknown_solver_is_refused_at_once() -> None:
    with pytest.raises(UnknownIdError, match="Did you mean 'ipopt'"):
        MPCPolicy(lq_plant.make_mpc(), "ipop")


def test_narrower_action_bounds_than_the_mpcs_hold(linear: MPCPolicy) -> None:
    narrow = spaces.Box(np.float32(-0.5), np.float32(0.25), (1,), np.float32)
    policy = MPCPolicy(lq_plant.make_mpc(), "ipopt", action_space=narrow)
    x = np.array([[1.0, 1.0], [-1.0, -1.0]])
    np.testing.assert_array_equal(policy.predict(x)[0], [[-0.5], [0.25]])
    assert np.abs(linear.predict(x)[0]).min() > 1.0


# ---------------------------------------------------------------- copies


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, lambda p: pickle.loads(pickle.dumps(p))])
def test_a_policy_that_has_acted_can_be_copied(pendulum: MPCPolicy, copied: Callable[[MPCPolicy], MPCPolicy]) -> None:
    y = observations(2, seed=3)
    expected, _ = pendulum.predict(y)
    again = copied(pendulum)
    np.testing.assert_array_equal(again.predict(y)[0], expected)
    assert again.solver is not pendulum.solver


def test_a_policy_for_normalised_observations_has_noise_of_its_own() -> None:
    mpc, y = lq_plant.make_mpc(), np.zeros((3, 2))
    policy, untouched = MPCPolicy(mpc, seed=4), MPCPolicy(mpc, seed=4)
    solver, other = policy.solver, policy.with_normalization(None)
    assert other.solver is solver
    other.predict(y, deterministic=False)
    np.testing.assert_array_equal(
        policy.predict(y, deterministic=False)[0], untouched.predict(y, deterministic=False)[0]
    )


# ---------------------------------------------------------------- files


def test_a_saved_policy_acts_the_same(tmp_path: Path, pendulum: MPCPolicy) -> None:
    env = gym.make(PENDULUM)
    assert isinstance(env.observation_space, spaces.Box)
    assert isinstance(env.action_space, spaces.Box)
    policy = MPCPolicy(short_pendulum(), observation_space=env.observation_space, action_space=env.action_space)
    policy.save(tmp_path / "p.zip")
    loaded = MPCPolicy.load(tmp_path / "p.zip")
    assert (loaded.observation_space, loaded.action_space) == (policy.observation_space, policy.action_space)
    np.testing.assert_array_equal(loaded.mpc.theta, policy.mpc.theta)
    np.testing.assert_array_equal(loaded.predict(observations(8))[0], pendulum.predict(observations(8))[0])


def test_the_seed_of_the_noise_is_saved(tmp_path: Path) -> None:
    policy, x = MPCPolicy(lq_plant.make_mpc(), seed=3), np.zeros((4, 2))
    policy.set_random_seed(9)
    first = policy.predict(x, deterministic=False)[0]
    policy.save(tmp_path / "p.zip")
    loaded = MPCPolicy.load(tmp_path / "p.zip")
    np.testing.assert_array_equal(loaded.predict(x, deterministic=False)[0], first)
    with pytest.raises(InvalidArgumentError, match="seed: expected an integer >= 0, got -1"):
        MPCPolicy(lq_plant.make_mpc(), seed=-1)


def test_solver_and_options_are_saved(tmp_path: Path) -> None:
    policy = MPCPolicy(lq_plant.make_mpc(), "ipopt", exploration_noise=0.3, max_iterations=17, tolerance=1e-6)
    policy.save(tmp_path / "p.zip")
    loaded = MPCPolicy.load(tmp_path / "p.zip", device="cpu")
    assert loaded.solver_name == "ipopt"
    assert loaded.solver_options == {"max_iterations": 17, "tolerance": 1e-6}
    assert loaded.exploration_noise == 0.3
    assert isinstance(loaded.solver, IpoptSolver)


def test_unbounded_spaces_survive(tmp_path: Path) -> None:
    policy = MPCPolicy(lq_plant.make_mpc(action_low=[-np.inf], action_high=[np.inf]), "ipopt")
    policy.save(tmp_path / "p.zip")
    loaded = MPCPolicy.load(tmp_path / "p.zip")
    assert (loaded.observation_space, loaded.action_space) == (policy.observation_space, policy.action_space)


def test_a_learner_that_has_not_learned_has_no_policy(tmp_path: Path) -> None:
    OfflineMPCLearner(lq_plant.make_mpc()).save(tmp_path / "l.zip")
    before = (tmp_path / "l.zip").read_bytes()
    with pytest.raises(MPCOfflineError, match="expected a learner that has learned, got one before its fit"):
        MPCPolicy.load(tmp_path / "l.zip")
    assert (tmp_path / "l.zip").read_bytes() == before
