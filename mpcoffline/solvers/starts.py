"""Starting points of cold solves: fixed input sequences that are rolled out, the cheapest of which are refined."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.mpc import MPC

N_CANDIDATES = 64
N_RANDOM = 8  # of them have random levels
N_ONCE = 32  # at most, two a segment, switch once between the bounds; the others do so at random
SEGMENT = 2  # steps for which every sequence holds its value
HOLD = 3  # segments for which a random level is held
SHORTEST, LONGEST = 0.08, 0.4  # time between two switches, relative to the horizon
SIZES = 10.0 ** np.array([0.0, -2.0, 2.0, -4.0, 4.0, -1.0, 1.0, -3.0])  # of inputs without bounds, one after the other
_WIDE = 1e19  # a bound beyond is none, as for ipopt
_SEED = 11  # of three, the one with the most best minima of both swing-ups


def candidate_inputs(mpc: MPC) -> NDArray[np.float64]:
    """64 input sequences ``(64, N, nu)``: zero, random levels within the bounds, and switching between the bounds.

    Swing-ups pump energy with full inputs, and their minima differ in when these change sign. To reach an unstable
    equilibrium from a state on its way there, one switch at the right time does it, so half of them switch once, at
    times spread over the horizon; random switches lead there rarely. The random levels serve plants that full inputs
    drive away. They are sorted by where they begin and how often or when they switch, so that neighbours are alike.
    All are the same at each call, so that equal problems get equal solutions.

    An input without a bound on one side or both has a range in its place, see :func:`_ranges`.
    """
    rng = np.random.default_rng(_SEED)
    low, high = _ranges(mpc)
    segments = -(-mpc.horizon // SEGMENT)
    n_once = min(N_ONCE, 2 * segments)
    n = N_CANDIDATES - n_once
    levels = rng.uniform(low[:n], high[:n], size=(n, -(-segments // HOLD), mpc.nu))
    values = np.repeat(levels, HOLD, axis=1)[:, :segments]
    full = slice(N_RANDOM, n)
    values[full] = np.where(_switching(rng, values[full].shape), high[full], low[full])
    values[0] = np.clip(0.0, mpc.action_low, mpc.action_high)
    once = np.where(_switching_once(rng, (n_once, segments, mpc.nu)), high[n:], low[n:])
    return np.repeat(np.concatenate([values, once]), SEGMENT, axis=1)[:, : mpc.horizon].copy()


def _ranges(mpc: MPC) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Between which levels the inputs of each candidate are, two arrays ``(64, 1, nu)``: the bounds.

    Where a bound is missing, nobody knows how large an input is. So the ranges of neighbouring candidates have sizes
    that are powers of ten apart, of which the rollouts choose. They are multiples of the largest number that is known
    (the other bound, the input reference and its distance from that), or of 1 where all are zero, and begin at the
    other bound, or lie around the reference.
    """
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    low, high = np.where(low > -_WIDE, low, -np.inf), np.where(high < _WIDE, high, np.inf)
    reference = mpc.values.get("stage_cost.u_ref", np.zeros(0))
    reference = np.clip(reference if reference.shape == (mpc.nu,) else np.zeros(mpc.nu), low, high)
    bound = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high, reference))
    unit = np.maximum.reduce([np.abs(bound), np.abs(reference), np.abs(reference - bound)])
    sizes = np.resize(SIZES, N_CANDIDATES)[:, None, None] * np.where(unit > 0.0, unit, 1.0)
    return np.where(np.isfinite(low), low, bound - sizes), np.where(np.isfinite(high), high, bound + sizes)


def _switching_once(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Truth values ``(n, segments, nu)`` that change once, all inputs together; the first begins as true in half."""
    n, segments, nu = shape
    times = np.arange(n) % (n // 2) * segments // (n // 2)
    first = rng.integers(0, 2, size=(n, 1, nu)).astype(bool)
    first[:, 0, 0] = np.arange(n) < n // 2
    before = np.arange(segments)[None, :, None] < times[:, None, None]
    return np.asarray(before == first)


def _switching(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Truth values ``(n, segments, nu)`` that change after random numbers of segments."""
    n, segments, nu = shape
    shortest = max(1, round(SHORTEST * segments))
    longest = max(shortest, round(LONGEST * segments))
    switches = np.cumsum(rng.integers(shortest, longest + 1, size=shape), axis=1)
    so_far = (switches[:, :, None] <= np.arange(segments)[None, None, :, None]).sum(axis=1)
    first = rng.integers(0, 2, size=(n, 1, nu))
    order = np.lexsort((so_far[:, -1].sum(axis=1), first[:, 0, 0]))
    return np.asarray((so_far + first) % 2 == 1)[order]
