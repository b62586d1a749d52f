"""The hub, joined by python-can's own client of the protocol it speaks."""

from __future__ import annotations

import errno
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing

import can
import pytest

from loopwright.protocol.bus import BusError, open_bus
from loopwright.protocol.hub import Hub
from tests.unit.protocol.socketcand_server import greet, reset_at_close


@pytest.fixture
def hub() -> Iterator[Hub]:
    hub = Hub(port=0)
    thread = threading.Thread(target=hub.serve)
    thread.start()
    yield hub
    hub.stop()
    thread.join(60)
    assert not thread.is_alive()


@pytest.fixture
def members(hub: Hub) -> Iterator[list[can.BusABC]]:
    found = [can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=hub.port) for _ in range(3)]
    yield found
    for member in found:
        member.shutdown()


def frame(number: int) -> can.Message:
    return can.Message(arbitration_id=0x190, data=number.to_bytes(8, "little"), is_extended_id=False)


def test_a_frame_reaches_all_others_and_not_its_sender(members: list[can.BusABC]) -> None:
    members[0].send(frame(7))
    for other in members[1:]:
        got = other.recv(60)
        assert got is not None
        assert (got.arbitration_id, got.data, got.is_extended_id) == (0x190, bytearray([7, 0, 0, 0, 0, 0, 0, 0]), False)
    assert members[0].recv(0.05) is None


@pytest.mark.parametrize("data", [b"", b"\x00", b"\xff" * 8])
@pytest.mark.parametrize(("can_id", "extended"), [(0, False), (0x7FF, False), (0x1FFFFFFF, True)])
def test_every_kind_of_frame_passes(members: list[can.BusABC], data: bytes, can_id: int, extended: bool) -> None:
    members[0].send(can.Message(arbitration_id=can_id, data=data, is_extended_id=extended))
    got = members[1].recv(60)
    assert got is not None
    assert (got.arbitration_id, bytes(got.data), got.is_extended_id) == (can_id, data, extended)


def test_nothing_is_lost_and_the_order_stays_when_a_member_reads_late(members: list[can.BusABC]) -> None:
    for number in range(3000):
        members[0].send(frame(number))
    numbers = []
    for _ in range(3000):
        got = members[1].recv(60)
        assert got is not None
        numbers.append(int.from_bytes(got.data, "little"))
    assert numbers == list(range(3000))


def test_joining_while_the_bus_is_busy_succeeds(hub: Hub, members: list[can.BusABC]) -> None:
    done = threading.Event()

    def chatter() -> None:
        while not done.wait(0.0005):
            members[0].send(frame(1))

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        for _ in range(5):
            late = can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=hub.port)
            assert late.recv(60) is not None
            late.shutdown()
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("rubbish", [b"< send 190 9 1 >", b"< send >", b"> > <", b"x" * 500, b"< send zzz 1 1 >"])
def test_rubbish_harms_nobody_else(hub: Hub, members: list[can.BusABC], rubbish: bytes) -> None:
    with socket.create_connection(("127.0.0.1", hub.port)) as bad:
        bad.sendall(b"< open vcan0 >< rawmode >" + rubbish)
        members[0].send(frame(5))
        got = members[1].recv(60)
        assert got is not None
        assert got.data[0] == 5


@pytest.mark.parametrize(
    "odd",
    [
        b"FFF 1 1", b"800 1 1", b"-12 1 1", b"+12 1 1", b"1_2 1 1", b"20000000 1 1", b"-1234567 1 1", b"0x1 1 1",
        b"12 1 1", b"190 1 -1", b"190 1 100", b"190 1 +1", b"190 1 0x1", b"190 1 1_1", b"190 +1 1", b"190 2 1",
        b"190 0x1 1", b"190 9 0 0 0 0 0 0 0 0 0",
    ],
)  # fmt: skip
def test_what_is_no_can_frame_is_refused_and_passed_on_to_nobody(hub: Hub, odd: bytes) -> None:
    with closing(open_bus(hub.url)) as other, socket.create_connection(("127.0.0.1", hub.port), 60) as bad:
        bad.sendall(b"< open vcan0 >< rawmode >< send " + odd + b" >< send 1aB 2 F 0a >")
        assert other.recv(60.0) == (0x1AB, b"\x0f\x0a")
        received = b""
        while b"malformed" not in received:
            part = bad.recv(200)
            assert part
            received += part


