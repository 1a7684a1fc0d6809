"""What a policy in charge carries from period to period, by the inputs that were applied, whoever decided them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.course import Course
from mpcoffline.control.loading import Acting
from mpcoffline.control.output_feedback import OWN, OutputFeedbackPolicy
from mpcoffline.core.types import Array
from mpcoffline.estimation.observer import Estimate
from mpcoffline.solvers import Plan


class Carried:
    """Plan, past inputs and, where outputs are measured, what their observer knows, of one loop.

    Args:
        policy: What decides.
    """

    def __init__(self, policy: Acting) -> None:
        mpc = policy.mpc
        self._layout = mpc.layout
        self._plan, self._memory = Plan.none(1, mpc), self._layout.filled(mpc.usual_input)
        self._signals = self._layout.usual_signals
        self._observer = policy.observer if isinstance(policy, OutputFeedbackPolicy) else None
        self._acting = np.full((1, len(self._layout.acting)), np.nan)  # nothing has acted, yet
        self._known = None if self._observer is None else self._observer.begin(1)
        self._corrected = False  # by outputs of this period

    def state(self, y: Array) -> Any:
        """What ``predict`` is given beside what was measured, ``(n,)``."""
        self._signals = y[len(y) - len(self._signals) :]
        inner: tuple[NDArray[Any], ...] = self._plan
        if self._layout.n_memory:
            inner = Course(self._plan.x, self._plan.u, self._memory[None], self._plan.multipliers)
        return inner if self._known is None else (*self._known, self._acting, *inner)

    def decided(self, following: tuple[NDArray[Any], ...]) -> None:
        """Takes over what ``predict`` returned beside the inputs."""
        if self._known is not None:
            self._known, self._corrected, following = Estimate(*following[:2]), True, following[OWN:]
        least = 3 if self._layout.n_memory else 2
        self._plan = Plan(*following[:2], *following[least:])

    def passed(self, applied: Array) -> None:
        """A period in which these inputs act ``(nu,)`` is over."""
        if self._observer is not None and self._known is not None:
            if not self._corrected and np.isfinite(self._acting).all():
                self._known = self._observer.ahead(self._known, self._acting)
            z = np.concatenate([self._observer.states(self._known)[0], self._signals, self._memory])
            self._acting, self._corrected = self._layout.split(z, applied)[1][None], False
        if self._layout.n_memory:
            self._memory = self._layout.remembered(self._memory, applied)

    def take_over(self, applied: Array) -> None:
        """These inputs were in effect for long."""
        self._memory = self._layout.filled(applied)

    def correct(self, applied: Array) -> None:
        """These were in effect in the period before, whatever was said of it."""
        inputs, ages = self._layout.ages
        newest = ages == 1
        self._memory[newest] = applied[inputs[newest]]
        if np.isfinite(self._acting).all():
            acts_at_once = np.flatnonzero(np.array(self._layout.delay) == 0)
            self._acting[0, acts_at_once] = applied[acts_at_once]
