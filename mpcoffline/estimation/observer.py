"""States from outputs: an extended Kalman filter for an MPC's model, over many loops at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.text import check_name, check_unit
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.component import numbers
from mpcoffline.mpc.labels import Label
from mpcoffline.mpc.numpy_twin import NumpyTwin
from mpcoffline.mpc.outputs import Outputs, feedthrough, outputs_of
from mpcoffline.mpc.rest import at_rest

_SHARE = 0.25  # of an input's range: how large a constant disturbance of it is expected to be
_MANY = 50  # points, from which on numpy, an operation at a time, is faster than CasADi, a point at a time
_AT_WORK = 50  # steps, after which covariances hardly change any more
_RANDOM_WALK = 1e3  # steps, over which a disturbance of an unbounded input would have come about


class Estimate(NamedTuple):
    """What an observer knows.

    Attributes:
        x: States of the plant and disturbances of its inputs, ``(B, n)``.
        P: The covariance of their errors, ``(B, n, n)``.
    """

    x: Array
    P: Array


def disturbed_plant(mpc: MPC, n_disturbances: int) -> tuple[tuple[ca.SX, ca.SX, ca.SX], ca.SX]:
    """``z+ = [f(x, u + d), d]`` for ``z = [x, d]``, with constant disturbances d of the first inputs.

    Returns:
        The symbols z ``(n_states + n_disturbances, 1)``, what acts ``(nu + n_signals, 1)`` and theta; and z+.
    """
    n = mpc.layout.n_states
    z, acting = ca.SX.sym("z", n + n_disturbances), ca.SX.sym("acting", len(mpc.layout.acting))
    theta = ca.SX.sym("theta", mpc.space.size)
    reached = mpc.plant_function(z[:n], _disturbed(z, acting, n), theta)
    return (z, acting, theta), ca.vertcat(reached, z[n:, 0])  # of one state and no load, z[1:] is a row


def disturbed_outputs(h: ca.Function, z: ca.SX, acted: ca.SX) -> ca.SX:
    """``h(x, u + d)`` for ``z = [x, d]`` and what acted in the step before, ``(nu + n_signals, 1)``."""
    n = h.numel_in(0)
    return h(z[:n]) if h.n_in() == 1 else h(z[:n], _disturbed(z, acted, n)[: h.numel_in(1)])


def _disturbed(z: ca.SX, acting: ca.SX, n: int) -> ca.SX:
    """What acts with the disturbances of the first inputs, which follow the n states in z."""
    m = z.numel() - n
    return acting + ca.vertcat(z[n:, 0], ca.SX.zeros(acting.numel() - m)) if m else acting


class OutputModel:
    """What an MPC's model says of outputs: the plant's map with constant disturbances of its inputs, and h.

    Args:
        mpc: Has the model.
        outputs: Which states are measured, or a function of them.
        n_disturbances: Of the first inputs, those with a disturbance.

    Attributes:
        function: h, x ``(n_states, 1)`` -> y, or x, u ``(nu, 1)`` -> y where outputs depend on inputs.
        n_outputs: Number of outputs.
        feedthrough: Which of them depend on inputs, ``(n_outputs,)``.

    Raises:
        InvalidArgumentError: For outputs that are none of the states, or no expression.
    """

    def __init__(self, mpc: MPC, outputs: Outputs, n_disturbances: int = 0) -> None:
        self.function: ca.Function = outputs_of(outputs, mpc.layout.n_states, mpc.nu)
        self.n_outputs: int = self.function.numel_out(0)
        self.feedthrough: NDArray[np.bool_] = feedthrough(self.function)
        self._is_fed, self._n_acting = bool(self.feedthrough.any()), len(mpc.layout.acting)
        (z, acting, theta), ahead = disturbed_plant(mpc, n_disturbances)
        self._ahead = _WithSlopes("ahead", [z, acting, theta], ahead)
        arguments = [z, acting] if self._is_fed else [z]
        self._seen = _WithSlopes("seen", arguments, disturbed_outputs(self.function, z, acting))
        self._identity = np.eye(z.numel())

    def ahead(self, known: Estimate, acting: Array, theta: Array, Q: Array) -> tuple[Estimate, Array]:
        """What is known a step later, before an output, and F ``(B, n, n)``.

        A prediction that is no number leaves the states where they are, as uncertain as they would be then.

        Args:
            known: At the step.
            acting: The inputs that act in it, and the present signals, ``(B, nu + n_signals)``.
            theta: Parameters, ``(size,)``, or ``(B, size)``.
            Q: Covariance of what the model misses, ``(n, n)`` or ``(B, n, n)``.
        """
        x, F = self._ahead(known.x, acting, theta)
        failed = ~(np.isfinite(x).all(axis=1) & np.isfinite(F).all(axis=(1, 2)))
        if failed.any():
            x[failed], F[failed] = known.x[failed], self._identity
        return Estimate(x, F @ known.P @ F.swapaxes(1, 2) + Q), F

    def seen(self, x: Array, acted: Array) -> Array:
        """Outputs ``(B, n_outputs)`` without noise at states ``(B, n)``, after what :meth:`ahead` is given acted."""
        return self._seen(x, acted)[0] if self._is_fed else self._seen(x)[0]

    def _heard(self, x: Array, y: Array, acted: Array | None) -> tuple[Array, Array, Array]:
        """Outputs of states, their slopes H, and y without what depends on inputs that nobody knows."""
        if not self._is_fed:
            return *self._seen(x), y
        given = np.full((len(x), self._n_acting), np.nan) if acted is None else acted
        known = np.asarray(np.isfinite(given).all(axis=1))[:, None]
        y = np.where(known | ~self.feedthrough, y, np.nan)
        seen, H = self._seen(x, np.where(known, given, 0.0))
        return seen, np.where(np.isfinite(y)[:, :, None], H, 0.0), y

    def corrected(self, known: Estimate, y: Array, R: Array, acted: Array | None = None) -> Estimate:
        """What is known with outputs y ``(B, n_outputs)``; those that are NaN are not there.

        Args:
            known: Before them.
            y: The outputs.
            R: Covariance of their noise, ``(n_outputs, n_outputs)`` or ``(B, n_outputs, n_outputs)``.
            acted: What acted in the step before, as :meth:`ahead` takes it. In rows of NaN, and without it, that is not
                known: outputs that depend on it are not there.
        """
        seen, H, y = self._heard(known.x, y, acted)
        missing = ~np.isfinite(y)
        innovation = y - seen
        if missing.any():
            innovation, H = np.where(missing, 0.0, innovation), np.where(missing[:, :, None], 0.0, H)
        HP = H @ known.P
        S = HP @ H.swapaxes(1, 2) + R
        gain = np.linalg.solve(S, HP).swapaxes(1, 2)
        left = self._identity - gain @ H
        P = left @ known.P @ left.swapaxes(1, 2) + gain @ R @ gain.swapaxes(1, 2)
        return Estimate(known.x + (gain @ innovation[:, :, None])[:, :, 0], P)

    def corrected_in_turn(
        self, known: Estimate, y: Array, variances: Array, acted: Array | None = None
    ) -> tuple[Estimate, Array, Array]:
        """What is known with outputs, their innovations e and the variances S of these, ``(B, n_outputs)`` both.

        One output after the other, which is the same as all at once where their errors are independent, and faster.
        Minus twice their log likelihood is the sum of ``e^2 / S + log S`` but for a constant: of an output that is not
        there e is 0 and S is 1.

        Args:
            known: Before them.
            y: The outputs, ``(B, n_outputs)``; those that are NaN are not there.
            variances: Of their errors, ``(B, n_outputs)``.
            acted: As :meth:`corrected` takes it.
        """
        seen, H, y = self._heard(known.x, y, acted)
        before = x = known.x.T  # loops go last: numpy is twice as fast along them as along a few states
        P, e, S = np.ascontiguousarray(known.P.transpose(1, 2, 0)), np.zeros(y.T.shape), np.ones(y.T.shape)
        for j in range(y.shape[1]):
            h, heard = H[:, j].T, np.isfinite(y[:, j])
            Ph = (P * h).sum(axis=1)
            S[j] = np.where(heard, (h * Ph).sum(axis=0) + variances[:, j], 1.0)
            e[j] = np.where(heard, y[:, j] - seen[:, j] - (h * (x - before)).sum(axis=0), 0.0)
            gain = np.where(heard, 1.0 / S[j], 0.0) * Ph
            x = x + gain * e[j]
            P = P - gain[:, None] * Ph
        return Estimate(x.T, P.transpose(2, 0, 1)), e.T, S.T


class KalmanObserver:
    """An extended Kalman filter: estimates the plant's states from what sensors show of them.

    ::

        x-_{k+1} = f(x_k, u_k + d_k),   d-_{k+1} = d_k,        P- = F P F' + Q
        K = P- H' (H P- H' + R)^-1,     x = x- + K (y - h(x-)),   P = (1 - K H) P- (1 - K H)' + K R K'

    with d a constant disturbance of the inputs, where one is asked for: then there is no steady offset of the states
    that are measured, though the model's gain be wrong or a load unknown (offset-free MPC: Muske and Badgwell,
    doi:10.1016/S0959-1524(01)00051-8). Disturbances are told apart only where there are at least as many outputs.

    Outputs may depend on inputs, too (an accelerometer, a current): on those that acted in the step that ends when they
    are measured, ``h(x_k, u_{k-1} + d_k)``, since the next ones are chosen after that. Where nothing is known to have
    acted, as when an episode begins, such an output is not there.

    Args:
        mpc: Has the model.
        outputs: Which states are measured, or a function of them.
        noise: Standard deviation of the error of each output, ``(n_outputs,)`` or one for all.
        process: Standard deviation of what the model misses of each state in a step, ``(n_states,)``; positive where
            the model is not exact.
        start: States where an episode begins, as far as is known before the first output, ``(n_states,)``. The
            reference, or zero, by default.
        start_spread: Standard deviation of their error, ``(n_states,)``.
        disturbance: How much a disturbance of each input changes in a step, ``(nu,)``, standard deviation: larger is
            faster, and noisier. None for none.
        labels: What the outputs are called, with units; those of states that are measured, by default, else
            ``output 0`` and so on.

    Attributes:
        n_outputs: Number of outputs.
        feedthrough: Which of them depend on inputs, ``(n_outputs,)``.

    Raises:
        InvalidArgumentError: For numbers that are negative, of another size or not finite, outputs that are none of the
            states, noise of zero, more disturbances than outputs, or labels of another number.
    """

    mpc: MPC
    n_disturbances: int
    function: ca.Function
    n_outputs: int
    feedthrough: NDArray[np.bool_]

    def __init__(
        self,
        mpc: MPC,
        outputs: Outputs,
        noise: ArrayLike,
        process: ArrayLike,
        *,
        start: ArrayLike | None = None,
        start_spread: ArrayLike,
        disturbance: ArrayLike | None = None,
        labels: Sequence[Label] = (),
    ) -> None:
        n = mpc.layout.n_states
        self.mpc, self.n_disturbances = mpc, 0 if disturbance is None else mpc.nu
        self._model = OutputModel(mpc, outputs, self.n_disturbances)
        self.function, self.n_outputs, self._theta = self._model.function, self._model.n_outputs, mpc.theta
        self.feedthrough = self._model.feedthrough
        self.noise: Array = _spreads("noise", noise, self.n_outputs, positive=True)
        self.process: Array = _spreads("process", process, n)
        self.start: Array = at_rest(mpc)[:n] if start is None else _vector("start", start, n)
        self.start_spread: Array = _spreads("start_spread", start_spread, n)
        self.disturbance: Array | None = None if disturbance is None else _spreads("disturbance", disturbance, mpc.nu)
        if self.n_disturbances > self.n_outputs:
            raise InvalidArgumentError(
                "disturbance",
                expected=f"at most as many inputs as outputs, {self.n_outputs}",
                actual=f"{self.n_disturbances} inputs",
                hint="More cannot be told apart. disturbance=None leaves them out.",
            )
        self.labels: tuple[Label, ...] = self._labels(outputs, labels)
        missed = self.process if self.disturbance is None else np.append(self.process, self.disturbance)
        self._Q, self._R = np.diag(missed**2), np.diag(self.noise**2)

    def _labels(self, outputs: Outputs, given: Sequence[Label]) -> tuple[Label, ...]:
        """What outputs are called."""
        known = self.mpc.layout.labels.states
        if not given and known and not callable(outputs):
            return tuple(known[int(i)] for i in outputs)
        labels = [Label(*each) for each in given] or [Label(f"output {i}") for i in range(self.n_outputs)]
        if len(labels) != self.n_outputs:
            expected = f"{self.n_outputs} of them, or none"
            raise InvalidArgumentError("labels of outputs", expected=expected, actual=str(labels))
        for label in labels:
            check_name("name of an output", label.name)
            check_unit(f"unit of {label.name}", label.unit)
        return tuple(labels)

    def begin(self, n_loops: int) -> Estimate:
        """What is known before the first output of B loops."""
        spread = self.start_spread
        if self.disturbance is not None:
            width = np.asarray(self.mpc.action_high) - np.asarray(self.mpc.action_low)
            unbounded = self.disturbance * np.sqrt(_RANDOM_WALK)
            spread = np.append(spread, np.where(np.isfinite(width), _SHARE * width, unbounded))
        x = np.append(self.start, np.zeros(self.n_disturbances))
        return Estimate(np.tile(x, (n_loops, 1)), np.tile(np.diag(spread**2), (n_loops, 1, 1)))

    def at_work(self, x: Array, acting: Array) -> Estimate:
        """What is known at states x ``(B, n_states)`` before an output, after many steps: linearised there.

        Args:
            x: The states.
            acting: What acts there, as :meth:`ahead` takes it.
        """
        known = self.begin(len(x))
        known.x[:, : x.shape[1]] = x
        seen = self._model.seen(known.x, acting)
        for _ in range(_AT_WORK):
            P = self.corrected(known, seen, acting).P
            known = Estimate(known.x, self.ahead(Estimate(known.x, P), acting).P)
        return known

    def ahead(self, known: Estimate, acting: Array) -> Estimate:
        """What is known a step later, before an output.

        Args:
            known: At the step.
            acting: The inputs that act in it, dead time past, and the present signals, as ``mpc.layout.split`` gives
                them, ``(B, nu + n_signals)``.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # of a model that runs away
            return _finite(self._model.ahead(known, acting, self._theta, self._Q)[0], known)

    def corrected(self, known: Estimate, y: Array, acted: Array | None = None) -> Estimate:
        """What is known with outputs y ``(B, n_outputs)``; those that are NaN are not there.

        Args:
            known: Before them.
            y: The outputs.
            acted: What acted in the step before, as :meth:`ahead` takes it; in rows of NaN, and without it, outputs
                that depend on inputs are not there.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return _finite(self._model.corrected(known, y, self._R, acted), known)

    def states(self, known: Estimate) -> Array:
        """The plant's states, ``(B, n_states)``."""
        return known.x[:, : self.mpc.layout.n_states]

    def disturbances(self, known: Estimate) -> Array:
        """The disturbances of its inputs, ``(B, nu)``; zero where none are estimated."""
        found = known.x[:, self.mpc.layout.n_states :]
        return found if self.n_disturbances else np.zeros((len(found), self.mpc.nu))


