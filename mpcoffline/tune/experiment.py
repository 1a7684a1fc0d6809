"""Which experiment would determine a parameter that a log leaves open: which input, how far, how long."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

_SIZES = (0.1, 0.2, 0.4)  # of an input's range, to either side
_STEPS = 300  # that are simulated
_WINDOW = 50  # after which a state is known again
_LONGEST = 20_000  # steps that anybody would wait
_WANTED = 0.1  # relative deviation
_ABSURD = 1e100


class Experiment(NamedTuple):
    """A random binary signal about the middle of an input's range.

    Attributes:
        parameter: What it determines to 10 %.
        input: Which input, its place.
        amplitude: To either side, in the input's unit.
        hold: Steps that a value is kept at least.
        steps: Its length.
    """

    parameter: str
    input: int
    amplitude: float
    hold: int
    steps: int


def experiments(mpc: MPC, names: list[str], about: Array, noise: Array, hold: int) -> dict[str, Experiment | None]:
    """The shortest experiment of each parameter, None where no input moves what it changes.

    ::

        information = sum_k S_k' R^-1 S_k,      S_{k+1} = df/dx S_k + df/dtheta,      R = noise^2

    of simulated responses, all parameters unknown together; it grows with the length.

    Args:
        mpc: Its parameters are the best that are known.
        names: Of parameters, as in ``mpc.model.space``.
        about: State and present signals about which it is done, ``(n_states + n_signals,)``.
        noise: Standard deviation of the measurements, ``(n_states,)``.
        hold: Steps that a value is kept at least.
    """
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    best: dict[str, Experiment | None] = dict.fromkeys(names)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return best
    every, theta = mpc.model.space.names, mpc.model.space.theta
    for i in range(mpc.nu):
        for size in _SIZES:
            amplitude = size * float(high[i] - low[i])
            information = _information(mpc, about, noise, i, amplitude, hold)
            deviation = _deviations(information)
            for name in names:
                k = every.index(name)
                relative = deviation[k] / (abs(theta[k]) or 1.0)
                steps = _STEPS * (relative / _WANTED) ** 2
                known = best[name]
                if steps <= _LONGEST and (known is None or steps < 0.5 * known.steps):
                    best[name] = Experiment(name, i, amplitude, hold, max(20, round(steps)))
    return best


def _information(mpc: MPC, about: Array, noise: Array, i: int, amplitude: float, hold: int) -> Array:
    """What a simulated experiment says of the parameters, ``(p, p)``."""
    n = mpc.layout.n_states
    x, u, p = ca.SX.sym("x", n), ca.SX.sym("u", mpc.model.plant.numel_in(1)), ca.SX.sym("p", mpc.model.space.size)
    reached = mpc.model.plant(x, u, p)
    step = ca.Function("step", [x, u, p], [reached, ca.jacobian(reached, x), ca.jacobian(reached, p)])
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    middle, rng = np.clip((low + high) / 2.0, low + amplitude, high - amplitude), np.random.default_rng(0)
    state, theta = about[:n].copy(), mpc.model.space.theta
    slopes, total, sign = np.zeros((n, len(theta))), np.zeros((len(theta), len(theta))), 1.0
    for k in range(_STEPS):
        if k % hold == 0 and rng.random() < 0.5:
            sign = -sign
        if k % _WINDOW == 0:
            slopes[:] = 0.0
        inputs = middle.copy()
        inputs[i] += sign * amplitude
        state, F, df = (part.full() for part in step(state, np.append(inputs, about[n:]), theta))
        with np.errstate(over="ignore", invalid="ignore"):
            state, slopes = state.ravel(), F @ slopes + df
            more = (slopes / noise[:, None]).T @ (slopes / noise[:, None])
        if np.isfinite(state).all() and np.isfinite(more).all() and more.max() < _ABSURD:
            total += more
        else:  # the simulated plant has run away
            state, slopes = about[:n].copy(), np.zeros_like(slopes)
    return total


def _deviations(information: Array) -> Array:
    """Standard deviations with all unknown; infinite where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(information), 0.0))
    unit = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(unit, unit))
    with np.errstate(divide="ignore"):
        inverse = np.where(values > 1e-9 * max(float(values.max()), 1e-300), 1.0 / np.maximum(values, 1e-300), np.inf)
    share = vectors**2
    variance = np.where(share > 1e-9, share * np.where(np.isinf(inverse), 1e300, inverse), 0.0).sum(axis=1)
    return np.where((size > 0.0) & (variance < 1e299), np.sqrt(variance) / unit, np.inf)
