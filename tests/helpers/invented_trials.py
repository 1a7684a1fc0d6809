"""Trials of controllers with numbers that somebody chose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.simulation.trials import Trials

Array = NDArray[np.float64]


def trials(
    gains: Mapping[str, ArrayLike],
    *,
    level: float = 100.0,
    spread: float = 10.0,
    n_starts: int = 64,
    noise: float = 1.0,
    votes: ArrayLike | None = None,
    second: Mapping[str, ArrayLike] | None = None,
    today: float | None = None,
    clone: float | None = None,
    seed: int = 0,
) -> Trials:
    """MPC_1 costs ``level`` on the mean and others less by their ``gains``, one a model.

    Args:
        gains: What each controller saves on each model, ``(models,)``.
        level: Mean cost of MPC_1.
        spread: Standard deviation over the starts that all share.
        n_starts: Number of starts.
        noise: Standard deviation of each cost besides.
        votes: Which models have one; all by default.
        second: Gains by the other regression of the cost; the same by default.
        today: Mean cost of the log; none is as long by default.
        clone: Mean cost of the clone of today's controller; there is none by default.
        seed: Of the noise.
    """
    rng = np.random.default_rng(seed)
    m = len(np.atleast_1d(next(iter(gains.values()))))
    common = level + spread * rng.permutation(np.linspace(-1.7, 1.7, n_starts))

    def costs(saved: ArrayLike) -> Array:
        each = rng.normal(size=(m, n_starts))
        return common - np.broadcast_to(np.asarray(saved, np.float64), m)[:, None] + noise * each

    named = {"MPC_1": 0.0} | dict(gains) | ({} if clone is None else {"today": level - clone})
    cost = np.stack([costs(saved) for saved in named.values()])
    other = np.stack([costs((second or {}).get(name, saved)) for name, saved in named.items()])
    returns = np.full(n_starts, np.nan) if today is None else common + today - level
    return Trials(
        names=tuple(named),
        models=("identified", *(f"residual {k}" for k in range(1, m))),
        votes=np.ones(m, dtype=bool) if votes is None else np.asarray(votes, dtype=bool),
        cost=cost,
        second=other,
        lost=np.zeros(cost.shape, dtype=bool),
        rows=100 * np.arange(n_starts),
        returns=returns,
        begun=np.ones(n_starts, dtype=bool),
        judged=np.ones(n_starts, dtype=bool),
        n_steps=50,
    )
