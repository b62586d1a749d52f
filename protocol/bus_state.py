"""What a CAN controller says about itself: its error state, from the error frames of Linux (linux/can/error.h)."""

from __future__ import annotations

from enum import Enum

ERROR_FRAME = 0x20000000
"""In the identifier: the frame is the driver's and no other node's."""
_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100
TOLD = _CONTROLLER | _BUS_OFF | _RESTARTED
"""The kinds of error frames to subscribe to: changes of state. Single errors, which may flood, are not asked for."""
_ACTIVE, _WARNING, _PASSIVE = 0x40, 0x0C, 0x30  # in data[1], the latter two for both directions


class BusState(Enum):
    """As CAN names them; at WARNING (96 errors counted) all works still, at BUS_OFF the controller has left the bus."""

    ACTIVE = "active"
    WARNING = "warning"
    PASSIVE = "passive"
    BUS_OFF = "bus-off"


def state_after(before: BusState, can_id: int, data: bytes) -> BusState:
    """The state that an error frame tells of; the one before when it tells of something else."""
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


def what_to_do(interface: str) -> str:
    """Words for an interface of Linux that is bus-off."""
    return (
        f"CAN interface {interface!r} is bus-off: after too many errors it has left the bus. {_CHECK}; then "
        f"`ip link set {interface} type can restart`, or let it restart by itself: `ip link set {interface} down`, "
        f"`ip link set {interface} up type can restart-ms 100`"
    )


def what_to_do_elsewhere(url: str) -> str:
    """Words for an adapter that is not an interface of Linux."""
    return f"bus {url!r} is bus-off: after too many errors its adapter has left the bus. {_CHECK}; then open it again"
