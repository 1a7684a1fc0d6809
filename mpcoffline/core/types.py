"""Types that all rooms speak of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Numbers in double precision, of the shape that a docstring names.
Array = NDArray[np.float64]
