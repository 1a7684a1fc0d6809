#!/usr/bin/env python3
"""mpcrl as its documentation does it: a linear MPC with learnable parameters, trained by LSTD Q-learning off-policy.

    .venv-interop/bin/python scripts/their_examples/mpcrl_example.py [TRANSITIONS]

What is ours are the rollouts that it is trained on. scripts/test_interop runs it. A few transitions learn little; what
is shown is that everything runs.
"""

from __future__ import annotations

import sys
from typing import Any

import casadi as ca
import numpy as np
from csnlp import Nlp
from csnlp.wrappers import Mpc
from mpcrl import ExperienceReplay, LearnableParameter, LearnableParametersDict, LstdQLearningAgent, UpdateStrategy
from mpcrl.optim import GradientDescent

from mpcoffline.datasets import to_dict

DATA, DISCOUNT, HORIZON = "mpcoffline/linear/ddpg-v0", 0.9, 8
SARS = ("observations", "actions", "costs", "next_observations")
A = np.array([[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.9, 0.0], [0.0, 0.0, 0.0, 0.9]])
B = np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
SOLVER = {"expand": True, "print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}


def linear_mpc() -> Any:
    """The task's rough model, with what its model and cost lack to be learned: b, f and a constant."""
    mpc: Any = Mpc(Nlp(sym_type="SX"), prediction_horizon=HORIZON)
    constant, b, f = mpc.parameter("constant"), mpc.parameter("b", (4, 1)), mpc.parameter("f", (6, 1))
    x, _ = mpc.state("x", 4)
    u, _ = mpc.action("u", 2, lb=-10.0, ub=10.0)
    mpc.set_affine_dynamics(A, B, c=b)
    weights = ca.DM([9.0, 9.0, 1.0, 1.0, 0.1, 0.1])
    cost = constant
    for k in range(HORIZON):
        z = ca.vertcat(x[:, k], u[:, k])
        cost += DISCOUNT**k * (ca.dot(weights * z, z) + ca.dot(f, z))
    mpc.minimize(cost + DISCOUNT**HORIZON * 30.0 * ca.sumsqr(x[:, HORIZON]))
    mpc.init_solver(SOLVER, solver="ipopt")
    return mpc


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    start = {"constant": np.zeros((1, 1)), "b": np.zeros((4, 1)), "f": np.zeros((6, 1))}
    agent: Any = LstdQLearningAgent(
        mpc=linear_mpc(),
        update_strategy=UpdateStrategy(1, hook="on_episode_end"),
        discount_factor=DISCOUNT,
        optimizer=GradientDescent(learning_rate=1e-5),
        experience=ExperienceReplay(maxlen=n, sample_size=n, seed=0),
        learnable_parameters=LearnableParametersDict(
            [LearnableParameter(name, value.shape, value) for name, value in start.items()]
        ),
    )
    # Theirs: rollouts of (state, action, cost, next state) from an environment, as by agent.train(env=env, episodes=1)
    log = to_dict(DATA)
    rollouts = [zip(*(log[name][:n] for name in SARS), strict=True)]
    agent.train_offpolicy(rollouts, seed=69)
    moved = {name: np.abs(agent.learnable_parameters[name].value - value).max() for name, value in start.items()}
    if not all(0.0 < each < 1.0 for each in moved.values()):
        raise SystemExit(f"mpcrl: expected each parameter to move a little, got {moved}")
    said = ", ".join(f"{name} by {each:.2g}" for name, each in moved.items())
    print(f"mpcrl: an update of LSTD Q-learning on {n} transitions moved {said}")


if __name__ == "__main__":
    main()
