"""A log of which many inputs never reached the plant: learner and diagnosis take the model from the same rows."""

from __future__ import annotations

import lq_plant
import numpy as np
from lq_plant import GAIN, A, B, QuadraticValue, R, W, quadratic

from mpcoffline import OfflineMPCLearner, TransitionTable
from mpcoffline.diagnostics import diagnose


def test_the_diagnosis_identifies_where_the_plant_took_the_logged_input() -> None:
    """Of inputs of a size of 2, the plant takes, and prices, no more than 1.5."""
    rng, steps, n = np.random.default_rng(0), 20, 60
    x = np.zeros((steps + 1, n, 2))
    x[0] = rng.uniform(-0.5, 0.5, (n, 2))
    u = np.zeros((steps, n, 1))
    for k in range(steps):
        u[k] = x[k] @ GAIN.T + rng.normal(scale=1.5, size=(n, 1))
        x[k + 1] = x[k] @ A.T + np.clip(u[k], -1.5, 1.5) @ B.T
    s, a, reached = (part.swapaxes(0, 1).reshape(n * steps, -1) for part in (x[:-1], u, x[1:]))
    costs, ids = quadratic(W, s) + quadratic(R, np.clip(a, -1.5, 1.5)), np.repeat(np.arange(n), steps)
    log = TransitionTable.from_arrays(s, a, costs, reached, np.zeros(n * steps), episode_ids=ids)
    learner = OfflineMPCLearner(
        lq_plant.make_mpc(),
        method="bellman",
        init="identified",
        stage_cost="auto",
        value_function=QuadraticValue(lq_plant.BEST.P),
        fit_n_steps=1,
        trim=1.0,
    )
    learner.fit(log, show_progress=False)
    np.testing.assert_allclose(learner.mpc.values["model.B"], B, atol=1e-4)
    report = diagnose(learner, log, n_starts=3, n_steps=5)
    assert report.prediction.identified < 1e-3
    assert report.prediction.learned < 1e-3
