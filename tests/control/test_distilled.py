"""An explicit policy acts as its MPC does, respects bounds, and is the same from a file, in C and as ONNX."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import casadi as ca
import gymnasium as gym
import numpy as np
import pytest
import torch
from exported_problems import of_case
from gymnasium import spaces
from riccati import optimum
from stable_baselines3.common.evaluation import evaluate_policy
from task_ids import LINEAR

import mpcoffline.envs  # noqa: F401 -- registers the tasks
from mpcoffline import MPCPolicy
from mpcoffline.control import DistilledPolicy, OutputFeedbackPolicy, distill
from mpcoffline.control.explicit.code import export_explicit_c
from mpcoffline.control.explicit.fitting import fit_policy
from mpcoffline.control.explicit.loops import closed_loops
from mpcoffline.control.explicit.network import PolicyNetwork, multiply_adds, widths_within
from mpcoffline.control.explicit.report import Comparison, DistillationReport
from mpcoffline.control.export_onnx import export_onnx
from mpcoffline.control.loading import load_policy
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.estimation import KalmanObserver
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.mpc.labels import Label
from mpcoffline.solvers.ddp.build import find_compiler

FAST = {"n_labels": 1500, "rounds": 2, "effort": 0.1}


def made_up(
    ny: int = 3, nu: int = 2, memory: int = 0, hidden: tuple[int, ...] = (38, 38), offset: float = 1e4
) -> DistilledPolicy:
    """A policy of random weights that sees columns far from zero, one input of it without an upper bound."""
    rng = np.random.default_rng(0)
    nz = ny + memory
    states = rng.normal(size=(50, nz)) * np.geomspace(1e-3, 1e3, nz) + np.linspace(0.0, offset, nz)
    low, high = np.full(nu, -1.5), np.append(np.full(nu - 1, 2.5), np.inf)
    network = PolicyNetwork.random(states, (low, high), rng.normal(size=(50, nu)), hidden, rng)
    last = 10.0 * network.weights[-1]
    direct = rng.normal(size=(nu, nz))
    network = replace(network, weights=(*network.weights[:-1], last), direct=direct).rounded()
    alike = Comparison.of([1.0, 2.0], [1.0, 1.5], 10)
    report = DistillationReport(network.multiply_adds, 10, (0.1,) * nu, alike, None, 0.1, 0.9, 0)
    return DistilledPolicy(
        network,
        spaces.Box(-np.inf, np.inf, (ny,), np.float32),
        spaces.Box(low.astype(np.float32), high.astype(np.float32)),
        usual_memory=np.full(memory, 0.5),
        memory_sources=[memory, *range(memory - 1)] if memory else [],
        y_labels=[Label(f"level {i}", "cm") for i in range(ny)],
        u_labels=[Label(f"pump {i}", "V") for i in range(nu)],
        memory_names=[f"u0[k-{i + 1}]" for i in range(memory)],
        report=report,
    )


A, B = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.0], [0.2]])
OPTIMUM = optimum(A, B, np.eye(2), np.array([[0.1]]), 1.0)


def double_integrator(high: float = np.inf) -> MPC:
    """Whose MPC is the optimal linear controller where no bound is in the way."""
    model = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * u), 2, 1, 0.2, discrete=True)
    return MPC(model, QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(OPTIMUM.P), 10, 1.0, [-high], [high])


def test_of_a_linear_regulator_it_is_the_riccati_gain() -> None:
    starts = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2))
    small = MPCPolicy(double_integrator()).distill(starts, hidden=(6, 6), **FAST)
    seen = starts[:10]
    expected = seen @ OPTIMUM.K.T
    np.testing.assert_allclose(small.predict(seen)[0], expected, atol=0.02 * np.abs(expected).max())
    assert small.report.model.loss < 0.01


def test_it_costs_hardly_more_than_the_mpc_and_is_alike_for_a_seed() -> None:
    policy = MPCPolicy(double_integrator(0.5))
    starts = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2))
    found = [policy.distill(starts, seed=3, hidden=(8, 8), **FAST) for _ in range(2)]
    report = found[0].report
    assert report == found[1].report
    assert all((a == b).all() for a, b in zip(found[0].network.weights, found[1].network.weights, strict=True))
    assert report.multiply_adds == found[0].network.multiply_adds
    assert report.n_labels <= 1.1 * FAST["n_labels"]
    assert abs(report.model.loss) < 0.02
    assert "multiply-adds an action" in str(report)


def test_it_acts_where_an_sb3_policy_does() -> None:
    mean, _ = evaluate_policy(made_up(4, 2), gym.make(LINEAR), n_eval_episodes=1, warn=False)
    assert np.isfinite(mean)


def test_inputs_stay_within_their_bounds() -> None:
    policy = made_up()
    sizes = np.geomspace(0.1, 1e3, 500)[:, None]
    wild = policy.network.mean + sizes * policy.network.spread * np.random.default_rng(1).normal(size=(500, 3))
    actions, state = policy.predict(wild)
    assert state is None
    assert (actions >= policy.action_space.low).all()
    assert (actions <= policy.action_space.high).all()
    assert np.unique(actions[:, 0]).size > 2
    torch.testing.assert_close(policy(torch.from_numpy(wild)), torch.from_numpy(actions))


def test_past_inputs_are_inputs_of_the_network() -> None:
    """With dead time and prices on changes the state that travels is what the MPC's layout would remember."""
    mpc, observations = of_case("late, with a signal")
    small = MPCPolicy(mpc).distill(observations, n_steps=20, **FAST)
    assert small.network.nz == mpc.nx > mpc.ny
    assert small.report.model.loss < 0.2
    state, memory = None, mpc.layout.filled(mpc.usual_input)[None]
    for y in observations[:5]:
        expected = small.network(np.hstack([y[None], memory]))
        action, state = small.predict(y[None], state)
        np.testing.assert_allclose(action, expected, rtol=1e-6)
        memory = mpc.layout.remembered(memory, action.astype(np.float64))
        np.testing.assert_array_equal(state[0], memory)
    fresh, _ = small.predict(observations[:1], state, episode_start=[True])
    np.testing.assert_array_equal(fresh, small.predict(observations[:1])[0])
    with pytest.raises(InvalidArgumentError, match="past inputs"):
        small.predict(observations[:2], state)


