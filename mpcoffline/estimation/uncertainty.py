"""How far the data determine parameters: deviations that hold for errors of any kind, and what is left open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

_CHI2 = 3.0  # what the misfit must grow by, for data that say anything
_FEWEST_CLUSTERS = 20


@dataclass(frozen=True)
class Misfit:
    """Minus twice the log likelihood of the data as a function of the scaled parameters z, about its minimum.

    Attributes:
        value: The misfit of z ``(p,)``, up to a constant.
        information: Half of its second derivative, ``(p, p)``.
        scores: Half of its derivative, the share of each group of rows whose errors are independent of those of the
            others, ``(groups, p)``.
    """

    value: Callable[[Array], float]
    information: Array
    scores: Array

    @classmethod
    def nothing(cls) -> Misfit:
        """That of a model without parameters."""
        return cls(lambda _: 0.0, np.zeros((0, 0)), np.zeros((0, 0)))


def clusters(scores: Array, episodes: NDArray[np.integer[Any]]) -> Array:
    """Scores ``(n, p)`` summed over episodes; over stretches of rows where there are hardly any episodes.

    Args:
        scores: One a row, or one a trajectory, in the order of the log.
        episodes: The episode of each, ``(n,)``.
    """
    ids, group = np.unique(episodes, return_inverse=True)
    if len(ids) < _FEWEST_CLUSTERS:
        group = np.arange(len(scores)) * min(_FEWEST_CLUSTERS, len(scores)) // max(len(scores), 1)
    total = np.zeros((int(group.max(initial=-1)) + 1, scores.shape[1]))
    np.add.at(total, group, scores)
    return total


def uncertainty(
    misfit: Misfit, z: Array, bounds: tuple[Array, Array], spread: float, names: Sequence[str]
) -> tuple[Array, tuple[str, ...]]:
    """Covariance of z, and the combinations of parameters that the data leave open.

    ::

        cov = H^-1/2 max(1, H^-1/2 B H^-1/2) H^-1/2,     H = information + 1/spread^2,     B = sum_groups g g'

    The sandwich H^-1 B H^-1 (White, Econometrica 50(1), 1982) holds for errors that are correlated within a group or
    larger than the model of the noise has them; it is never taken to be smaller than H^-1.

    A direction in which the information is weak is open only if the misfit hardly grows on either side, one spread of
    the prior away: a friction that went from its guess to a tenth of that is weakly determined as a logarithm, and yet
    the data say that it is small.

    Args:
        misfit: What the data say.
        z: Its minimum, with the prior, ``(p,)``.
        bounds: Lowest and highest z, ``(p,)`` each.
        spread: Standard deviation of the prior.
        names: Of the parameters.
    """
    strengths, directions = np.linalg.eigh(misfit.information)
    known = np.where(strengths > 1e-12 * strengths.max(initial=0.0), strengths, 0.0) * spread**2
    root = directions * (spread / np.sqrt(known + 1.0))
    whitened = misfit.scores @ root
    growth, axes = np.linalg.eigh(whitened.T @ whitened * (len(whitened) / max(len(whitened) - 1, 1)))
    root = root @ axes * np.sqrt(np.maximum(growth, 1.0))
    covariance = np.asarray(root @ root.T)
    least = misfit.value(z)

    def left_open(direction: Array) -> bool:
        sides = (misfit.value(np.clip(z + side * spread * direction, *bounds)) for side in (-1.0, 1.0))
        return all(not value - least > _CHI2 for value in sides)

    weak = directions[:, known < _CHI2].T
    return covariance, tuple(_combination(direction, names) for direction in weak if left_open(direction))


def _combination(direction: Array, names: Sequence[str]) -> str:
    """A direction in words: the parameters that it moves together, largest first."""
    order = np.argsort(-np.abs(direction), kind="stable")
    involved = [names[i] for i in order if abs(direction[i]) > 0.3 * np.abs(direction).max()]
    return " with ".join(involved[:4]) + (" and others" if len(involved) > 4 else "")
