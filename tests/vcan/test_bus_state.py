"""Error frames through the kernel: on a virtual interface anybody may send what a real one's driver would."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import pytest

from loopwright.containers import vcan
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


def test_an_interface_that_was_deleted_is_found_again() -> None:
    """As an adapter that is unplugged and plugged in again."""
    name = "vcan29"
    try:
        vcan.make(name)
    except vcan.NoVcan as error:
        pytest.skip(str(error))  # this machine's vcan0 was made by somebody who may
    bus = open_bus(f"socketcan:{name}")
    bus.set_filters({0x190})
    vcan.remove(name)
    with pytest.raises(BusError, match="No such device"):
        bus.recv(1.0)
    with pytest.raises(BusError, match=f"no CAN interface '{name}'"):
        bus.recv(1.0)
    vcan.make(name)
    try:
        assert bus.recv(0.05) is None
        other = open_bus(f"socketcan:{name}")
        other.send(0x191, b"no")
        other.send(0x190, b"yes")
        assert bus.recv(10.0) == (0x190, b"yes")
        bus.send(0x2A0, b"back")
        assert other.recv(10.0) == (0x2A0, b"back")
        other.close()
        bus.close()
    finally:
        vcan.remove(name)
