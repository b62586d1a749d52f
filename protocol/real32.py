"""REAL32 values from the bus: the shortest decimal that packs to the same float32, and when two values are the same.

0.05 travels as the float32 nearest to it, which as a double is 0.05000000074505806. Of all decimals with the same
float32 the shortest is taken (for some powers of two one that is a digit longer), so packing it again gives the same
bytes.
"""

from __future__ import annotations

import math
import struct
from ctypes import c_float

_REAL32 = struct.Struct("<f")
_MIN_NORMAL = 2.0**-126
TOLERANCE = 1e-6
"""Of a value: what `same` passes over."""


def nearest(value: float) -> float:
    """The REAL32 that carries a value, as a double; infinite beyond the range of a REAL32."""
    return c_float(value).value


def fits(value: float) -> bool:
    """Returns whether a value is finite, also as a REAL32: what a device holds has to travel on the bus."""
    return math.isfinite(nearest(value))


def same(one: float, other: float) -> bool:
    """True where two values are one REAL32 (24 bits, 6e-8) but for the rounding of a device that converts what it is
    given: equal to TOLERANCE, next to 0 to 1e-9. So what a device was given is compared with what it then holds."""
    return math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=1e-9)


def shortest(value: float) -> float:
    """Returns the shortest decimal with the same float32; infinities and nan are returned unchanged.

    value: a double that is a float32 exactly, as `struct` unpacks it.
    """
    if not math.isfinite(value):
        return value
    packed = _REAL32.pack(value)
    # A normal float32 has at least six significant digits, and nine distinguish it from every other.
    for digits in range(6 if abs(value) >= _MIN_NORMAL else 1, 9):
        decimal = float(f"{value:.{digits}g}")
        if _packs_to(decimal, packed):
            return decimal
    return float(f"{value:.9g}")


def _packs_to(decimal: float, packed: bytes) -> bool:
    try:
        return _REAL32.pack(decimal) == packed
    except OverflowError:  # rounded up beyond the largest float32
        return False
