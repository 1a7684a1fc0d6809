"""Units as instruments and historians write them, against conversions by hand."""

from __future__ import annotations

import math

import pytest

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets.logs.units import conversion


@pytest.mark.parametrize(
    ("given", "wanted", "factor", "offset"),
    [
        ("EUR/MWh", "EUR/kWh", 1e-3, 0.0),
        ("ct/kWh", "EUR/kWh", 0.01, 0.0),
        ("€/MWh", "ct/kWh", 0.1, 0.0),
        ("cents/kWh", "$/MWh", 10.0, 0.0),
        ("kEUR", "EUR", 1e3, 0.0),
        ("NOK/kWh", "NOK/MWh", 1e3, 0.0),
        ("ct", "g", 0.2, 0.0),  # carats, where nothing speaks of money
        ("C", "degC", 1.0, 0.0),
        ("F", "°C", 5.0 / 9.0, -160.0 / 9.0),
        ("C", "K", 1.0, 273.15),
        ("RPM", "1/min", 1.0, 0.0),
        ("rpm", "Hz", 1.0 / 60.0, 0.0),
        ("Hz", "rpm", 60.0, 0.0),
        ("U/min", "rad/s", 2.0 * math.pi / 60.0, 0.0),
        ("kPa(g)", "barg", 0.01, 0.0),
        ("mbar_a", "bar", 1e-3, 0.0),
        ("psig", "bar", 0.0689475729, 0.0),
        ("mmH2O", "Pa", 9.80665, 0.0),
        ("gpm", "l/min", 3.785411784, 0.0),
        ("sccm", "cm3/s", 1.0 / 60.0, 0.0),
        ("m³/Std", "m3/h", 1.0, 0.0),
        ("% r.H.", "%", 1.0, 0.0),
        ("cm2", "mm^2", 100.0, 0.0),
    ],
)
def test_conversions(given: str, wanted: str, factor: float, offset: float) -> None:
    assert conversion("log.csv", given, wanted) == pytest.approx((factor, offset), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("given", "wanted", "said"),
    [
        ("EUR/kWh", "USD/kWh", "a unit that can become USD/kWh, got EUR/kWh"),
        ("bara", "barg", "differ by the pressure of the air"),
        ("furlong per flake", "m/s", "'EUR/MWh'"),
    ],
)
def test_what_cannot_be_converted_is_told(given: str, wanted: str, said: str) -> None:
    with pytest.raises(InvalidDataError, match=said):
        conversion("log.csv: column 'x'", given, wanted)
