"""Problems of each kind for what writes an MPC as a program for another library: plain, delayed, priced, limited."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import casadi as ca
import numpy as np
from mpc_problems import random_states
from numpy.typing import NDArray
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, Signal, StateBounds
from mpcoffline.plants.nominal import nominal_mpc

N_OBSERVATIONS = 100


def of_case(case: str) -> tuple[MPC, NDArray[np.float64]]:
    """A problem of 20 steps, and observations."""
    rng = np.random.default_rng(0)
    if case in (LINEAR, PENDULUM, CARTPOLE):
        return nominal_mpc(case).replace(horizon=20), random_states(case, N_OBSERVATIONS)
    stage, goal = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]]), QuadraticCost(np.eye(2))
    if case == "late, with a signal":
        model = Model(
            lambda x, u, p, d: ca.vertcat(x[0] + 0.2 * x[1] + 0.1 * d.load, 0.9 * x[1] + 0.2 * ca.sin(u[0])),
            2,
            1,
            0.2,
            discrete=True,
            delay=2,
            signals=[Signal("load", usual=0.3)],
        )
        observations = rng.uniform(-1.0, 1.0, (N_OBSERVATIONS, 3))
        priced = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]], D=[[0.2]])
        return MPC(model, priced, goal, 20, 0.95, [-1.0], [1.0]), observations
    if case == "late, with rates":
        model = Model(
            lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], 0.9 * x[1] + 0.3 * ca.sin(u[0])),
            2,
            1,
            0.2,
            discrete=True,
            delay=1,
        )
        limits = [
            Constraint(lambda x, u, before, p: ca.vertcat(u - before, before - u) - 0.25, "rate", uses_previous=True),
            StateBounds([-np.inf, -0.3], [np.inf, 0.3], "speed", Penalty(2.0, 4.0)),
        ]
        observations = rng.uniform([-1.0, -0.4], [1.0, 0.4], (N_OBSERVATIONS, 2))
        return MPC(model, stage, goal, 20, 0.97, [-1.0], [1.0], constraints=limits), observations
    limits = [
        StateBounds([-np.inf, -0.4], [np.inf, 0.4], "speed", Penalty(3.0)),
        Constraint(lambda x, u, p: ca.vertcat(x[1] * u[0] - 0.2, -x[1] * u[0] - 0.2), "power"),
        Constraint(lambda x, p: ca.vertcat(x[0] - 0.1, -x[0] - 0.1), "end", Penalty(1.0, 5.0), terminal=True),
    ]
    model = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * ca.sin(u[0])), 2, 1, 0.2, discrete=True)
    observations = rng.uniform([-1.0, -0.5], [1.0, 0.5], (N_OBSERVATIONS, 2))
    return MPC(model, stage, goal, 20, 0.97, [-1.0], [1.0], constraints=limits), observations


def script_in(folder: Path, name: str) -> ModuleType:
    """A script that was written, as a module."""
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
