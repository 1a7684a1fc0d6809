"""A described plant as a Gymnasium environment."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.checks import check_number
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.core.types import Array
from mpcoffline.mpc import Signal
from mpcoffline.mpc.outputs import shown
from mpcoffline.mpc.signals import turned

if TYPE_CHECKING:
    from .description import Plant

_HELD = 50  # steps that a signal keeps a value, on average

#: What a signal does in an episode: a number, its values step by step (the last goes on), or a function that draws
#: them, ``(rng, n) -> (n,)``.
Course = float | ArrayLike | Callable[[np.random.Generator, int], ArrayLike]

_DESCRIBED: dict[str, Plant] = {}


class PlantEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A simulated plant: its own equations, with other parameters each episode and noise on what is measured.

    The observation is [states, signals], float32, with outputs in place of states where the plant has some; the action
    one number an input; the reward minus the plant's cost. ``info`` holds ``"cost"`` (float64), ``"state"`` (the true
    states, without noise), ``"applied"`` (the inputs after bounds and rates), and at the start ``"parameters"``.
    Episodes are cut off after the plant's ``steps``.

    * Parameters are drawn uniformly within ``spread`` of theirs and their bounds, anew each episode.
    * States begin uniformly in ``starts`` of each :class:`~mpcoffline.State`, and stay within the range of the state.
    * A signal with a range takes uniform values of it, each held for 50 steps on average; one without stays ``usual``.
      A clock begins anywhere. ``signals`` says otherwise.
    * Inputs act late where the description says so, and change no faster than it says. Before an episode they are at
      rest: their ``usual`` value, or zero.

    ``reset(options=...)`` knows ``{"state": x}`` and ``{"parameters": {name: value}}``.

    Args:
        plant: Name of a plant that was described in this process.
        noise: Times the noise of each state or output; 0 for none.
        spread: Times the spread of each parameter; 0 for the described ones.
        signals: Courses of signals by name.

    Raises:
        UnknownIdError: For a plant that was not described here.
        InvalidArgumentError: For inputs without bounds, which no action space can be without, or an unknown signal.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 -- gymnasium's

    def __init__(
        self,
        plant: str,
        *,
        noise: float = 1.0,
        spread: float = 1.0,
        signals: Mapping[str, Course] | None = None,
    ) -> None:
        if plant not in _DESCRIBED:
            hint = "Run what describes it first, as mpcoffline.plants.load_plant(file).env()."
            raise UnknownIdError.of("plant of an environment", plant, _DESCRIBED, hint)
        self.plant: Plant = _DESCRIBED[plant]
        check_number("noise", noise, 0.0, open_low=False)
        check_number("spread", spread, 0.0, open_low=False)
        self._courses = dict(signals or {})
        for name in self._courses:
            if name not in (known := self.plant.names("signals")):
                raise UnknownIdError.of("signal", name, known)
        self._spread, self._deviation = spread, noise * np.array([each.deviation for each in self.plant.measured])
        self._model = self.plant.mpc().model
        self._low, self._high = self.plant.action_bounds
        if not (np.isfinite(self._low).all() and np.isfinite(self._high).all()):
            free = next(q.name for q in self.plant.inputs if not np.isfinite([q.low, q.high]).all())
            hint = "Simulations and learning need to know how far it goes."
            raise InvalidArgumentError(f"input {free}", expected="low and high", actual="none", hint=hint)
        states = self.plant.states
        self._range = tuple(np.array([getattr(each, end) for each in states]) for end in ("low", "high"))
        clocks = {True: (-1.0, 1.0)}
        outside = [clocks.get(s.period is not None, (s.low, s.high)) for s in self.plant.signals for _ in range(s.size)]
        shown = [[getattr(each, end) for each in self.plant.measured] for end in ("low", "high")]
        low, high = (np.append(own, [pair[i] for pair in outside]) for i, own in enumerate(shown))
        self._shown = low.astype(np.float32), high.astype(np.float32)
        self.observation_space = spaces.Box(*self._shown, dtype=np.float32)
        self.action_space = spaces.Box(self._low.astype(np.float32), self._high.astype(np.float32), dtype=np.float32)
        self._rate = np.array([np.inf if each.rate is None else each.rate for each in self.plant.inputs])
        self._x: Array | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Starts an episode; see the class.

        Raises:
            ValueError: For an unknown option, a state of another shape or not finite, or an unknown parameter.
        """
        super().reset(seed=seed)
        options = options or {}
        if other := set(options) - {"state", "parameters"}:
            raise ValueError(f"reset options: expected 'state' or 'parameters', got {sorted(map(str, other))}.")
        drawn, rng = {}, self.np_random
        for name, parameter in self.plant.parameters.items():
            factor = 1.0 + self._spread * parameter.spread * rng.uniform(-1.0, 1.0)
            drawn[name] = float(np.clip(np.multiply(parameter.value, factor), parameter.low, parameter.high))
        for name, value in options.get("parameters", {}).items():
            if name not in drawn:
                raise ValueError(f"reset option 'parameters': expected names among {sorted(drawn)}, got {name!r}.")
            drawn[name] = float(value)
        starts = np.array([each.starts for each in self.plant.states])
        x = np.asarray(options.get("state", rng.uniform(*starts.T)), dtype=np.float64)
        if x.shape != self._range[0].shape or not np.isfinite(x).all():
            raise ValueError(f"reset option 'state': expected {len(starts)} finite numbers, got {x!r}.")
        self._theta = np.array(list(drawn.values()))
        self._x, self._k = np.clip(x, *self._range), 0
        self._signals = [_Signal(s, self._courses.get(s.name), rng, self.plant.steps) for s in self.plant.signals]
        rest = np.array([each.at_rest for each in self.plant.inputs])
        self._acted: Array = rest  # in the step before, dead time past
        self._past = deque([rest], maxlen=1 + max(each.delay or 0 for each in self.plant.inputs))
        return self._observed(), {"cost": 0.0, "state": self._x.copy(), "applied": rest, "parameters": drawn}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """Applies an action for one control interval.

        Raises:
            ValueError: For an action of another shape or not finite.
            gymnasium.error.ResetNeeded: Before the first ``reset``.
        """
        if self._x is None:
            raise gym.error.ResetNeeded("step: expected a reset environment, call reset() first.")
        asked = np.asarray(action, dtype=np.float64)
        if asked.shape != self._low.shape or not np.isfinite(asked).all():
            raise ValueError(f"action: expected {len(self._low)} finite numbers, got {action!r}.")
        before = self._past[-1]
        applied = np.clip(np.clip(asked, self._low, self._high), before - self._rate, before + self._rate)
        present = np.array([signal.now(self._k)[0] for signal in self._signals])
        cost = float(self.plant.costs(self._x[None], applied[None], present[None], before[None])[0])
        self._past.append(applied)
        late = [each.delay or 0 for each in self.plant.inputs]
        self._acted = np.array([self._past[max(-1 - d, -len(self._past))][i] for i, d in enumerate(late)])
        reached = self._model.plant(self._x, np.append(self._acted, present), self._theta).full().ravel()
        self._x = np.clip(np.where(np.isfinite(reached), reached, self._x), *self._range)
        self._k += 1
        info = {"cost": cost, "state": self._x.copy(), "applied": applied}
        return self._observed(), -cost, False, False, info

    def _observed(self) -> NDArray[np.float32]:
        exact: Any = self._x
        if self.plant.outputs:
            exact = shown(self.plant.outputs_function, exact, self._acted)
        measured = exact + self._deviation * self.np_random.standard_normal(len(exact))
        values = np.concatenate([measured, *(signal.now(self._k) for signal in self._signals)]).astype(np.float32)
        return np.clip(values, *self._shown)


