#!/usr/bin/env python3
"""d3rlpy as its documentation begins: get a data set, fit CQL, evaluate it. One line is ours, where the data come from.

    .venv-interop/bin/python scripts/their_examples/d3rlpy_example.py [STEPS]

scripts/test_interop runs it. A few steps learn nothing; what is shown is that everything runs.
"""

from __future__ import annotations

import math
import sys

import d3rlpy
import gymnasium as gym

import mpcoffline  # noqa: F401  its environments
from mpcoffline.datasets import to_d3rlpy

TASK, DATA = "mpcoffline/PendulumSwingUp-v0", "mpcoffline/pendulum/ddpg-v0"


def main() -> None:
    n_steps = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    # Theirs: dataset, env = d3rlpy.datasets.get_dataset("hopper-medium-v0")
    dataset, env = to_d3rlpy(DATA), gym.make(TASK)

    d3rlpy.seed(1)
    d3rlpy.envs.seed_env(env, 1)
    cql = d3rlpy.algos.CQLConfig(batch_size=64).create(device="cpu:0")
    history = cql.fit(
        dataset,
        n_steps=n_steps,
        n_steps_per_epoch=n_steps,
        evaluators={"environment": d3rlpy.metrics.EnvironmentEvaluator(env, n_trials=1)},
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
    )
    ((_, metrics),) = history
    action = cql.predict(env.reset(seed=0)[0][None])
    if action.shape != (1, 1) or not all(map(math.isfinite, metrics.values())):
        raise SystemExit(f"d3rlpy: expected finite metrics and an action, got {metrics}, {action}")
    print(f"d3rlpy {d3rlpy.__version__}: {n_steps} steps of CQL, return {metrics['environment']:.1f}")


if __name__ == "__main__":
    main()
