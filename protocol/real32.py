"""Conversion of a REAL32 from the bus to the shortest decimal that packs to the same float32.

0.05 travels as the float32 nearest to it, which as a double is 0.05000000074505806. Of all decimals with the same
float32 the shortest is taken (for some powers of two one that is a digit longer), so packing it again gives the same
bytes.
"""

from __future__ import annotations

import math
import struct

_REAL32 = struct.Struct("<f")
_MIN_NORMAL = 2.0**-126


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
