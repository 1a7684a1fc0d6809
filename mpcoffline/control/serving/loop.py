"""The loop: measure, decide, write, once a period, whatever fails."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mpcoffline.control.loading import Acting
from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError, UnknownIdError
from mpcoffline.core.types import Array
from mpcoffline.mpc.signals import turned

from .carried import Carried
from .clock import Clock, SystemClock
from .decisions import DecisionLog
from .device import Device, Measurement

_TIMELY = 0.8  # of a period, after which a decision would come too late


@dataclass
class ServiceStats:
    """What a loop has met.

    Attributes:
        periods: Periods that were served.
        decided: Of these, where the policy decided, blended or not.
        lost: Where no measurement came in time, or an incomplete one.
        failed: Where the solver had no plan at all, or the policy an error.
        approximate: Where a solve was not accepted, and a plan that was at hand acted (``policy.solver_stats``).
        missed: Where the policy took too long: what it decided was not applied.
        unwritten: Where the device did not take the inputs.
        skipped: Periods that passed while one before was not over yet.
        held: Where the input before was kept.
        fallbacks: Where the fall-back input acted.
        longest: The longest time from the begin of a period to the end of writing, in s.
    """

    periods: int = 0
    decided: int = 0
    lost: int = 0
    failed: int = 0
    approximate: int = 0
    missed: int = 0
    unwritten: int = 0
    skipped: int = 0
    held: int = 0
    fallbacks: int = 0
    longest: float = 0.0

    def __str__(self) -> str:
        """In words, what never happened left out."""
        words = {
            "lost": "without a measurement", "failed": "without a plan", "approximate": "by a plan at hand",
            "missed": "decided too late", "unwritten": "not taken by the device", "skipped": "skipped",
            "held": "input held", "fallbacks": "fall-back",
        }  # fmt: skip
        told = [f"{getattr(self, name)} {text}" for name, text in words.items() if getattr(self, name)]
        return ", ".join([f"{self.periods} periods, {self.decided} decided by the policy", *told])


class _Decision(NamedTuple):
    inputs: Array  # to be applied
    wanted: Array | None
    by: str
    note: str


class Service:
    """A policy in charge of a plant.

    Each period begins at a multiple of ``period`` from the first one, so that nothing drifts::

        read -> policy -> blend -> write -> log

    * *Lost*: no measurement in time, an error of the device, or one that lacks a value or has NaN. *Failed*: no plan.
      *Missed*: the policy took longer than ``deadline``. In each case the input before is held, for ``hold`` periods;
      then the watch-dog brings in the fall-back input, until the policy decides again. Nothing of that ends the loop.
    * *Bumpless*: over the first ``transfer`` decisions, and again after a fall-back, the policy's input is blended into
      the one in effect: ``u = u_before + k / transfer (u_policy - u_before)``. What the device says is in effect at the
      first measurement counts as past input, so that limits on changes hold from the first step on.
    * Past inputs that the MPC's state holds are those that were applied, not those that were wanted. Whether inputs act
      that the device has not confirmed nobody knows: the log leaves them empty, and what the device says is in effect
      at the next measurement counts.
    * The observer of a policy that sees outputs knows what was applied, goes on where a measurement is lost, and does
      without a single output as long as there is another one.

    Example:
        >>> service = Service(policy, LineDevice("127.0.0.1", 5020), fallback={"power": 0.0}, log=log)
        >>> stats = service.run(1_000)

    Args:
        policy: What decides.
        device: The plant.
        period: Seconds between decisions; the MPC's sampling time by default.
        fallback: The input that is safe, by name; inputs that are left out, all by default, are held.
        hold: Periods without a decision that are bridged by holding.
        transfer: Decisions over which the policy takes over; 1 for at once.
        deadline: Seconds from the begin of a period within which it must be decided; four fifths of it by default.
        clock: The time; the computer's by default.
        log: Where every decision is written.
        tell: Is told, in a sentence, when something begins to go wrong, and when it is over.

    Raises:
        InvalidArgumentError: For numbers out of range, or a fall-back beyond the bounds.
        UnknownIdError: For a fall-back of an unknown input.
    """

    def __init__(
        self,
        policy: Acting,
        device: Device,
        *,
        period: float | None = None,
        fallback: Mapping[str, float] | None = None,
        hold: int = 5,
        transfer: int = 10,
        deadline: float | None = None,
        clock: Clock | None = None,
        log: DecisionLog | None = None,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        mpc, layout = policy.mpc, policy.mpc.layout
        labels = policy.y_labels
        self.period: float = float(mpc.model.dt if period is None else period)
        check_number("period", self.period, 0.0)
        check_integers(0, hold=hold)
        check_integers(1, transfer=transfer)
        self.deadline: float = _TIMELY * self.period if deadline is None else float(deadline)
        check_number("deadline", self.deadline, 0.0, self.period)
        self._low, self._high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
        self._names, self._signals = [label.name for label in layout.u_labels], layout.signals
        self._columns = [label.name for label in labels]
        self._may_lack = policy.observer.n_outputs if isinstance(policy, OutputFeedbackPolicy) else 0
        self._fallback = self._given(fallback or {})
        self._policy, self._device, self._carried = policy, device, Carried(policy)
        self._hold, self._transfer, self._log = hold, transfer, log
        self._clock: Clock = SystemClock() if clock is None else clock
        self._tell = tell or (lambda _: None)
        self.stats: ServiceStats = ServiceStats()
        self._applied = np.array(mpc.usual_input, dtype=np.float64)
        self._taken_over = self._wrong = self._unsure = False
        self._without = self._blended = 0

    def _given(self, fallback: Mapping[str, float]) -> Array:
        """The fall-back inputs, NaN where one is held."""
        found = np.full(len(self._names), np.nan)
        for name, value in fallback.items():
            if name not in self._names:
                raise UnknownIdError.of("fall-back input", name, self._names)
            i = self._names.index(name)
            check_number(f"fall-back {name}", value, float(self._low[i]), float(self._high[i]), open_low=False)
            found[i] = value
        return found

    def run(self, periods: int | None = None) -> ServiceStats:
        """Serves a number of periods; without one, until it is interrupted.

        At the end the inputs stay as they are. Where it is interrupted, or ends by an error, the fall-back is written.

        Raises:
            StorageError: If the log cannot be written any more.
            KeyboardInterrupt: By Ctrl-C.
        """
        _ = self._policy.solver  # which may have to be compiled
        begin, k, end = self._clock.now(), 0, math.inf if periods is None else periods
        try:
            while k < end:
                self._clock.sleep_until(begin + k * self.period)
                self._serve(begin + k * self.period)
                over = math.floor((self._clock.now() - begin) / self.period + 1e-9)
                passed = int(min(max(0, over - k - 1), end - k - 1))
                self.stats.skipped += passed
                for _ in range(passed):
                    self._carried.passed(self._applied)
                k += 1 + passed
        except BaseException:  # whatever it is: nobody is in charge from here on
            last = np.where(np.isnan(self._fallback), self._applied, self._fallback)
            if (refused := self._write(last, math.inf)) is not None:
                self._tell(f"At the end: {refused}")
            raise
        return self.stats

    def _serve(self, begin: float) -> None:
        """One period."""
        epoch = self._clock.epoch() - (self._clock.now() - begin)
        values, decision, solving = self._decided(begin, epoch)
        note = decision.note
        if (refused := self._write(decision.inputs, begin + self.period)) is not None:
            self.stats.unwritten += 1
            self._unsure |= not np.array_equal(decision.inputs, self._applied)
            note = "; ".join(filter(None, [note, refused]))
        else:
            self._applied, self._unsure = decision.inputs, False
        self._carried.passed(self._applied)
        late = self._clock.now() - begin
        self.stats.periods += 1
        self.stats.longest = max(self.stats.longest, late)
        if bool(note) != self._wrong:
            self._wrong = bool(note)
            self._tell(note if note else "Well again.")
        if self._log is not None:
            acting = np.full(len(self._names), np.nan) if self._unsure else self._applied
            self._log.row(epoch, values, acting, decision.wanted, decision.by, late, solving, note)

    def _decided(self, begin: float, epoch: float) -> tuple[Mapping[str, float], _Decision, float]:
        """What was measured, what is to be applied, and how long the policy took."""
        until = begin + self.deadline
        try:
            measured = self._clock.call("read", self._device.read, until)
            values = self._complete(measured, epoch)
        except Exception as error:  # whatever goes wrong in a device
            self.stats.lost += 1
            return {}, self._instead(f"no measurement: {_short(error)}"), 0.0
        if not self._taken_over:
            self._take_over(measured)
        elif self._unsure:
            self._corrected(measured)
        solves = self._policy.solver_stats
        at_hand, without, started = solves.n_best_plan + solves.n_previous_plan, solves.n_zero, self._clock.now()
        y = np.array([values[name] for name in self._columns])
        state = self._carried.state(y)
        try:
            wanted, following = self._clock.call("policy", lambda: self._policy.predict(y, state=state), until)
        except TimeoutError:
            self.stats.missed += 1
            return values, self._instead("decided too late"), self._clock.now() - started
        except MPCOfflineError as error:
            self.stats.failed += 1
            return values, self._instead(f"no decision: {_short(error)}"), self._clock.now() - started
        solving = self._clock.now() - started
        if solves.n_zero > without or not np.isfinite(wanted).all():
            self.stats.failed += 1
            return values, self._instead("no plan was found"), solving
        self._carried.decided(following)
        approximate = solves.n_best_plan + solves.n_previous_plan > at_hand
        self.stats.approximate += approximate
        return values, self._blend(np.asarray(wanted, dtype=np.float64), approximate), solving

    def _blend(self, wanted: Array, approximate: bool) -> _Decision:
        """The policy's input, or on the way to it."""
        self.stats.decided += 1
        self._without = 0
        self._blended = min(self._blended + 1, self._transfer)
        note = "a plan at hand, the solve was not accepted" if approximate else ""
        if self._blended == self._transfer:
            return _Decision(wanted, wanted, "policy", note)
        share = self._blended / self._transfer
        return _Decision(self._applied + share * (wanted - self._applied), wanted, "transfer", note)

    def _instead(self, why: str) -> _Decision:
        """What is applied without a decision: the input before, after a while the fall-back."""
        self._without += 1
        if self._without <= self._hold or np.isnan(self._fallback).all():
            self.stats.held += 1
            return _Decision(self._applied, None, "hold", why)
        self.stats.fallbacks += 1
        self._blended = 0
        return _Decision(np.where(np.isnan(self._fallback), self._applied, self._fallback), None, "fallback", why)

    def _take_over(self, measured: Measurement) -> None:
        """The inputs in effect when the first measurement comes, as far as the device knows them."""
        self._taken_over = True
        self._applied = self._in_effect(measured)
        self._carried.take_over(self._applied)

    def _corrected(self, measured: Measurement) -> None:
        """The same after inputs that the device has not confirmed: perhaps it did take them."""
        self._applied = self._in_effect(measured)
        self._carried.correct(self._applied)

    def _in_effect(self, measured: Measurement) -> Array:
        """The inputs that the device says are in effect, within their bounds; those that it does not say as before."""
        said = np.array([float(measured.inputs.get(name, math.nan)) for name in self._names])
        return np.where(np.isfinite(said), np.clip(said, self._low, self._high), self._applied)

    def _complete(self, measured: Measurement, epoch: float) -> dict[str, float]:
        """The columns of the observation by name.

        Raises:
            InvalidArgumentError: For one that is missing or no finite number.
        """
        found = {name: float(value) for name, value in measured.values.items()}
        for signal in self._signals:
            first, *later = signal.columns
            if signal.period is not None:
                turn = 2.0 * math.pi * ((epoch / self.period / signal.period) % 1.0)
                cosine, sine = turned(1.0, 0.0, turn)
                found.setdefault(first, float(cosine))
                found.setdefault(later[0], float(sine))
                continue
            for column in later:
                found.setdefault(column, found.get(first, math.nan))
                first = column
        lost = [name for name in self._columns if not math.isfinite(found.get(name, math.nan))]
        outputs = self._columns[: self._may_lack]
        if not set(outputs) <= set(lost):  # others tell of the states, too
            lost = [name for name in lost if name not in outputs]
        for name in lost:
            actual = "none" if name not in found else str(found[name])
            raise InvalidArgumentError(name, expected="a number", actual=actual)
        told = {name: found.get(name, math.nan) for name in self._columns}
        return {name: value if math.isfinite(value) else math.nan for name, value in told.items()}

    def _write(self, inputs: Array, until: float) -> str | None:
        """Hands inputs to the device; says why, where it does not take them."""
        named = {name: float(value) for name, value in zip(self._names, inputs, strict=True)}
        if not math.isfinite(until):
            until = self._clock.now() + self.period
        try:
            self._clock.call("write", lambda: self._device.write(named), until)
        except Exception as error:  # whatever goes wrong in a device
            return f"not written: {_short(error)}"
        return None


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
