"""Whether a log shows that an input changes no faster than it can, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from planted_logs import defects, found_in, is_named

from mpcoffline.core.types import Array
from mpcoffline.tune.moves import rate_of

N = 2_000


def asked(seed: int) -> Array:
    """What a noisy controller asks for: steps and a correction in each row."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.uniform(0.0, 6.0, N // 25), 25)
    return np.clip(steps + 0.05 * rng.normal(size=N), 0.0, 6.0)


def limited(wanted: Array, up: float, down: float) -> Array:
    """What becomes of it where it moves so far a step at most."""
    found = wanted.copy()
    for k in range(1, len(found)):
        found[k] = found[k - 1] + np.clip(wanted[k] - found[k - 1], -down, up)
    return found


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, -50.0), (1e4, 1e6)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_bound_of_changes_is_found_in_any_unit(scale: float, offset: float, seed: int) -> None:
    moved = scale * limited(asked(seed), 0.4, 0.4) + offset
    found = rate_of(moved, np.zeros(N), 6.0 * scale)
    assert found is not None
    most, share = found
    assert most == pytest.approx(0.4 * scale, rel=1e-6)
    assert 0.1 < share < 0.3
    halves = np.arange(N) // (N // 2)  # what lies between two episodes is no change
    jumped = moved + 5.0 * scale * halves
    assert rate_of(jumped, halves, 6.0 * scale) == pytest.approx(found, rel=0.02)
    assert rate_of(jumped, np.zeros(N), 11.0 * scale) is None  # else it is one that is not bound


def walk(each: Array) -> Array:
    return np.cumsum(each - np.mean(each))


SOUND: dict[str, Callable[[np.random.Generator], Array]] = {
    "steps and corrections": lambda rng: asked(3),
    "noise": lambda rng: rng.normal(size=N),
    "a random walk": lambda rng: walk(rng.normal(size=N)),
    "a random walk of bounded steps": lambda rng: walk(rng.uniform(-1.0, 1.0, N)),
    "one of whole numbers": lambda rng: np.cumsum(rng.integers(-2, 3, N)).astype(float),
    "one of whole numbers, of one size": lambda rng: np.cumsum(rng.integers(-1, 2, N)).astype(float),
    "a sine": lambda rng: np.sin(0.05 * np.arange(N)),
    "a slow sine, twenty values a half turn": lambda rng: np.sin(2.0 * np.pi * np.arange(N) / 40.3),
    "a relay": lambda rng: (rng.random(N) < 0.5).astype(float),
    "a random binary signal and noise": lambda rng: (rng.random(N) < 0.5) + 0.01 * rng.normal(size=N),
    "a sawtooth": lambda rng: np.arange(N) % 50 / 50.0,
    "a triangle": lambda rng: np.abs(np.arange(N) % 100 - 50.0),
    "a controller at its bounds": lambda rng: np.clip(5.0 * rng.normal(size=N), -1.0, 1.0),
    "a lag": lambda rng: _lagged(asked(4)),
    "nothing": lambda rng: np.zeros(N),
}


def _lagged(wanted: Array) -> Array:
    found = wanted.copy()
    for k in range(1, len(found)):
        found[k] = found[k - 1] + 0.3 * (wanted[k] - found[k - 1])
    return found


@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("seed", range(4))
def test_what_moves_freely_has_none(name: str, seed: int) -> None:
    values = SOUND[name](np.random.default_rng(seed))
    assert rate_of(values, np.zeros(N), float(np.ptp(values)) or 1.0) is None


def test_check_says_what_to_write() -> None:
    (case,) = [each for each in defects() if each.name == "an actuator that moves slowly"]
    problems, advice = found_in(case)
    assert problems == []
    assert is_named(case, problems, advice)