def _finite(found: Estimate, before: Estimate) -> Estimate:
    """What was found; what was known before, where a model ran away so far that numbers end."""
    lost = ~(np.isfinite(found.x).all(axis=1) & np.isfinite(found.P).all(axis=(1, 2)))
    if lost.any():
        found.x[lost], found.P[lost] = before.x[lost], before.P[lost]
    return found


class _WithSlopes:
    """A function of columns and its Jacobian by the first of them, at many points.

    Args:
        name: What it is.
        symbols: Its arguments.
        value: Its value, ``(m, 1)``.
    """

    def __init__(self, name: str, symbols: list[ca.SX], value: ca.SX) -> None:
        slopes = ca.densify(ca.jacobian(value, symbols[0]))
        self._function = ca.Function(name, symbols, [ca.densify(value), slopes])
        self._joined = ca.Function(name, symbols, [ca.densify(ca.vertcat(value, ca.vec(slopes)))])
        self._twin: NumpyTwin | None = None
        self._has_twin = True

    def __call__(self, *arguments: Array) -> tuple[Array, Array]:
        """At rows of arguments ``(B, ...)``: ``(B, m)`` and ``(B, m, n)``."""
        B, m = len(arguments[0]), self._function.numel_out(0)
        if B >= _MANY and self._has_twin and self._twin is None:
            try:
                self._twin = NumpyTwin(self._joined)
            except InvalidArgumentError:  # an operation that numpy has not
                self._has_twin = False
        if B >= _MANY and self._twin is not None:
            columns = (
                each.T if each.ndim > 1 else np.broadcast_to(each[:, None], (len(each), B)) for each in arguments
            )
            joined = self._twin(*columns)
            return joined[:m].T, joined[m:].reshape(-1, m, B).T
        if B == 1:
            joined = self._at_one(arguments)
            return joined[None, :m], joined[m:].reshape(1, -1, m).swapaxes(1, 2)
        value, slopes = self._function(*(each.T if each.ndim > 1 else each for each in arguments))
        return np.array(value.full().T), np.array(slopes.full().reshape(m, B, -1).swapaxes(0, 1))

    def _at_one(self, arguments: tuple[Array, ...]) -> Array:
        """Value and slopes, column by column, at one point: CasADi in numpy memory, four times as fast."""
        found: Any = np.empty(self._joined.numel_out(0))  # that arrays are buffers is in numpy's types from 3.12 on
        buffer: Any  # whose types know addresses alone
        buffer, evaluate = self._joined.buffer()
        columns: list[Any] = [np.ascontiguousarray(each, dtype=np.float64) for each in arguments]
        for i, column in enumerate(columns):
            buffer.set_arg(i, memoryview(column))
        buffer.set_res(0, memoryview(found))
        evaluate()
        return np.asarray(found)


def _vector(name: str, given: ArrayLike, size: int) -> Array:
    values = np.asarray(numbers(name, given), dtype=np.float64)
    if values.shape not in ((), (size,)):
        raise InvalidArgumentError(name, expected=f"a number, or {size}", actual=f"shape {values.shape}")
    return np.array(np.broadcast_to(values, (size,)))


def _spreads(name: str, given: ArrayLike, size: int, *, positive: bool = False) -> Array:
    values = _vector(name, given, size)
    if not (np.isfinite(values).all() and (values > 0.0 if positive else values >= 0.0).all()):
        raise InvalidArgumentError(
            name, expected=f"standard deviations, {'positive' if positive else 'none below zero'}", actual=str(values)
        )
    return values
