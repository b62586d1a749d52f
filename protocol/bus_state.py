"""The error state of a CAN controller, decoded from the error frames of Linux (linux/can/error.h)."""

from __future__ import annotations

from enum import Enum

ERROR_FRAME = 0x20000000
"""Bit of the identifier that marks an error frame of the driver; no other node has sent such a frame."""
_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100
STATE_FRAMES = _CONTROLLER | _BUS_OFF | _RESTARTED
"""The error frames to subscribe to: changes of state. Single errors, which may flood the bus, are left out."""
_ACTIVE, _WARNING, _PASSIVE = 0x40, 0x0C, 0x30  # in data[1], the latter two for both directions


class BusState(Enum):
    """The error states of CAN. At WARNING (96 errors counted) everything works; at BUS_OFF the controller has left the
    bus."""

    ACTIVE = "active"
    WARNING = "warning"
    PASSIVE = "passive"
    BUS_OFF = "bus-off"


def state_after(before: BusState, can_id: int, data: bytes) -> BusState:
    """Returns the state that an error frame reports, or the previous one when the frame reports something else."""
    if can_id & _BUS_OFF:
        return BusState.BUS_OFF
    if can_id & _CONTROLLER and len(data) > 1:
        if data[1] & _PASSIVE:
            return BusState.PASSIVE
        if data[1] & _WARNING:
            return BusState.WARNING
        if data[1] & _ACTIVE:
            return BusState.ACTIVE
    return BusState.ACTIVE if can_id & _RESTARTED else before


_CHECK = "Check termination (120 ohms at both ends), bit rate and wiring"


def bus_off_advice(interface: str) -> str:
    """Returns the advice for a Linux interface that is bus-off."""
    return (
        f"CAN interface {interface!r} is bus-off: after too many errors it has left the bus. {_CHECK}; then "
        f"`ip link set {interface} type can restart`, or let it restart by itself: `ip link set {interface} down`, "
        f"`ip link set {interface} up type can restart-ms 100`"
    )


def adapter_bus_off_advice(url: str) -> str:
    """Returns the advice for a bus-off adapter that is not a Linux interface."""
    return f"bus {url!r} is bus-off: after too many errors its adapter has left the bus. {_CHECK}; then open it again"
