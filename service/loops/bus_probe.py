"""What is on a bus: every node that sends a heartbeat, what it says of itself, and whether two share one node-ID.

Only reads are sent, and each answer is counted: two devices with one node-ID both answer.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass

from loopwright.protocol.bus import Bus, BusError
from loopwright.protocol.objects import Device, default_of, lookup
from loopwright.protocol.profile import (
    HEARTBEAT_FRAME,
    REVISION,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.station import Station
from loopwright.service.loops.bus_reading import state_name
from loopwright.tuning.reasons import Failed, Reason

LISTEN_S = 2.0
"""Wall time for which heartbeats are heard, s: the devices of the profile send one every 0.5 s."""
ANSWER_S = 2.0
"""Wall time for which the first answer to a request is awaited, s: a device may be busy, and a request that is sent
again would be answered twice."""
FURTHER_S = 0.3
"""Wall time for which the answers of further devices with the same node-ID are awaited after it, s."""
NODES = range(1, 128)
_UPLOAD, _ABORT, _SPECIFIER = 0x40, 0x80, 0xE0


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node of a bus.

    state: its NMT state, as its heartbeat says; None where none was heard.
    device: what it is; None where it is no device of the profile, or does not answer.
    channels: the number of its channels.
    sample_time_s: its sample time, s.
    problems: what prevents it from being used, in words.
    """

    node: int
    state: str | None
    device: Device | None = None
    channels: int | None = None
    sample_time_s: float | None = None
    problems: tuple[str, ...] = ()


def probe(url: str, station: Station, nodes: Collection[int] = ()) -> list[FoundNode]:
    """Returns the nodes of a bus by node-ID.

    nodes: nodes that are asked although no heartbeat of theirs is heard.
    Raises Failed(BUS_LOST).
    """
    try:
        bus = station.open_bus(url)
        try:
            states = _heard(bus, station)
            return [_asked(bus, station, node, states.get(node)) for node in sorted({*states, *nodes})]
        finally:
            bus.close()
    except BusError as error:
        raise Failed(Reason.BUS_LOST, str(error)) from error


def _heard(bus: Bus, station: Station) -> dict[int, str]:
    """Returns the NMT states of the nodes that send a heartbeat."""
    of = {heartbeat_id(node): node for node in NODES}
    bus.set_filters(of)
    found: dict[int, str] = {}
    until = station.monotonic() + LISTEN_S
    while (left := until - station.monotonic()) > 0.0:
        frame = bus.recv(left)
        if frame is None or frame[0] not in of or len(frame[1]) != HEARTBEAT_FRAME.size:
            continue
        (state,) = HEARTBEAT_FRAME.unpack(frame[1])
        found[of[frame[0]]] = state_name(state)
    return found


def _asked(bus: Bus, station: Station, node: int, state: str | None) -> FoundNode:
    """Returns what a node says of itself."""
    bus.set_filters({sdo_response_id(node)})
    types = _answers(bus, station, node, "device_type")
    if not types:
        return FoundNode(node, state, problems=("it answers no SDO",))
    problems = [] if len(types) == 1 else [f"{len(types)} devices answer: give each a node-ID of its own"]
    kinds = {int(default_of(lookup("device_type"), 0, kind)): kind for kind in (Device.CONTROLLER, Device.PLANT)}
    device = kinds.get(types[0])
    if device is None:
        problems.append(f"its device type is {types[0]:08X}h, which is none of the profile")
        return FoundNode(node, state, problems=tuple(problems))
    revision = (_answers(bus, station, node, "identity", 3) or [0])[0]
    if revision >> 16 != REVISION >> 16:
        problems.append(
            f"it speaks revision {revision >> 16}.{revision & 0xFFFF} of the profile, this version "
            f"{REVISION >> 16}.{REVISION & 0xFFFF}"
        )
    channels = _answers(bus, station, node, "controller_mode" if device is Device.CONTROLLER else "plant_pv")
    sample_time_us = _answers(bus, station, node, "sample_time")
    return FoundNode(
        node,
        state,
        device,
        channels[0] if channels else None,
        sample_time_us[0] / 1e6 if sample_time_us else None,
        tuple(problems),
    )


def _answers(bus: Bus, station: Station, node: int, name: str, sub: int = 0) -> list[int]:
    """Returns the value of an object as each device with this node-ID answers it: whole numbers of up to four bytes."""
    address = struct.pack("<HB", lookup(name).index, sub)
    bus.send(sdo_request_id(node), bytes([_UPLOAD]) + address + bytes(4))
    found, answered = [], False
    until = station.monotonic() + ANSWER_S
    while (left := until - station.monotonic()) > 0.0:
        frame = bus.recv(left)
        if frame is None or len(frame[1]) != 8 or frame[1][1:4] != address:
            continue
        if frame[1][0] & _SPECIFIER not in (_UPLOAD, _ABORT):  # it answers what somebody else has asked
            continue
        if not answered:
            answered, until = True, station.monotonic() + FURTHER_S
        if frame[1][0] & _SPECIFIER == _UPLOAD and frame[1][0] & 0x02:  # expedited: the value is in this frame
            length = 4 - (frame[1][0] >> 2 & 3) if frame[1][0] & 0x01 else 4
            found.append(int.from_bytes(frame[1][4 : 4 + length], "little"))
    return found
