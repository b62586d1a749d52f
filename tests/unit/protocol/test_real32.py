from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from loopwright.protocol.real32 import nearest, same, shortest


def travelled(value: float) -> float:
    """As it comes out at the other end of the bus."""
    found: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return found


@given(st.floats(width=32))
def test_packed_again_it_is_the_same_four_bytes(value: float) -> None:
    assert struct.pack("<f", shortest(value)) == struct.pack("<f", value)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_it_is_the_decimal_that_numpy_writes(value: float) -> None:
    """Which is what the stored samples are shown as. Of a few powers of two numpy takes a digit less off."""
    assume(abs(math.frexp(value)[0]) != 0.5)
    assert shortest(value) == float(np.float32(value).astype(str))


@given(st.integers(-999_999, 999_999), st.integers(-30, 30))
def test_what_has_six_digits_arrives_as_it_was_sent(digits: int, power: int) -> None:
    sent = float(f"{digits}e{power}")
    assert shortest(travelled(sent)) == sent


@pytest.mark.parametrize("value", [0.05, 0.1, 49.8, 0.75, 19.17, 1e-6, 3.4028235e38, 1e-45, 8589974000.0, 0.0, -0.0])
def test_examples(value: float) -> None:
    assert repr(shortest(travelled(value))) == repr(value)


def test_what_is_no_number_stays() -> None:
    assert math.isnan(shortest(math.nan)) and shortest(-math.inf) == -math.inf


@pytest.mark.parametrize("value", [0.05, -273.15, 1.0 / 3.0, 1e-30])
def test_a_value_is_the_same_after_the_bus_and_not_after_a_change(value: float) -> None:
    there = nearest(value)
    assert struct.pack("<f", value) == struct.pack("<f", there) and there == nearest(there)
    assert same(value, there) and same(there, value)
    if abs(value) > 1e-9:
        assert not same(value, there * (1.0 + 3e-6)) and not same(value, -value)


def test_beyond_the_range_and_no_number_are_no_same_value() -> None:
    assert nearest(1e39) == math.inf and nearest(-1e39) == -math.inf
    assert not same(math.nan, math.nan) and not same(1e39, nearest(1e39))
