"""Units that logs and models are often confused in, as what the data have to be multiplied by, or raised by."""

from __future__ import annotations

import numpy as np

_DEGREE = np.pi / 180.0
#: What the data may have to be multiplied by to be in the model's units.
FACTORS = (1e3, 1e-3, 1e2, 1e-2, _DEGREE, 1.0 / _DEGREE, 60.0, 1.0 / 60.0, 3.6, 1.0 / 3.6, 10.0, 0.1)
#: What may have to be added to them: degrees Celsius and kelvin.
OFFSETS = (273.15, -273.15)


def in_words(factor: float, offset: float) -> str:
    """What would be done to data, in words."""
    if offset:
        kind = "from degrees Celsius to kelvin" if offset > 0.0 else "from kelvin to degrees Celsius"
        return f"{'raised' if offset > 0.0 else 'lowered'} by {abs(offset):g} ({kind})"
    if factor in (_DEGREE, 1.0 / _DEGREE):
        kind = "from degrees to radians" if factor < 1.0 else "from radians to degrees"
        return f"multiplied by {factor:.4g} ({kind})"
    return f"multiplied by {factor:g}" if factor >= 1.0 else f"divided by {1.0 / factor:g}"
