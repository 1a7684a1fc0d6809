"""Units that logs and models are often confused in, as what the data have to be multiplied by, or raised by."""

from __future__ import annotations

import numpy as np

_DEGREE = np.pi / 180.0
_TURN = np.pi / 30.0  # a turn a minute in rad/s
_FACTORS_IN_WORDS = {
    _DEGREE: "from degrees to radians",
    1.0 / _DEGREE: "from radians to degrees",
    _TURN: "from rpm to rad/s",
    1.0 / _TURN: "from rad/s to rpm",
    60.0 * _TURN: "from turns to radians",
    1.0 / (60.0 * _TURN): "from radians to turns",
}
#: What the data may have to be multiplied by to be in the model's units.
FACTORS = (
    1e3, 1e-3, 1e2, 1e-2, _DEGREE, 1.0 / _DEGREE, 60.0, 1.0 / 60.0, 3.6, 1.0 / 3.6, 10.0, 0.1, _TURN, 1.0 / _TURN,
    60.0 * _TURN, 1.0 / (60.0 * _TURN),
)  # fmt: skip
#: Factors and what is added then: degrees Celsius, kelvin and Fahrenheit.
CONVERSIONS = ((1.0, 273.15), (1.0, -273.15), (5.0 / 9.0, -160.0 / 9.0), (1.8, 32.0))


def in_words(factor: float, offset: float) -> str:
    """What would be done to data, in words."""
    if factor != 1.0 and offset:
        a, b = ("Fahrenheit", "Celsius") if factor < 1.0 else ("Celsius", "Fahrenheit")
        return f"converted from degrees {a} to {b}"
    if offset:
        kind = "from degrees Celsius to kelvin" if offset > 0.0 else "from kelvin to degrees Celsius"
        return f"{'raised' if offset > 0.0 else 'lowered'} by {abs(offset):g} ({kind})"
    if factor in _FACTORS_IN_WORDS:
        return f"multiplied by {factor:.4g} ({_FACTORS_IN_WORDS[factor]})"
    return f"multiplied by {factor:g}" if factor >= 1.0 else f"divided by {1.0 / factor:g}"
