"""What the options of solvers may be, whoever says so: a caller or a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral
from typing import Any

from mpcoffline.core import limits
from mpcoffline.core.checks import check_number
from mpcoffline.core.errors import InvalidArgumentError

from .starts import N_CANDIDATES

_MOST = {
    "max_iterations": limits.ITERATIONS,
    "n_starts": N_CANDIDATES,
    "n_threads": limits.THREADS,
    "n_workers": limits.THREADS,
    "cache_size": limits.CACHED,
}
#: How many cores are used is the machine's matter, not the controller's: files do not say it.
OF_THE_MACHINE = frozenset({"n_threads", "n_workers"})


def check_options(options: Mapping[str, Any]) -> None:
    """Refuses values out of range; names that a solver does not know are its own matter.

    Args:
        options: By name, as of ``make_solver``.

    Raises:
        InvalidArgumentError: Names the option and its range.
    """
    for name, value in options.items():
        if name == "tolerance":
            check_number(name, value, 0.0, 1.0)
        elif name == "max_time" and value != math.inf:
            check_number(name, value, 0.0)
        elif name in _MOST and not (name == "n_starts" and value is None):  # None: as many as the problem needs
            whole = isinstance(value, Integral) and not isinstance(value, bool)
            if not whole or not 1 <= int(value) <= _MOST[name]:
                shown = repr(value)[:100]
                raise InvalidArgumentError(name, expected=f"an integer from 1 to {_MOST[name]}", actual=shown)
