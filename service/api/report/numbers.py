"""Numbers, units and times as text in a report, as the operators' page shows them. What is not known is a dash."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest

DASH = "–"
_NARROW = "\u202f"
_MINUS = "\u2212"
_UNITS = {"degC": "°C", "degF": "°F", "m3/h": "m³/h", "m3": "m³", "m3/s": "m³/s", "kg/m3": "kg/m³", "m2": "m²"}


def known(value: float | None) -> bool:
    """Returns whether there is a finite value."""
    return value is not None and math.isfinite(value)


def fixed(value: float | None, decimals: int) -> str:
    """Returns a number with so many decimals."""
    if value is None or not math.isfinite(value):
        return DASH
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text.replace("-", _MINUS)


def significant(value: float | None, digits: int = 4) -> str:
    """Returns a number with so many significant digits; with an exponent only below 1e-4 and from 1e6."""
    if value is None or not math.isfinite(value):
        return DASH
    size = abs(value)
    if size == 0.0:
        return "0"
    if not 1e-4 <= size < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(exponent)}".replace("-", _MINUS)
    return fixed(value, min(12, max(0, digits - 1 - math.floor(math.log10(size)))))


def with_error(value: float | None, error: float | None) -> str:
    """Returns a value with its standard error, of one digit."""
    return significant(value) if not known(error) or error == 0.0 else f"{significant(value)} ± {significant(error, 1)}"


def list_with_errors(values: Sequence[float], errors: Sequence[float] | None) -> str:
    """Returns coefficients with their standard errors."""
    return ", ".join(with_error(value, error) for value, error in zip_longest(values, errors or ()))


def Ms_error(value: float | None) -> str:
    """Returns an uncertainty of Ms, never less than 0.001."""
    return DASH if value is None or not math.isfinite(value) else f"{max(0.001, value):.3f}"


def unit(name: str) -> str:
    """Returns a unit as it is printed."""
    return _UNITS.get(name, name)


def with_unit(text: str, of: str) -> str:
    """Returns a number with its unit."""
    return f"{text}{_NARROW}{unit(of)}"


def duration(seconds: float | None) -> str:
    """Returns a duration: 9.4 s, 50 s, 14 min, 2.3 h, 3 d."""
    if seconds is None or not math.isfinite(seconds):
        return DASH
    s = max(0.0, seconds)
    for limit, per, name in ((99.5, 1.0, "s"), (99.5 * 60.0, 60.0, "min"), (48 * 3600.0, 3600.0, "h")):
        if s < limit:
            return f"{s / per:.{1 if s / per < 9.95 else 0}f}{_NARROW}{name}"
    return f"{s / 86_400.0:.0f}{_NARROW}d"


def change(before: float | None, after: float | None) -> str:
    """Returns the change from one value to another in percent."""
    if before is None or after is None or not math.isfinite(before) or not math.isfinite(after) or before == 0.0:
        return ""
    percent = 100.0 * (after / before - 1.0)
    return f"{'+' if percent >= 0.5 else ''}{fixed(percent, 0)}{_NARROW}%"


def date(stamp: str | None) -> str:
    """Returns a time of day, ISO 8601 UTC, to the second."""
    return DASH if stamp is None else stamp.replace("T", " ")[:19]


def pv_decimals(low: float, high: float) -> int:
    """Returns the decimals of PV and SP: a thousandth of the permitted range shows."""
    step = (high - low) / 1000.0
    return min(6, max(0, math.ceil(-math.log10(step) - 1e-9))) if step > 0.0 else 2
