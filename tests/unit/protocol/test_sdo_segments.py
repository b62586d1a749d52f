"""A value in segments from a device that is foreign or broken: it is taken whole or not at all."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from itertools import cycle

import pytest

from loopwright.protocol.bus import Frame
from loopwright.protocol.bus_state import BusState
from loopwright.protocol.objects import lookup
from loopwright.protocol.profile import Abort, sdo_request_id, sdo_response_id
from loopwright.protocol.sdo_segments import LONGEST
from loopwright.protocol.station import Station
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError
from tests.unit.protocol.memory_bus import Clock

NODE = 0x20
NAME, TYPE = (lookup(name).index.to_bytes(2, "little") + b"\0" for name in ("device_name", "device_type"))
FIRST, SECOND, LAST = b"\x00Loopwri", b"\x10ght con", b"\x01troller"
TEXT = "Loopwright controller"


def begun(size: int | None, address: bytes = NAME) -> bytes:
    return bytes((0x40 if size is None else 0x41,)) + address + (size or 0).to_bytes(4, "little")


def aborted(code: int, address: bytes = NAME) -> bytes:
    return b"\x80" + address + code.to_bytes(4, "little")


class Device:
    """Answers each request with the next of these frames; a request that it has none for is not answered."""

    state = BusState.ACTIVE

    def __init__(self, clock: Clock, frames: Iterator[bytes | tuple[bytes, ...]]) -> None:
        self.clock = clock
        self.frames = frames
        self.sent: list[bytes] = []
        self.incoming: deque[Frame] = deque()

    def send(self, can_id: int, data: bytes) -> None:
        assert can_id == sdo_request_id(NODE)
        self.sent.append(data)
        if data[0] == 0x80:
            return
        answers = next(self.frames, ())
        for answer in (answers,) if isinstance(answers, bytes) else answers:
            self.incoming.append((sdo_response_id(NODE), answer.ljust(8, b"\0")))

    def recv(self, timeout: float | None) -> Frame | None:
        if self.incoming:
            self.clock.now += 0.001
            return self.incoming.popleft()
        self.clock.now += timeout or 0.0
        return None

    def set_filters(self, ids: Collection[int]) -> None: ...

    def fileno(self) -> int:
        return -1

    def close(self) -> None: ...


@pytest.fixture
def clock() -> Clock:
    return Clock()


def reading(clock: Clock, *frames: bytes | tuple[bytes, ...], then: Iterable[bytes] = ()) -> tuple[Tuner, Device]:
    def answers() -> Iterator[bytes | tuple[bytes, ...]]:
        yield from frames
        yield from then

    device = Device(clock, answers())
    station = Station(listen_s=0.0, monotonic=clock, open_bus=lambda url: device)
    return Tuner("one", NODE, None, station=station), device


@pytest.mark.parametrize(
    "frames",
    [
        (begun(21), FIRST, SECOND, LAST),
        (begun(None), FIRST, SECOND, LAST),
        (begun(21), (begun(21), FIRST), SECOND, LAST),  # the beginning was asked for twice
        (begun(21), FIRST, SECOND, b"\x04troll", b"\x1ber"),
    ],
)
def test_what_fits_together_is_the_value(clock: Clock, frames: tuple[bytes, ...]) -> None:
    tuner, _ = reading(clock, *frames)
    assert tuner.read("device_name") == TEXT


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        ((begun(21), SECOND), Abort.TOGGLE),
        ((begun(21), FIRST, FIRST), Abort.TOGGLE),
        ((begun(22), FIRST, SECOND, LAST), Abort.LENGTH),
        ((begun(20), FIRST, SECOND, LAST), Abort.LENGTH),
        ((begun(7), FIRST, SECOND, LAST), Abort.LENGTH),
        ((begun(0), FIRST, SECOND, LAST), Abort.LENGTH),
        ((begun(21), b"\x0e"), Abort.LENGTH),
        ((begun(LONGEST + 1), FIRST, SECOND, LAST), Abort.OUT_OF_MEMORY),
        ((begun(0xFFFFFFFF), FIRST), Abort.OUT_OF_MEMORY),
        ((begun(21), FIRST, begun(21), SECOND, LAST), Abort.COMMAND),  # another client reads the same
        ((begun(21), begun(16, TYPE), b"\x01another"), Abort.COMMAND),
        ((begun(21), b"\x60"), Abort.COMMAND),
        ((begun(21), b"\x20"), Abort.COMMAND),
        ((begun(21), b"\xe0"), Abort.COMMAND),
    ],
)
def test_what_does_not_is_refused_and_aborted(clock: Clock, frames: tuple[bytes, ...], code: Abort) -> None:
    tuner, device = reading(clock, *frames)
    with pytest.raises(TunerError, match=r"device_name: the segments of node 20h \(32\) do not make a value") as caught:
        tuner.read("device_name")
    assert (caught.value.kind, caught.value.code) == (FailureKind.ABORT, code)
    assert device.sent[-1] == aborted(code)


@pytest.mark.parametrize(
    "frames",
    [
        (begun(8, TYPE), b"\x03\1\2\3\4"),
        (begun(3, TYPE), b"\x09\1\2\3"),
        (begun(None, TYPE), b"\x09\1\2\3"),
        (begun(None, TYPE), b"\x05\1\2\3\4\5"),
        (begun(4, TYPE), b"\x09\1\2\3"),
    ],
)
def test_a_number_of_another_length_is_no_number(clock: Clock, frames: tuple[bytes, ...]) -> None:
    tuner, _ = reading(clock, *frames)
    with pytest.raises(TunerError, match="device_type") as caught:
        tuner.number("device_type")
    assert caught.value.code == Abort.LENGTH


def test_a_number_in_segments_is_a_number(clock: Clock) -> None:
    tuner, _ = reading(clock, begun(4, TYPE), b"\x07\1\2\0\0")
    assert tuner.number("device_type") == 0x201


def test_an_abort_in_the_middle_is_the_devices(clock: Clock) -> None:
    tuner, device = reading(clock, begun(21), FIRST, aborted(Abort.GENERAL))
    with pytest.raises(TunerError, match="general error") as caught:
        tuner.read("device_name")
    assert caught.value.code == Abort.GENERAL
    assert device.sent[-1][0] != 0x80


@pytest.mark.parametrize("frames", [(begun(21),), (begun(21), FIRST), (begun(None), FIRST, SECOND)])
def test_a_device_that_stops_is_a_time_out(clock: Clock, frames: tuple[bytes, ...]) -> None:
    tuner, _ = reading(clock, *frames)
    with pytest.raises(TunerError, match="stopped in the middle") as caught:
        tuner.read("device_name")
    assert caught.value.kind is FailureKind.TIMEOUT


@pytest.mark.parametrize("size", [None, 21, LONGEST])
def test_a_value_without_an_end_ends(clock: Clock, size: int | None) -> None:
    tuner, device = reading(clock, begun(size), then=cycle((FIRST, SECOND)))
    with pytest.raises(TunerError) as caught:
        tuner.read("device_name")
    assert caught.value.code == Abort.LENGTH
    assert len(device.sent) <= 2 + LONGEST // 7 + 1


def test_a_device_that_takes_its_time_with_each_segment_is_given_up(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    tuner, device = reading(clock, begun(LONGEST), then=cycle((b"\x0cL", b"\x1co")))
    send, began = device.send, clock.now

    def late(can_id: int, data: bytes) -> None:
        clock.now += 0.2
        send(can_id, data)

    monkeypatch.setattr(device, "send", late)
    with pytest.raises(TunerError) as caught:
        tuner.read("device_name")
    assert caught.value.kind is FailureKind.TIMEOUT
    assert clock.now - began < 35.0
