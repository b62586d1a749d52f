"""A CAN controller that gets into trouble: what its error frames say, and what who sends and receives is told."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator

import can
import pytest

from loopwright.protocol import bus as bus_module
from loopwright.protocol.bus import BusError, Frame, LibraryBus, RawBus
from loopwright.protocol.bus_state import BusState, state_after

ACTIVE, WARNING, PASSIVE, BUS_OFF = BusState
BUSOFF, RESTARTED = 0x040, 0x100
FRAME = struct.Struct("=IB3x8s")


@pytest.mark.parametrize(
    ("before", "can_id", "told", "after"),
    [
        (ACTIVE, 0x004, 0x04, WARNING),
        (ACTIVE, 0x004, 0x08, WARNING),
        (WARNING, 0x004, 0x10, PASSIVE),
        (WARNING, 0x004, 0x24, PASSIVE),
        (PASSIVE, 0x004, 0x08, WARNING),
        (PASSIVE, 0x004, 0x40, ACTIVE),
        (PASSIVE, 0x004, 0x01, PASSIVE),
        (PASSIVE, 0x040, 0x00, BUS_OFF),
        (PASSIVE, 0x044, 0x20, BUS_OFF),
        (BUS_OFF, 0x100, 0x00, ACTIVE),
        (BUS_OFF, 0x104, 0x08, WARNING),
        (WARNING, 0x008, 0x00, WARNING),
    ],
)
def test_what_an_error_frame_says(before: BusState, can_id: int, told: int, after: BusState) -> None:
    assert state_after(before, 0x20000000 | can_id, bytes((0, told, 0, 0, 0, 0, 0, 0))) is after


class Raw:
    """A raw bus whose kernel is the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        ours, self.kernel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        monkeypatch.setattr(bus_module, "_opened", lambda interface: ours)
        self.bus = RawBus("can0")

    def hears(self, can_id: int, data: bytes = bytes(8)) -> None:
        self.kernel.send(FRAME.pack(can_id, len(data), data))

    def hears_an_error(self, kind: int, told: int = 0) -> None:
        self.hears(0x20000000 | kind, bytes((0, told, 0, 0, 0, 0, 0, 0)))


@pytest.fixture
def raw(monkeypatch: pytest.MonkeyPatch) -> Iterator[Raw]:
    raw = Raw(monkeypatch)
    yield raw
    raw.bus.close()
    raw.kernel.close()