class FullListener:
    """Has no file descriptor left for `times` of those that want to join."""

    def __init__(self, listener: socket.socket, times: int) -> None:
        self.listener = listener
        self.times = times
        self.asked = 0

    def accept(self) -> tuple[socket.socket, object]:
        self.asked += 1
        if self.asked <= self.times:
            raise OSError(errno.EMFILE, "Too many open files")
        return self.listener.accept()

    def __getattr__(self, name: str) -> object:
        return getattr(self.listener, name)


def test_a_hub_without_room_says_so_once_and_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("loopwright.protocol.hub._ROOM_AGAIN_S", 0.2)
    hub = Hub(port=0)
    full = FullListener(vars(hub)["_listener"], 0)
    monkeypatch.setattr(hub, "_listener", full)
    thread = threading.Thread(target=hub.serve)
    thread.start()
    try:
        with closing(open_bus(hub.url)) as first, closing(open_bus(hub.url)) as second:
            full.asked, full.times = 0, 3
            with closing(socket.create_connection(("127.0.0.1", hub.port), 60)) as third:
                first.send(0x190, b"on")
                assert second.recv(60.0) == (0x190, b"on")
                assert third.recv(60) == b"< hi >"
            assert full.asked == 4, "it does not ask all the time"
    finally:
        hub.stop()
        thread.join(60)
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "nobody else can join: Too many open files; end some of its" in errors


def test_only_this_machine_can_reach_it(hub: Hub) -> None:
    assert hub.address == "127.0.0.1"


def test_as_a_process_it_says_where_it_is_and_stops_when_asked() -> None:
    command = [sys.executable, "-m", "loopwright.protocol.hub", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as hub:
        assert hub.stdout is not None
        assert hub.stdout.readline().startswith("ready socketcand:127.0.0.1:")
        hub.send_signal(signal.SIGTERM)
        assert hub.wait(120) == 0


def test_frames_right_behind_the_greeting_are_frames() -> None:
    """A server that waits for nobody: on a busy machine the hub's pause is over before a new member has read."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            listener.accept()[0].close()  # who asks first whether somebody is there
            with listener.accept()[0] as member:
                member.sendall(b"< hi >")
                member.recv(100)
                member.sendall(b"< ok >")
                member.recv(100)
                member.sendall(b"< ok >< frame 190 1.0 0102 >")
                member.recv(100)

        thread = threading.Thread(target=serve)
        thread.start()
        bus = open_bus(f"socketcand:127.0.0.1:{listener.getsockname()[1]}")
        assert bus.recv(60) == (0x190, b"\x01\x02")
        bus.close()
        thread.join(60)


def test_a_server_that_says_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.protocol.bus._GREETED_S", 0.2)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,  # the kernel accepts for it
        pytest.raises(BusError, match="cannot be opened: timed out"),
    ):
        open_bus(f"socketcand:127.0.0.1:{listener.getsockname()[1]}")


def test_a_hub_that_is_gone_is_an_error_and_no_silent_bus() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:

        def serve() -> None:
            server.accept()[0].close()  # the probe
            connection, _ = server.accept()
            with connection:
                greet(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        with closing(open_bus(f"socketcand:127.0.0.1:{server.getsockname()[1]}")) as bus:
            bus.set_filters({1})
            with pytest.raises(BusError, match="closed the connection"):
                bus.recv(60.0)
        thread.join(60)


@pytest.mark.parametrize(
    ("last", "said"),
    [
        (b"", "the connection is lost: .*reset by peer"),
        (b"< frame zzz 1.0 00 >", "the server has sent what is no frame: .*'zzz'"),
        (b"< error malformed frame >", "the server has sent what is no frame: .*'malformed'"),
        (b"\xff\xff", "the server has sent what is no frame: .*0xff"),
    ],
)
def test_what_is_wrong_with_a_server_is_said_in_one_line(
    last: bytes, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    opened = threading.Event()
    with closing(socket.create_server(("127.0.0.1", 0))) as server:

        def serve() -> None:
            server.accept()[0].close()  # the probe
            connection, _ = server.accept()
            with connection:
                greet(connection)
                assert opened.wait(60)
                connection.sendall(last)
                reset_at_close(connection)
                if last:
                    connection.recv(64)  # until the client has gone

        thread = threading.Thread(target=serve)
        thread.start()
        with closing(open_bus(f"socketcand:127.0.0.1:{server.getsockname()[1]}")) as bus:
            opened.set()
            with pytest.raises(BusError, match=said) as caught:
                bus.recv(60.0)
        thread.join(60)
    assert "\n" not in str(caught.value)
    assert not caplog.records