class _Signal:
    """A signal in an episode."""

    def __init__(self, signal: Signal, course: Course | None, rng: np.random.Generator, steps: int) -> None:
        self._signal, self._rng = signal, rng
        self._random = course is None and np.isfinite([signal.low, signal.high]).all()
        self._phase = rng.uniform(0.0, 2.0 * np.pi) if signal.period is not None else 0.0
        drawn = course(rng, steps + signal.size) if callable(course) else course
        first = [rng.uniform(signal.low, signal.high)] if self._random else [signal.usual]
        self._values = first if drawn is None else np.atleast_1d(np.asarray(drawn, dtype=np.float64)).tolist()

    def now(self, k: int) -> Array:
        """Its columns of an observation in step k, ``(size,)``."""
        if self._signal.period is not None:
            step = 2.0 * np.pi * k / self._signal.period
            return np.array(turned(np.cos(self._phase), np.sin(self._phase), step))
        while self._random and len(self._values) < k + self._signal.size:
            s = self._signal
            again = self._rng.uniform() >= 1.0 / _HELD
            self._values.append(self._values[-1] if again else self._rng.uniform(s.low, s.high))
        last = len(self._values) - 1
        return np.array([self._values[min(k + i, last)] for i in range(self._signal.size)])


def made(plant: Plant, *, steps: int | None = None, **options: Any) -> gym.Env[Any, Any]:
    """A registered environment of a plant, so that it can be rebuilt from its spec in this process.

    Args:
        plant: The plant; it takes the place of one of the same name.
        steps: Control intervals of an episode; the plant's by default.
        **options: As :class:`PlantEnv` and :func:`gymnasium.make` take them.
    """
    name = "".join(word[:1].upper() + word[1:] for word in re.findall(r"[A-Za-z0-9]+", plant.name)) or "Plant"
    env_id = f"plants/{name}-v0"
    _DESCRIBED[name] = plant
    gym.registry.pop(env_id, None)
    gym.register(
        env_id,
        entry_point="mpcoffline.plants.environment:PlantEnv",
        kwargs={"plant": name},
        max_episode_steps=plant.steps,
    )
    return gym.make(env_id, max_episode_steps=plant.steps if steps is None else steps, **options)
