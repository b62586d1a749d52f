"""A hub that goes away and comes back: who was on it is on it again, and waits for nothing meanwhile."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress

import pytest

from loopwright.protocol.bus import Bus, BusError, Frame, open_bus
from loopwright.protocol.bus_state import BusState
from loopwright.protocol.hub import Hub
from loopwright.protocol.profile import CONTROLLER_NODE, heartbeat_id
from loopwright.protocol.rejoined_bus import RejoinedBus, open_device_bus
from tests.ports import free_port
from tests.unit.service.processes import until

PATIENCE_S = 60.0


@contextmanager
def serving(port: int) -> Iterator[Hub]:
    hub = Hub(port)
    thread = threading.Thread(target=hub.serve)
    thread.start()
    try:
        yield hub
    finally:
        hub.stop()
        thread.join(PATIENCE_S)


@pytest.fixture
def port() -> int:
    return free_port()


def until_lost(bus: Bus) -> str:
    with pytest.raises(BusError) as caught:
        while True:
            bus.recv(0.05)
    return str(caught.value)


def test_a_hub_that_is_started_again_is_joined_again_with_the_same_filters(port: int) -> None:
    url = f"socketcand:127.0.0.1:{port}"
    with ExitStack() as first:
        first.enter_context(serving(port))
        bus = open_device_bus(url)
        bus.set_filters({0x190})
        first.close()
    assert "closed the connection" in until_lost(bus)
    with serving(port):
        other = open_bus(url)

        heard: list[Frame] = []

        def is_heard() -> bool:
            other.send(0x191, b"no")
            other.send(0x190, b"yes")
            with suppress(BusError):  # while the bus is away
                heard.extend(frame for frame in [bus.recv(0.05)] if frame is not None)
            return bool(heard)

        until(is_heard, "the frame")
        assert heard == [(0x190, b"yes")]
        bus.send(0x2A0, b"back")
        assert other.recv(PATIENCE_S) == (0x2A0, b"back")
        other.close()
        bus.close()


def test_while_a_hub_is_away_it_is_said_why(port: int) -> None:
    with ExitStack() as first:
        first.enter_context(serving(port))
        bus = open_device_bus(f"socketcand:127.0.0.1:{port}")
        first.close()
    until(lambda: "cannot be opened" in until_lost(bus), "the reason")
    bus.close()


class LostBus:
    """A bus that was there and is gone."""

    state = BusState.ACTIVE

    def __init__(self) -> None:
        self.closed = threading.Event()

    def send(self, can_id: int, data: bytes) -> None:
        raise BusError("it is gone")

    def recv(self, timeout: float | None) -> Frame | None:
        raise BusError("it is gone")

    def set_filters(self, ids: Collection[int]) -> None: ...

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed.set()


def test_a_server_that_hangs_is_waited_for_by_nobody_and_left_when_it_is_there_after_the_end() -> None:
    asked, go_on = threading.Event(), threading.Event()
    buses: list[LostBus] = []

    def find(url: str) -> Bus:
        if buses:
            asked.set()
            assert go_on.wait(PATIENCE_S)
        buses.append(LostBus())
        return buses[-1]

    bus = RejoinedBus("socketcand:127.0.0.1:1", find)
    until_lost(bus)
    assert asked.wait(PATIENCE_S)
    for use in (lambda: bus.recv(None), lambda: bus.send(0x190, b"")):
        with pytest.raises(BusError, match="it is gone"):
            use()
    assert len(buses) == 1, "the server hangs as yet"
    bus.close()
    go_on.set()
    until(lambda: len(buses) == 2, "the server")
    assert buses[1].closed.wait(PATIENCE_S)


def test_a_controller_is_on_the_hub_again_and_says_once_why_it_was_not(port: int) -> None:
    url = f"socketcand:127.0.0.1:{port}"
    with ExitStack() as first:
        first.enter_context(serving(port))
        command = [sys.executable, "-m", "loopwright.controller", "--bus", url]
        controller = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert controller.stdout is not None and controller.stdout.readline().startswith("ready controller")
            first.close()
            with serving(port):
                bus = open_bus(url)
                bus.set_filters({heartbeat_id(CONTROLLER_NODE)})
                heard = bus.recv(PATIENCE_S)
                bus.close()
        finally:
            controller.terminate()
            _, errors = controller.communicate(timeout=PATIENCE_S)
    assert heard == (heartbeat_id(CONTROLLER_NODE), b"\x05")
    assert controller.returncode == 0
    assert re.match(r"node 20h \(32\): cannot receive on .* the server has closed the connection", errors)
    assert len(errors.splitlines()) <= 3
