"""A simulated plant as a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC
from mpcoffline.mpc.labels import Label

from .clock import Clock
from .device import Measurement


class SimulatedDevice:
    """An environment that goes on by itself, a step a period of the clock, under the input that was written last.

    With ``watchdog`` it brings itself to rest when nobody has written for so many steps, as a real device should.

    Args:
        env: A Gymnasium environment of the MPC's observations and inputs, as ``plant.env()``.
        mpc: For the names of observations and inputs.
        clock: Its time.
        period: Seconds of a step; the MPC's sampling time by default.
        inputs: Those in effect at first, by name; the usual ones by default.
        watchdog: Steps after which, without a new input, the first ones are back; None for never.
        seed: Of the environment.
        measured: Names of what the environment shows; by default those of the MPC's observations.

    Raises:
        InvalidArgumentError: For an environment of other sizes than the MPC's.
    """

    cost: float

    def __init__(
        self,
        env: gym.Env[Any, Any],
        mpc: MPC,
        clock: Clock,
        *,
        period: float | None = None,
        inputs: Mapping[str, float] | None = None,
        watchdog: int | None = None,
        seed: int = 0,
        measured: Sequence[Label] | None = None,
    ) -> None:
        labels = mpc.layout.y_labels if measured is None else measured
        self._names: Sequence[str] = [label.name for label in labels]
        self._inputs: Sequence[str] = [label.name for label in mpc.layout.u_labels]
        sizes = env.observation_space.shape, env.action_space.shape
        if sizes != ((len(labels),), (mpc.nu,)):
            expected = f"{len(labels)} observations and {mpc.nu} inputs, as the policy has"
            raise InvalidArgumentError("environment", expected=expected, actual=f"shapes {sizes[0]} and {sizes[1]}")
        self._env, self._clock, self._watchdog = env, clock, watchdog
        self._period = float(mpc.model.dt if period is None else period)
        usual = dict(zip(self._inputs, np.asarray(mpc.usual_input).tolist(), strict=True)) | dict(inputs or {})
        self._rest = np.array([usual[name] for name in self._inputs])
        self._u, self._begin, self._steps, self._written = self._rest.copy(), clock.now(), 0, 0
        self._y, _ = env.reset(seed=seed)
        self.cost = 0.0

    def read(self) -> Measurement:
        """What the environment shows now."""
        self._catch_up()
        values = dict(zip(self._names, np.asarray(self._y, dtype=np.float64).tolist(), strict=True))
        return Measurement(values, dict(zip(self._inputs, self._u.tolist(), strict=True)))

    def write(self, inputs: Mapping[str, float]) -> None:
        """Applies inputs from now on; those that are left out stay."""
        self._catch_up()
        for i, name in enumerate(self._inputs):
            self._u[i] = inputs.get(name, self._u[i])
        self._written = self._steps

    def _catch_up(self) -> None:
        """The steps that have passed since."""
        due = int((self._clock.now() - self._begin) / self._period + 1e-6)
        while self._steps < due:
            self._steps += 1
            if self._watchdog is not None and self._steps - self._written > self._watchdog:
                self._u = self._rest.copy()
            self._y, reward, terminated, truncated, _ = self._env.step(self._u.astype(np.float32))
            self.cost -= float(reward)
            if terminated or truncated:
                self._y, _ = self._env.reset()