@pytest.mark.parametrize("memory", [0, 2])
def test_a_file_holds_all_of_it(memory: int, tmp_path: Path) -> None:
    policy = made_up(memory=memory)
    policy.save(tmp_path / "small.zip")
    loaded = DistilledPolicy.load(tmp_path / "small")
    seen = policy.network.mean[:3] + policy.network.spread[:3] * np.random.default_rng(2).normal(size=(20, 3))
    np.testing.assert_array_equal(loaded.predict(seen)[0], policy.predict(seen)[0])
    assert loaded.report == policy.report
    assert (loaded.y_labels, loaded.memory_names) == (policy.y_labels, policy.memory_names)
    with pytest.raises(FileFormatError, match="explicit policy"):
        load_policy(tmp_path / "small.zip")


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("weights_0", np.zeros((38, 4))),
        ("spread", np.zeros(3)),
        ("low", np.full(2, 9.0)),
        ("biases_1", np.full(38, np.nan)),
        ("weights_7", np.zeros((1, 1))),
    ],
)
def test_damaged_arrays_are_refused(name: str, array: np.ndarray) -> None:
    with pytest.raises(FileFormatError):
        PolicyNetwork.from_arrays(made_up().network.to_arrays() | {name: array})


@pytest.mark.parametrize("memory", [0, 2])
@pytest.mark.parametrize("flags", [(), ("-DPOLICY_FLOAT",)])
def test_the_c_code_passes_its_test(memory: int, flags: tuple[str, ...], tmp_path: Path) -> None:
    # A float has no digits left for a column of small changes far from zero.
    files = export_explicit_c(made_up(memory=memory, offset=0.0 if flags else 1e4), tmp_path)
    assert {file.name for file in files} >= {"explicit_policy.c", "explicit_policy.h", "CMakeLists.txt"}
    sources = [tmp_path / "explicit_policy.c", tmp_path / "explicit_test.c"]
    strict = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")
    command = [find_compiler(), *strict, *flags, *map(str, sources), "-o", str(tmp_path / "program"), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    done = subprocess.run([tmp_path / "program"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "24 steps" in done.stdout


def test_the_c_code_of_the_largest_network_is_small(tmp_path: Path) -> None:
    for ny, nu in ((3, 1), (5, 1), (4, 2), (20, 3)):
        policy = made_up(ny, nu, hidden=widths_within(2000, ny, nu))
        files = export_explicit_c(policy, tmp_path)
        assert sum(file.stat().st_size for file in files if "explicit_policy" in file.name) < 20_000
        assert 1700 < policy.network.multiply_adds <= 2000


def test_an_input_at_its_bound_asks_for_no_more_than_that() -> None:
    """A saturated line is learned exactly, by a network that has a line: nothing is paid for beyond the bound."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-3.0, 3.0, (2000, 1))
    actions = np.clip(2.0 * states, -1.0, 1.0)
    network = PolicyNetwork.random(states, (np.array([-1.0]), np.array([1.0])), actions, (2,), rng)
    fitted = fit_policy(network, states, actions, n_steps=100, n_refined=100, seed=0)
    off = fitted(states) - actions
    assert np.sqrt(np.mean(off**2)) < 1e-3
    assert np.abs(off).max() < 1e-2


def test_multiply_adds_are_counted() -> None:
    assert multiply_adds(3, 1, (4, 5)) == 3 + 3 + 12 + 20 + 5 + 1
    with pytest.raises(InvalidArgumentError, match="multiply_adds"):
        widths_within(100, 50, 2)


def test_a_loop_that_runs_away_is_lost_and_costs_inf() -> None:
    model = Model(lambda x, u, p: x**3 + u, 1, 1, 1.0, discrete=True)
    mpc = MPC(model, QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 5, 1.0, [-0.1], [0.1])
    loops = closed_loops(mpc, lambda z: np.zeros((len(z), 1)), np.array([[0.5], [3.0]]), 12)
    assert np.isfinite(loops.cost()[0])
    assert loops.cost()[1] == np.inf
    states, _ = loops.rows()
    assert np.isfinite(states).all()


def test_what_cannot_be_distilled_is_refused() -> None:
    mpc = double_integrator(1.0)
    policy = MPCPolicy(mpc)
    observer = KalmanObserver(mpc, [0], noise=0.01, process=1e-3, start_spread=[1.0, 0.5])
    with pytest.raises(InvalidArgumentError, match="observer"):
        distill(OutputFeedbackPolicy(policy, observer), np.zeros((1, 2)))
    for wrong in (
        {},
        {"starts": np.zeros((2, 3))},
        {"starts": [[np.nan, 0.0]]},
        {"starts": np.zeros((1, 2)), "hidden": (50, 50)},
        {"starts": np.zeros((1, 2)), "hidden": ()},
        {"starts": np.zeros((1, 2)), "rounds": 0},
        {"starts": np.zeros((1, 2)), "effort": 0.0},
    ):
        with pytest.raises(InvalidArgumentError):
            policy.distill(**wrong)


def test_loss_is_measured_from_the_floor() -> None:
    plain, moved = Comparison.of([2.0, 4.0], [2.0, 3.0], 5), Comparison.of([7.0, 9.0], [7.0, 8.0], 5, floor=5.0)
    assert plain.loss == pytest.approx(moved.loss) == pytest.approx(0.2)
    assert plain.worst == pytest.approx(0.4)
    assert Comparison.of([0.0], [0.0], 5).loss == 0.0


@pytest.mark.interop
def test_onnx_is_the_policy_and_v(tmp_path: Path) -> None:
    """By onnxruntime where it is installed (scripts/test_interop), else by onnx's own reference."""
    pytest.importorskip("onnx")

    def run(path: Path, observations: np.ndarray) -> np.ndarray:
        try:
            from onnxruntime import InferenceSession

            session = InferenceSession(str(path))
        except ImportError:
            from onnx.reference import ReferenceEvaluator

            session = ReferenceEvaluator(str(path))
        return session.run(None, {"observation": observations})[0]

    rng = np.random.default_rng(0)
    for memory in (0, 2):
        policy = made_up(memory=memory)
        policy.save(tmp_path / "small.zip")
        (path,) = export_onnx(tmp_path / "small.zip", tmp_path)
        network = policy.network
        states = network.mean + network.spread * rng.normal(size=(100, network.nz))
        np.testing.assert_allclose(run(path, states), network(states), rtol=1e-5, atol=1e-5)
    for n_members in (1, 3):
        torch.manual_seed(0)
        value = ValueFunction(4, (32, 32), n_members)
        value.mean.copy_(torch.tensor([1e6, 0.0, 5.0, -3.0]))
        value.offset.fill_(1e5)
        value.scale.fill_(50.0)
        (path,) = export_onnx(value, tmp_path)
        states = value.mean.numpy() + rng.normal(size=(100, 4))
        np.testing.assert_allclose(run(path, states), value.predict(states), rtol=1e-9, atol=1e-4)


def test_what_is_no_network_has_no_onnx(tmp_path: Path) -> None:
    policy = MPCPolicy(double_integrator(1.0))
    policy.save(tmp_path / "policy.zip")
    with pytest.raises(FileFormatError, match="no network"):
        export_onnx(tmp_path / "policy.zip", tmp_path)
    with pytest.raises(InvalidArgumentError, match="distill"):
        export_onnx(policy, tmp_path)  # type: ignore[arg-type]
