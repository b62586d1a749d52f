"""The values of each order within a session, and the check that puts it in force, for controller and tuner."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

from loopwright.protocol.objects import Value, lookup
from loopwright.protocol.profile import REVISION, Order

GAINS = ("kp", "ti", "td", "tf", "b", "c")

STAGED: dict[Order, tuple[str, ...]] = {
    Order.OPEN: tuple(
        f"controller_session_{name}" for name in ("tuner", "lease_samples", "lease_ms", "pv_silence_ms", "watch_ms")
    ),
    Order.CLOSE: (),
    Order.SETPOINT: ("controller_session_setpoint",),
    Order.MODE: ("controller_session_mode",),
    Order.OUTPUT: ("controller_session_output",),
    Order.RELAY: tuple(
        f"controller_relay_{name}"
        for name in (
            "amplitude", "hysteresis", "working_output", "max_samples", "pv_low", "pv_high", "amplitude_low", "average",
        )
    ),
    Order.TRY: tuple(f"controller_session_{name}" for name in GAINS),
    Order.ACCEPT: tuple(f"controller_session_{name}" for name in GAINS),
    Order.WATCH: ("controller_session_pv_low", "controller_session_pv_high"),
    Order.HOLD: (),
}  # fmt: skip
"""The objects that hold the values of an order, in the order in which the check covers them."""


def object_of(order: Order) -> str:
    """Returns the object to which the check of the order is written."""
    return f"controller_order_{order.name.lower()}"


def check_of(number: int, count: int, order: Order, values: Sequence[Value]) -> int:
    """Returns the check of an order: CRC-32 (that of zlib and Ethernet) over profile revision, session number and
    running count (U32 each, little-endian), order (U8) and the values as an SDO carries them.

    number: number of the session; for an opening, the number read from 2130h.
    count: orders given in the session before this one.
    """
    text = struct.pack("<IIIB", REVISION, number, count & 0xFFFFFFFF, order)
    for name, value in zip(STAGED[order], values, strict=True):
        text += lookup(name).type.encode(value)
    return zlib.crc32(text)
