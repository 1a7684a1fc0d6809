"""Open-loop prediction over many steps: identification by it, and windows of the log to judge models on."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .identification import OneStepProblem
from .trajectories import Trajectories
from .uncertainty import Misfit, clusters

_DAMPING = (1e-6, 1e-9, 1e9)  # at first, least, most
_ATTEMPTS = 12  # at a step that lowers the error
_SETTLED = 1e-8  # relative decrease of the error
_ABSURD = 1e3  # spreads: a prediction this far off counts no more, and says nothing about parameters
_WEAKEST_PRIOR = 1e-10


class Windows(NamedTuple):
    """Stretches of consecutive rows of one length at most, side by side; states in units of their spread.

    Attributes:
        y: Measured states, ``(H + 1, W, nx)``.
        u: Inputs, ``(H, W, nu)``.
        valid: Where there is a transition; a window is valid from its start on, ``(H, W)``.
        rows: Row of the table at which each begins, ``(W,)``.
        scale: The unit of each state, ``(nx,)``.
    """

    y: Array
    u: Array
    valid: NDArray[np.bool_]
    rows: NDArray[np.intp]
    scale: Array

    @classmethod
    def of(cls, found: Trajectories, length: int, stride: int, *, full: bool) -> Windows:
        """The windows of some trajectories.

        Args:
            found: The trajectories.
            length: Steps of a window.
            stride: From the start of one to that of the next.
            full: Whether shorter ones at the end of a trajectory are left out.
        """
        lengths, most = found.valid.sum(axis=1), found.valid.shape[1]
        least = length if full else min(2, length)
        e, t = np.array(
            [(e, t) for e, n in enumerate(lengths) for t in range(0, n - least + 1, stride)], np.intp
        ).reshape(-1, 2).T  # fmt: skip
        steps = t[:, None] + np.arange(length + 1)
        states, inside = np.minimum(steps, most), np.minimum(steps[:, :-1], most - 1)
        valid = np.asarray((steps[:, :-1] < lengths[e][:, None]).T)
        u = found.inputs[e[:, None], inside].swapaxes(0, 1)
        return cls(found.measured[states.T, e], u, valid, found.index[e, t], found.scale)

    def __len__(self) -> int:
        """How many there are."""
        return len(self.rows)

    def chosen(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Windows:
        """Some of them."""
        y, u, valid, rows, scale = self
        return Windows(y[:, which], u[:, which], valid[:, which], rows[which], scale)


def open_loop(mpc: MPC, windows: Windows) -> Array:
    """Prediction errors in spreads, from the measured starts, ``(H + 1, W, nx)``; what is absurd counts as that."""
    x, errors = windows.y[0] * windows.scale, [np.zeros_like(windows.y[0])]
    for u, y in zip(windows.u, windows.y[1:], strict=True):
        x = mpc.plant_function(x.T, u.T, mpc.theta).full().T
        off = x / windows.scale - y
        good = (np.abs(off) < _ABSURD).all(axis=1)
        errors.append(np.where(good[:, None], off, _ABSURD))
        x = np.where(np.isfinite(x), x, 1e6 * windows.scale)
    return np.stack(errors)


class _Pass(NamedTuple):
    """A simulation of all windows, and its least-squares problem in the starts x and in theta."""

    cost: float
    error: Array  # of each state, (H + 1, W, nx)
    A: Array  # of the starts alone, (W, nx, nx)
    B: Array  # of starts and z, (W, nx, p)
    C: Array  # of z alone, (p, p)
    g_start: Array  # (W, nx)
    g_theta: Array  # (W, p)


class MultiStepProblem:
    """Output error: parameters and the start of each window, by least squares of all its states.

    ::

        min_{z, x_0}  sum_windows sum_{t=0..H} |(x_t - y_t) / scale|^2 + sigma^2 |z / spread|^2,   x_{t+1} = f(x_t, u_t)

    by Levenberg and Marquardt; the starts are eliminated, window by window (their Hessian is block diagonal).

    Args:
        mpc: The MPC; its parameters are theta_0.
        windows: The data.
        spread: Standard deviation of the prior in the scaled coordinates z.
    """

    windows: Windows
    coordinates: OneStepProblem

    def __init__(self, mpc: MPC, windows: Windows, coordinates: OneStepProblem, spread: float) -> None:
        self.windows, self.coordinates, self._spread = windows, coordinates, spread
        f, index = mpc.plant_function, np.flatnonzero(coordinates.coordinates.mask)[coordinates.free]
        nx, nu = windows.y.shape[2], windows.u.shape[2]
        x, u, theta = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("theta", len(mpc.theta))
        reached = ca.densify(f(x, u, theta))
        slopes = ca.jacobian(reached, theta)[:, index.tolist()]
        parts = [reached, *(ca.vec(ca.densify(part.T)) for part in (ca.jacobian(reached, x), slopes))]
        self._step = ca.Function("multi_step", [x, u, theta], parts)
        self.operations: int = int(self._step.n_instructions())
        self.count: int = int((windows.valid.sum() + len(windows)) * nx)

    def simulated(self, z: Array, starts: Array, *, slopes: bool) -> _Pass:
        """All windows from their starts ``(W, nx)``; a window ends where its prediction is absurd."""
        y, u, valid, _, scale = self.windows
        nx, p, n = len(scale), len(z), len(starts)
        theta, in_z = self.coordinates.theta(z), self.coordinates.slopes(z)
        x = starts
        good: Any = np.ones(n, dtype=bool)
        in_start, in_theta = np.broadcast_to(np.eye(nx), (n, nx, nx)), np.zeros((n, nx, p))
        A, B, C = np.zeros((n, nx, nx)), np.zeros((n, nx, p)), np.zeros((p, p))
        g_start, g_theta, errors = np.zeros((n, nx)), np.zeros((n, p)), []
        for t in range(len(u) + 1):
            heard: Any = good & valid[t - 1] if t else good.copy()
            error: Array = np.where(heard[:, None], x - y[t], 0.0)
            absurd = np.asarray(~(np.abs(error) < _ABSURD).all(axis=1))
            good &= ~absurd
            errors.append(np.where(absurd[:, None], _ABSURD, error))
            if slopes:
                heard &= good
                s, q, e = in_start * heard[:, None, None], in_theta * heard[:, None, None], error * heard[:, None]
                A += s.swapaxes(1, 2) @ s
                B += s.swapaxes(1, 2) @ q
                flat = q.reshape(-1, p)
                C += flat.T @ flat
                g_start += np.einsum("wij,wi->wj", s, e)
                g_theta += np.einsum("wij,wi->wj", q, e)
            if t < len(u):
                x = np.where(good[:, None], x, y[t])
                ahead, F, df = (part.full().T for part in self._step((x * scale).T, u[t].T, theta))
                x = ahead / scale
                if slopes:
                    with np.errstate(over="ignore", invalid="ignore"):  # what is wild counts no more
                        F = F.reshape(n, nx, nx) * scale / scale[:, None]
                        in_theta = F @ in_theta + df.reshape(n, nx, p) * in_z / scale[:, None]
                        in_start = F @ in_start
                    wild = ~(np.isfinite(in_theta).all(axis=(1, 2)) & np.isfinite(in_start).all(axis=(1, 2)))
                    in_theta[wild], in_start[wild] = 0.0, 0.0
        error = np.stack(errors)
        return _Pass(float(np.sum(error**2)), error, A, B, C, g_start, g_theta)

    def fitted(self, z: Array, iterations: int, settled: float = _SETTLED) -> tuple[Array, Array, _Pass]:
        """The minimum near z, with the starts there and the problem about it.

        Args:
            z: Where it begins.
            iterations: Most of them.
            settled: Relative decrease of the error at which it ends.
        """
        starts = self.windows.y[0]
        damping, least, most = _DAMPING
        now = self.simulated(z, starts, slopes=True)
        for _ in range(iterations):
            before = now
            prior = self._variance(now) / self._spread**2
            for _ in range(_ATTEMPTS):
                dz, dx = self._moves(now, z, prior, damping)
                trial = np.clip(z + dz, self.coordinates.low, self.coordinates.high)
                there = self.simulated(trial, starts + dx, slopes=True)
                if there.cost + prior * trial @ trial < now.cost + prior * z @ z:
                    z, starts, now, damping = trial, starts + dx, there, max(damping / 10.0, least)
                    break
                damping = min(10.0 * damping, most)
            if now is before or before.cost - now.cost < settled * before.cost:
                break
        return z, starts, now

    def misfit(self, z: Array, starts: Array, found: _Pass, episodes: NDArray[np.integer]) -> Misfit:
        """What the data say about z, with the starts eliminated.

        Args:
            z: The minimum.
            starts: Those of the windows.
            found: The problem there.
            episodes: The episode of each window.
        """
        variance = self._variance(found)
        inward = np.linalg.solve(found.A + 1e-12 * np.eye(found.A.shape[1]), found.B)
        information = (found.C - np.einsum("wip,wiq->pq", found.B, inward)) / variance
        scores = (found.g_theta - np.einsum("wi,wip->wp", found.g_start, inward)) / variance

        def value(other: Array) -> float:
            moved = starts - np.einsum("wip,p->wi", inward, other - z)
            return self.simulated(other, moved, slopes=False).cost / variance

        return Misfit(value, information, clusters(scores, episodes))

    def _variance(self, found: _Pass) -> float:
        """That of an error."""
        unknown = found.g_start.size + len(found.C)
        return max(found.cost / max(self.count - unknown, 1), _WEAKEST_PRIOR)

    def _moves(self, now: _Pass, z: Array, prior: float, damping: float) -> tuple[Array, Array]:
        """The steps of z and of the starts: the damped normal equations, the starts eliminated."""
        _, _, A, B, C, g_start, g_theta = now
        gradient = g_theta.sum(axis=0) + prior * z
        low, high = self.coordinates.low, self.coordinates.high
        free = ~((z <= low) & (gradient > 0.0) | (z >= high) & (gradient < 0.0))
        n = np.arange(A.shape[1])
        A = A.copy()
        A[:, n, n] *= 1.0 + damping
        A[:, n, n] += 1e-12
        inward = np.linalg.solve(A, np.concatenate([B, g_start[:, :, None]], axis=2))
        to_z, to_start = inward[:, :, :-1], inward[:, :, -1]
        C = C + damping * np.diag(np.diag(C)) + prior * np.eye(len(C)) - np.einsum("wip,wiq->pq", B, to_z)
        right = gradient - np.einsum("wip,wi->p", B, to_start)
        dz = np.zeros_like(z)
        dz[free] = -np.linalg.lstsq(C[np.ix_(free, free)], right[free], rcond=None)[0]
        dz /= max(1.0, float(np.abs(dz).max(initial=0.0)))
        return dz, -to_start - np.einsum("wip,p->wi", to_z, dz)
