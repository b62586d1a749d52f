"""Error frames through the kernel: on a virtual interface anybody may send what a real one's driver would."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import pytest

from loopwright.protocol.bus import Bus, BusError, open_bus
from loopwright.protocol.bus_state import BusState

INTERFACE = "vcan0"


pytestmark = pytest.mark.vcan


@pytest.fixture
def driver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as driver:
        driver.bind((INTERFACE,))
        yield driver


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = open_bus(f"socketcan:{INTERFACE}")
    bus.set_filters({0x190})
    yield bus
    bus.close()


def test_the_controllers_state_follows_its_error_frames(driver: socket.socket, bus: Bus) -> None:
    def tell(kind: int, detail: int = 0) -> None:
        driver.send(struct.pack("=IB3x8s", socket.CAN_ERR_FLAG | kind, 8, bytes((0, detail))))

    for detail, state in ((0x08, BusState.WARNING), (0x20, BusState.PASSIVE), (0x40, BusState.ACTIVE)):
        tell(0x004, detail)
        assert bus.recv(1.0) is None
        assert bus.state is state
    tell(0x008)  # a single error on the bus: not subscribed to
    tell(0x040)
    with pytest.raises(BusError, match="bus-off"):
        bus.recv(1.0)
    with pytest.raises(BusError, match="bus-off"):
        bus.send(0x2A0, b"\0")
    tell(0x100)
    assert bus.recv(1.0) is None
    assert bus.state is BusState.ACTIVE
    driver.send(struct.pack("=IB3x8s", 0x190, 2, b"\1\2"))
    assert bus.recv(1.0) == (0x190, b"\1\2")
    bus.send(0x2A0, b"\0")
