"""Positive semidefinite matrices by their lower-triangular factor."""

from __future__ import annotations

import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array

_PSD_TOLERANCE = 1e-9  # relative to the diagonal


def psd_factor(matrix: Array, name: str = "matrix") -> Array:
    """The lower-triangular C ``(n, n)`` with C C' = matrix and a non-negative diagonal; works for singular matrices.

    Raises:
        InvalidArgumentError: If the matrix is not square, finite, symmetric and positive semidefinite.
    """
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise InvalidArgumentError(name, expected="a square matrix", actual=f"shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InvalidArgumentError(name, expected="finite entries", actual=str(matrix.tolist()))
    units = _units(matrix)
    scaled = matrix / units[:, None] / units
    asymmetry = np.abs(scaled - scaled.T)
    if asymmetry.max(initial=0.0) > _PSD_TOLERANCE:
        i, j = np.unravel_index(int(asymmetry.argmax()), asymmetry.shape)
        differ = f"entries that differ from their mirror by {abs(matrix[i, j] - matrix[j, i]):.3g}"
        raise InvalidArgumentError(name, expected="a symmetric matrix", actual=differ)
    if np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0] < -_PSD_TOLERANCE:
        smallest = np.linalg.eigvalsh((matrix + matrix.T) / 2.0)[0]
        raise InvalidArgumentError(
            name, expected="a positive semidefinite matrix", actual=f"smallest eigenvalue {smallest:.3g}"
        )
    symmetric = (matrix + matrix.T) / 2.0
    try:
        return np.asarray(np.linalg.cholesky(symmetric))
    except np.linalg.LinAlgError:  # singular
        factor = _singular_factor(symmetric)
    if (np.abs(factor @ factor.T - symmetric) > _PSD_TOLERANCE * np.outer(units, units)).any():  # of unequal units
        factor = units[:, None] * _singular_factor((scaled + scaled.T) / 2.0)
    return factor


def _units(matrix: Array) -> Array:
    """What each row and column of a weight is measured by: the root of its diagonal element, else of the largest."""
    largest = float(np.abs(matrix).max(initial=0.0))
    diagonal = np.diag(matrix)
    return np.asarray(np.sqrt(np.where(diagonal > 0.0, diagonal, largest if largest > 0.0 else 1.0)))


def _singular_factor(matrix: Array) -> Array:
    """The lower-triangular factor of a symmetric matrix without its negative eigenvalues: QR of its root's factor."""
    eigenvalues, vectors = np.linalg.eigh(matrix)
    upper = np.linalg.qr((vectors * np.sqrt(np.maximum(eigenvalues, 0.0))).T).R
    signs = np.where(np.diag(upper) < 0.0, -1.0, 1.0)
    return np.asarray((upper * signs[:, None]).T)
