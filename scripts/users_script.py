"""What a user writes: check_wheel.py type-checks this file against an installed wheel, then runs it there.

Run in a folder of its own; MINARI_DATASETS_PATH says where data sets go.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, assert_type

import casadi as ca
import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import DDPG
from stable_baselines3.common.evaluation import evaluate_policy

import mpcoffline
from mpcoffline import (
    MPC,
    Constraint,
    InvalidArgumentError,
    MinariRecorder,
    Model,
    MPCModel,
    MPCPolicy,
    OfflineMPCLearner,
    Parameter,
    Penalty,
    QuadraticCost,
    StateBounds,
    TransitionTable,
    evaluate,
    make_solver,
    nominal_mpc,
)
from mpcoffline.datasets import record, to_dict, verify
from mpcoffline.learning import fit_value
from mpcoffline.learning.value.fit import ValueConfig
from mpcoffline.solvers import Solution

TASK = "mpcoffline/LinearTracking-v0"
Array = NDArray[np.float64]


def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    """A sledge: position and speed, force."""
    return ca.vertcat(x[1], (u[0] - p["c"] * x[1]) / p["m"])


def sledge(**changes: Any) -> MPC:
    """Its MPC."""
    mpc = MPC(
        model=Model(ode, nx=2, nu=1, dt=0.05, parameters={"m": Parameter(1.0, low=0.1, unit="kg"), "c": 0.1}),
        stage_cost=QuadraticCost(W=np.diag([1.0, 0.1]), R=[[0.01]]),
        terminal_cost=QuadraticCost(W=np.diag([10.0, 1.0])),
        horizon=10,
        discount=0.95,
        action_low=[-2.0],
        action_high=[2.0],
    )
    return mpc.replace(**changes)


def log_of_a_sledge(n: int) -> TransitionTable:
    """Random transitions of a sledge of 1.3 kg."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-2.0, 2.0, (n, 2)), rng.uniform(-2.0, 2.0, (n, 1))
    costs: Array = x[:, 0] ** 2 + 0.1 * x[:, 1] ** 2 + 0.01 * u[:, 0] ** 2
    following = x + 0.05 * np.c_[x[:, 1], u[:, 0] / 1.3]
    return TransitionTable.from_arrays(x, u, costs, following, np.zeros(n, dtype=bool))


def solve() -> None:
    """One state, a batch, a warm start, constraints, every solver."""
    for name in ("auto", "ddp", "ipopt"):
        solver = make_solver(sledge(), name)
        solution = solver.solve([[1.0, 0.0], [0.5, -0.2]])
        assert_type(solution, Solution)
        assert_type(solution.value, Array)
        again = solver.solve([[1.0, 0.0], [0.5, -0.2]], warm_start=solution.plan.shifted())
        if not (solution.success.all() and again.success.all()):
            raise SystemExit(f"{solver.name}: {solution.words}")
        values: Array = solver.q_value([1.0, 0.0], [0.3])
        print(solver.name, solution.u0.ravel(), values)
    slow = [StateBounds([-np.inf, -0.5], [np.inf, 0.5], soft=Penalty(l1=10.0))]
    gentle = Constraint(lambda x, u, p: u - 1.0, name="force")
    for constraints in (slow, [gentle]):
        print(make_solver(sledge(constraints=constraints)).solve([1.0, 0.0]).words)


def learn() -> None:
    """From a log of an own plant to theta."""
    table = log_of_a_sledge(2_000)

    def spread(learner: OfflineMPCLearner, table: TransitionTable) -> float:
        return float(np.std(table.costs))

    def stop(learner: OfflineMPCLearner, epoch: int, total_step: int) -> bool | None:
        return epoch < 3

    learner = OfflineMPCLearner(
        sledge(), learn="cost+model", preset="paper", seed=0, value_n_steps=300, hidden=(32, 32)
    )
    history = learner.fit(table, evaluators={"spread": spread}, callbacks=[stop], show_progress=False)
    epoch, metrics = history[-1]
    assert_type(epoch, int)
    assert_type(metrics["spread"], float)
    theta: Array = learner.mpc.theta
    print(epoch, metrics, theta, dict(learner.mpc.values).keys())
    value = fit_value(table, 0.95, ValueConfig(n_steps=50, hidden=(16,)), seed=0)
    v: Array = value.predict([[1.0, 0.0]])
    print(v)


def control() -> None:
    """The policy in Gymnasium, in SB3, and in files."""
    env = gym.make(TASK)
    policy = MPCPolicy(nominal_mpc(TASK))
    observation, _ = env.reset(seed=0)
    action, state = policy.predict(observation)
    action, state = policy.predict(observation, state=state)
    assert_type(action, NDArray[Any])
    if not env.action_space.contains(action):
        raise SystemExit(f"{action} is no action")
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=1, warn=False)
    result = evaluate(policy, env, n_episodes=2, seed=0)
    costs: Array = result.cost
    policy.save("policy.zip")
    print(mean, costs, result.success, MPCPolicy.load("policy.zip").solver_stats)
    model = MPCModel.load("policy.zip", env=TASK)
    print(model.predict(observation)[0])


def keep_data() -> None:
    """Recorded by an agent, by a policy, from arrays; read back."""
    env = gym.make(TASK)
    DDPG("MlpPolicy", env, learning_starts=100, seed=0).learn(300, callback=MinariRecorder("mine/linear/agent-v0"))
    dataset = record(env, MPCPolicy(nominal_mpc(TASK)), n_episodes=2, dataset_id="mine/linear/mpc-v0", seed=0)
    table = TransitionTable.from_minari(mpcoffline.load_dataset("mine/linear/agent-v0"))
    arrays: dict[str, NDArray[Any]] = to_dict(table)
    print(dataset.total_steps, len(table), sorted(arrays), verify("mine/linear/mpc-v0").ok)
    print(*(f"{row.id} ({row.steps})" for row in mpcoffline.list_datasets()))


def refuse() -> None:
    """Errors are the package's own."""
    try:
        sledge(horizon=0)
    except InvalidArgumentError as error:
        print(error.name, error.expected, error.actual)
    else:
        raise SystemExit("a horizon of 0 was not refused")


if __name__ == "__main__":
    for chapter in (refuse, solve, control, keep_data, learn):
        chapter()
    print(*sorted(path.name for path in Path().iterdir()))
