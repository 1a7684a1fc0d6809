#!/usr/bin/env python3
"""Times LSTD-Q learning of mpcrl on the first transitions of a log that was handed over; nothing is kept of it.

    ENV/bin/python scripts/field_peers/mpcrl_peer.py data.npz ignored '{"transitions": 20}'

Runs in an environment of its own that scripts/bench_field makes, without the project. The data hold an MPC as CasADi
functions of (x, u, theta): ``dynamics``, ``stage``, ``terminal`` (of (x, theta)), serialised, its ``theta``,
``horizon``, ``discount``, bounds ``low``, ``high``, and ``states``, ``actions``, ``costs``, ``next_states``. For each
transition mpcrl solves two MPCs by ipopt, Q(s, a) and V(s+), and differentiates Q. The last line it prints is JSON.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any

import numpy as np

OPTIONS: dict[str, Any] = {
    "expand": True,
    "print_time": False,
    "error_on_fail": False,
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 500},
}


def end_with(parent: int) -> None:
    """Ends this process soon after the one that started it."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def program(data: dict[str, np.ndarray]) -> Any:
    """The MPC as one of csnlp's, by multiple shooting, theta one learnable parameter."""
    import casadi as ca
    from csnlp import Nlp
    from csnlp.wrappers import Mpc

    dynamics, stage, terminal = (ca.Function.deserialize(str(data[name])) for name in ("dynamics", "stage", "terminal"))
    horizon, discount = int(data["horizon"]), float(data["discount"])
    mpc = Mpc(Nlp(sym_type="MX"), prediction_horizon=horizon)
    theta = mpc.parameter("theta", (len(data["theta"]), 1))
    x, _ = mpc.state("x", data["states"].shape[1])
    u, _ = mpc.action("u", data["actions"].shape[1], lb=data["low"][:, None], ub=data["high"][:, None])
    cost = discount**horizon * terminal(x[:, horizon], theta)
    for k in range(horizon):
        mpc.constraint(f"step_{k}", x[:, k + 1], "==", dynamics(x[:, k], u[:, k], theta))
        cost += discount**k * stage(x[:, k], u[:, k], theta)
    mpc.minimize(cost)
    mpc.init_solver(OPTIONS, solver="ipopt")
    return mpc


def held(state: np.ndarray, action: np.ndarray, horizon: int) -> dict[str, np.ndarray]:
    """The plan that a solve begins at: all as it is now. From zeros, a reference there stops ipopt at once."""
    return {"x": np.tile(state[:, None], (1, horizon + 1)), "u": np.tile(action[:, None], (1, horizon))}


def main() -> None:
    from mpcrl import ExperienceReplay, LearnableParameter, LearnableParametersDict, LstdQLearningAgent
    from mpcrl.optim import NewtonMethod

    end_with(os.getppid())
    job = json.loads(sys.argv[3])
    with np.load(sys.argv[1]) as file:
        data = dict(file)
    n = min(job["transitions"], len(data["states"]))
    theta = data["theta"]
    agent = LstdQLearningAgent(
        mpc=program(data),
        update_strategy=n,
        discount_factor=float(data["discount"]),
        optimizer=NewtonMethod(learning_rate=1e-3),
        learnable_parameters=LearnableParametersDict([LearnableParameter("theta", (len(theta), 1), theta[:, None])]),
        experience=ExperienceReplay(maxlen=n, sample_size=n, include_latest=n),
        hessian_type="approx",
    )
    columns = (data[name][:n] for name in ("states", "actions", "costs", "next_states"))
    rollout = list(zip(*columns, strict=True))
    start = time.process_time()
    for state, action, cost, state_next in rollout:
        solved_q = agent.action_value(state, action, vals0=held(state, action, int(data["horizon"])))
        _, solved_v = agent.state_value(state_next, False, vals0=held(state_next, action, int(data["horizon"])))
        agent._try_store_experience(float(cost), solved_q, solved_v)
    seconds = time.process_time() - start
    print(json.dumps({"train_s": seconds, "transitions": n, "solved": len(agent.experience)}))


if __name__ == "__main__":
    main()
