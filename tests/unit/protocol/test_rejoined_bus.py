"""A hub that goes away and comes back: who was on it is on it again, and waits for nothing meanwhile."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from loopwright.protocol.bus import Bus, BusError, Frame, open_bus
from loopwright.protocol.hub import Hub
from loopwright.protocol.profile import CONTROLLER_NODE, heartbeat_id
from loopwright.protocol.rejoined_bus import RejoinedBus, open_device_bus

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
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def until_lost(bus: Bus) -> str:
    with pytest.raises(BusError) as caught:
        while True:
            bus.recv(0.05)
    return str(caught.value)


def again(action: Callable[[], Frame | None]) -> Frame | None:
    """Repeats what is refused while the bus is away."""
    give_up = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up:
        try:
            if (frame := action()) is not None:
                return frame
        except BusError:
            time.sleep(0.01)
    return None


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

        def heard() -> Frame | None:
            other.send(0x191, b"no")
            other.send(0x190, b"yes")
            return bus.recv(0.05)

        assert again(heard) == (0x190, b"yes")
        bus.send(0x2A0, b"back")
        assert other.recv(PATIENCE_S) == (0x2A0, b"back")
        other.close()
        bus.close()


def test_while_a_hub_is_away_it_is_said_why_and_nothing_is_waited_for(port: int) -> None:
    with ExitStack() as first:
        first.enter_context(serving(port))
        bus = open_device_bus(f"socketcand:127.0.0.1:{port}")
        first.close()
    until_lost(bus)
    with socket.create_server(("127.0.0.1", port)):  # the kernel accepts for it, and nobody answers
        began = time.monotonic()
        for _ in range(20):
            with pytest.raises(BusError):
                bus.recv(1.0)
            with pytest.raises(BusError):
                bus.send(0x190, b"")
        assert time.monotonic() - began < 1.0
    give_up = time.monotonic() + PATIENCE_S
    while "cannot be opened" not in until_lost(bus) and time.monotonic() < give_up:
        time.sleep(0.01)
    bus.close()


def test_what_is_found_after_the_end_is_closed_too() -> None:
    asked, go_on, closed = threading.Event(), threading.Event(), threading.Event()

    class Found:
        def recv(self, timeout: float | None) -> Frame | None:
            raise BusError("it is gone")

        def close(self) -> None:
            if go_on.is_set():
                closed.set()

    def find(url: str) -> Found:
        if threading.current_thread() is not threading.main_thread():
            asked.set()
            assert go_on.wait(PATIENCE_S)
        return Found()

    bus = RejoinedBus("socketcand:127.0.0.1:1", find)  # type: ignore[arg-type]
    until_lost(bus)
    assert asked.wait(PATIENCE_S)
    bus.close()
    go_on.set()
    assert closed.wait(PATIENCE_S)


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