class TestRawBus:
    def test_data_frames_pass_between_error_frames(self, raw: Raw) -> None:
        raw.hears_an_error(0x004, 0x08)
        raw.hears(0x190, b"\1\2")
        assert raw.bus.recv(0.0) is None
        assert raw.bus.state is WARNING
        assert raw.bus.recv(0.0) == (0x190, b"\1\2")
        raw.bus.send(0x2A0, b"\3")
        assert FRAME.unpack(raw.kernel.recv(16)) == (0x2A0, 1, b"\3" + bytes(7))

    @pytest.mark.parametrize("timeout", [0.0, 0.001, 0.02])
    def test_bus_off_is_said_and_what_to_do(self, raw: Raw, timeout: float) -> None:
        raw.hears(0x190)
        raw.hears_an_error(BUSOFF)
        assert raw.bus.recv(timeout) == (0x190, bytes(8))
        for _ in range(3):
            with pytest.raises(BusError, match=r"'can0' is bus-off.*termination.*bit rate.*wiring.*restart-ms 100"):
                raw.bus.recv(timeout)
        assert raw.bus.state is BUS_OFF
        with pytest.raises(BusError, match="is bus-off"):
            raw.bus.send(0x2A0, b"\3")

    def test_a_restart_ends_it(self, raw: Raw) -> None:
        raw.hears_an_error(BUSOFF)
        with pytest.raises(BusError):
            raw.bus.recv(0.0)
        raw.hears_an_error(RESTARTED)
        assert raw.bus.recv(0.0) is None
        assert raw.bus.state is ACTIVE
        raw.bus.send(0x2A0, b"\3")
        assert raw.kernel.recv(16)[:2] == b"\xa0\x02"

    def test_so_does_taking_the_interface_down(self, raw: Raw, monkeypatch: pytest.MonkeyPatch) -> None:
        raw.hears_an_error(BUSOFF)
        with pytest.raises(BusError):
            raw.bus.recv(0.0)

        def down(*arguments: int) -> bytes:
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))

        monkeypatch.setattr(raw.bus, "_recv", down)
        with pytest.raises(BusError, match="down"):
            raw.bus.recv(0.0)
        assert raw.bus.state is ACTIVE

    @pytest.mark.parametrize("first", ["send", "recv"])
    def test_an_interface_that_was_away_is_opened_again(
        self, raw: Raw, monkeypatch: pytest.MonkeyPatch, first: str
    ) -> None:
        filters: list[set[int]] = []
        monkeypatch.setattr(RawBus, "set_filters", lambda bus, ids: filters.append(set(ids)))
        monkeypatch.setattr(raw.bus, "_wanted", frozenset({0x190}))

        def away(*arguments: object) -> int:
            raise OSError(errno.ENXIO, os.strerror(errno.ENXIO))

        def not_there(interface: str) -> socket.socket:
            raise BusError(f"this machine has no CAN interface {interface!r}")

        def use(what: str) -> Frame | None:
            if what == "recv":
                return raw.bus.recv(0.0)
            raw.bus.send(0x2A0, b"\3")
            return None

        for name in ("_recv", "_send"):
            monkeypatch.setattr(raw.bus, name, away)
        monkeypatch.setattr(bus_module, "_opened", not_there)
        with pytest.raises(BusError, match="No such device or address"):
            use(first)
        for what in ("recv", "send", "recv"):
            with pytest.raises(BusError, match="has no CAN interface 'can0'"):
                use(what)
        ours, plugged = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with plugged:
            monkeypatch.setattr(bus_module, "_opened", lambda interface: ours)
            assert use(first) is None
            assert filters == [{0x190}]
            plugged.send(FRAME.pack(0x190, 1, b"\5"))
            assert raw.bus.recv(0.02) == (0x190, b"\5")
            raw.bus.send(0x2A1, b"\4")
            sent = [plugged.recv(16)[:2] for _ in range(2 if first == "send" else 1)]
            assert sent[-1] == b"\xa1\x02"


class Adapter:
    """Of python-can, with a state of its own."""

    def __init__(self) -> None:
        self.state = can.BusState.ACTIVE
        self.heard: list[can.Message] = []

    def recv(self, timeout: float | None) -> can.Message | None:
        return self.heard.pop(0) if self.heard else None

    def send(self, message: can.Message) -> None:
        raise can.CanOperationError("cannot")


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch) -> Adapter:
    adapter = Adapter()
    monkeypatch.setitem(bus_module.OPENED_BY, "adapter", lambda **arguments: adapter)
    return adapter


class TestLibraryBus:
    def test_the_state_is_the_adapters(self, adapter: Adapter) -> None:
        bus = LibraryBus("adapter:1", "adapter", "1")
        adapter.heard.append(can.Message(is_error_frame=True))
        assert (bus.recv(0.0), bus.state) == (None, ACTIVE)
        adapter.state = can.BusState.PASSIVE
        assert (bus.recv(0.0), bus.state) == (None, PASSIVE)
        with pytest.raises(BusError, match="cannot send"):
            bus.send(0x2A0, b"\3")

    @pytest.mark.parametrize("frames", [[], [can.Message(is_error_frame=True)]])
    def test_bus_off_is_said_and_what_to_do(self, adapter: Adapter, frames: list[can.Message]) -> None:
        bus = LibraryBus("adapter:1", "adapter", "1")
        adapter.state = can.BusState.ERROR
        adapter.heard += frames
        with pytest.raises(BusError, match=r"'adapter:1' is bus-off.*termination.*open it again"):
            bus.recv(0.0)
        with pytest.raises(BusError, match="is bus-off"):
            bus.send(0x2A0, b"\3")
