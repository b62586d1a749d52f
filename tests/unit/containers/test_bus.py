"""The bus container's process: what it says where no vcan is to be had, and the door to the service behind it."""

from __future__ import annotations

import asyncio
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import AsyncMock, Mock

import pytest

from loopwright.containers import bus, keeper
from loopwright.protocol.bus import open_bus
from tests.ports import free_port

# The kernel's answers to the first netlink message, wherever the test runs.
RUN = """
import os, sys
from loopwright.containers import bus, keeper, vcan
from loopwright.protocol.hub import Hub
keeper.ADDRESS = ("127.0.0.1", int(sys.argv[1]))
bus.DOOR, bus.SERVICE = int(sys.argv[2]), int(sys.argv[3])
bus.Hub = lambda: Hub(0)
def answer(*_):
    raise OSError(int(sys.argv[4]), os.strerror(int(sys.argv[4])))
vcan._ask = answer
sys.exit(bus.main(sys.argv[5:]))
"""
NO_MODULE, NO_RIGHT = 95, 1  # EOPNOTSUPP, EPERM


def start(answer: int, kind: str, ports: tuple[int, int, int] = (1, 1, 1)) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", RUN, *map(str, ports), str(answer), "--kind", kind]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@contextmanager
def running(answer: int, kind: str, ports: tuple[int, int, int]) -> Iterator[list[str]]:
    """The lines it says until it is ready."""
    process = start(answer, kind, ports)
    assert process.stdout is not None
    said: list[str] = []
    try:
        for line in process.stdout:
            said.append(line.strip())
            if line.startswith("ready "):
                break
        yield said
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=120)
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("answer", "kind", "words"),
    [(NO_MODULE, "auto", "modprobe vcan"), (NO_RIGHT, "auto", "NET_ADMIN"), (NO_MODULE, "hub", None)],
)
def test_without_vcan_it_is_the_hub_and_says_why_in_one_line(answer: int, kind: str, words: str | None) -> None:
    ports = (free_port(), free_port(), free_port())
    with running(answer, kind, ports) as said:
        url = said[-1].removeprefix("ready ")
        assert url.startswith("socketcand:127.0.0.1:")
        if words is None:
            assert len(said) == 1
        else:
            assert len(said) == 2 and words in said[0] and said[0].endswith("the loopback hub is used instead")
        told, connection = keeper.join(0.0, ("127.0.0.1", ports[0]))
        connection.close()
        assert told == url
        open_bus(url).close()


@pytest.mark.parametrize(("answer", "words"), [(NO_MODULE, "modprobe vcan"), (NO_RIGHT, "NET_ADMIN")])
def test_where_nothing_but_vcan_will_do_it_ends_with_that_line(answer: int, words: str) -> None:
    process = start(answer, "vcan")
    output, errors = process.communicate(timeout=120)
    assert (process.returncode, output) == (1, "")
    assert len(errors.splitlines()) == 1 and words in errors and "hub" not in errors


def test_the_door_leads_to_the_service_once_there_is_one() -> None:
    with socket.socket() as service:
        service.bind(("127.0.0.1", 0))  # ours from now on, and nobody answers there yet
        ports = (free_port(), free_port(), int(service.getsockname()[1]))
        with running(NO_MODULE, "hub", ports):
            with socket.create_connection(("127.0.0.1", ports[1]), timeout=120) as early:
                assert early.recv(1) == b""
            service.listen()

            def serve() -> None:
                inner, _ = service.accept()
                with inner:
                    inner.sendall(inner.recv(100).upper())

            serving = threading.Thread(target=serve)
            serving.start()
            with socket.create_connection(("127.0.0.1", ports[1]), timeout=120) as caller:
                caller.sendall(b"get")
                assert caller.recv(100) == b"GET"
                assert caller.recv(1) == b""  # the service has hung up
            serving.join()


@pytest.mark.parametrize("error", [TimeoutError(110, "timed out"), OSError(113, "no route"), ConnectionResetError()])
def test_a_caller_that_vanishes_leaves_no_connection_to_the_service(error: OSError) -> None:
    caller, inner = Mock(), Mock()
    caller.read = AsyncMock(side_effect=error)
    asyncio.run(bus.copy(caller, inner))
    inner.close.assert_called_once_with()
