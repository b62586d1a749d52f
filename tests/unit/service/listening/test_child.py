"""The process that listens, in this one: buses that come and go, what is handed over, and nothing that is sent."""

from __future__ import annotations

import math
import threading
from collections.abc import Collection
from queue import Empty, SimpleQueue

import pytest

from loopwright.protocol.bus import BusError, Frame
from loopwright.protocol.bus_state import BusState
from loopwright.protocol.profile import MV_FRAME, PV_FRAME, STATUS_FRAME, Mode, NmtState, channel_ids
from loopwright.service.listening import child as module
from loopwright.service.listening.bins import unpacked
from loopwright.service.listening.child import BLOCK_S, Child, Clock
from loopwright.service.listening.heard_loop import InEffect
from loopwright.service.listening.messages import HistoryAnswer, Learn, Query
from tests.unit.service.processes import until

IDS = {"A": channel_ids(1), "B": channel_ids(2)}
URL = "socketcan:can9"


class Frames:
    """A bus whose frames the test puts. None ends it as an interface that goes down does."""

    state = BusState.ACTIVE

    def __init__(self) -> None:
        self.queue: SimpleQueue[Frame | None] = SimpleQueue()
        self.wanted: Collection[int] = ()
        self.closed = False

    def send(self, can_id: int, data: bytes) -> None:
        raise AssertionError("a listener sends nothing")

    def recv(self, timeout: float | None) -> Frame | None:
        try:
            frame = self.queue.get(timeout=timeout)
        except Empty:
            return None
        if frame is None:
            raise BusError("the interface is down")
        return frame

    def set_filters(self, ids: Collection[int]) -> None:
        self.wanted = set(ids)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed = True

    def sample(self, tag: str, n: int, pv: float = 50.0) -> None:
        self.queue.put((IDS[tag].pv, PV_FRAME.pack(pv, n)))
        self.queue.put((IDS[tag].mv, MV_FRAME.pack(40.0, n)))


class Time:
    def __init__(self) -> None:
        self.wall, self.monotonic = 1_769_860_800.0, 50.0

    def pass_by(self, seconds: float) -> None:
        self.wall += seconds
        self.monotonic += seconds


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def clock(time: Time) -> Clock:
    return Clock(lambda: time.wall, lambda: time.monotonic)


def answer(child: Child, time: Time, tag: str = "A", points: int = 100) -> HistoryAnswer:
    return child.answer(Query(1, tag, time.wall - 3000.0, time.wall, points))


def samples(child: Child, time: Time, tag: str = "A") -> list[int]:
    return answer(child, time, tag).rows.bins["n"].tolist()


def test_a_bus_is_filtered_reopened_and_never_sent_on(
    clock: Clock, time: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AGAIN_S", 0.01)
    buses: list[Frames] = []
    away = threading.Event()

    def open_bus(url: str) -> Frames:
        if away.is_set():
            raise BusError("no such interface")
        buses.append(Frames())
        return buses[-1]

    child = Child({URL: IDS}, clock, open_bus)
    child.start()
    until(lambda: not child.report().down)
    first = buses[0]
    assert first.wanted == {each for ids in IDS.values() for each in (ids.pv, ids.mv, ids.status)}
    for n in (1, 2):
        first.sample("A", n)
    first.queue.put((IDS["A"].mv, b"foreign"))
    first.queue.put((0x7FF, b"of before the filter"))
    until(lambda: samples(child, time) == [1, 2])
    away.set()
    first.queue.put(None)
    until(lambda: child.report().down == {URL: "no such interface"})
    assert first.closed
    away.clear()
    until(lambda: not child.report().down)
    time.pass_by(0.2)
    buses[-1].sample("A", 3)
    until(lambda: samples(child, time) == [1, 2, 3])
    assert len(answer(child, time, points=5000).rows.gaps) == 1 + 1, "before the first sample, and the bus away"
    assert samples(child, time, "B") == [] and answer(child, time, "B").oldest_s == math.inf


@pytest.fixture
def child(clock: Clock) -> Child:
    """One that is handed frames by the test."""
    return Child({URL: IDS}, clock, lambda url: Frames())


def take(child: Child, tag: str, n: int) -> None:
    bus = child.buses[URL]
    bus.take(IDS[tag].pv, PV_FRAME.pack(50.0, n))
    bus.take(IDS[tag].mv, MV_FRAME.pack(40.0, n))


def test_loops_that_are_heard_and_not_read_are_named(child: Child, time: Time) -> None:
    assert child.report().to_read == []
    take(child, "A", 1)
    assert child.report().to_read == ["A"]
    began_s = time.wall + 0.05
    time.pass_by(0.1)
    child.learn(Learn("A", InEffect(began_s, 50.0, Mode.AUTOMATIC, False, (1.0,) * 6, 0.1)))
    take(child, "B", 1)
    report = child.report()
    assert report.to_read == ["B"] and report.frames == {URL: 2}


def test_a_reading_from_before_a_change_is_dropped_whatever_the_clocks_say(child: Child, time: Time) -> None:
    """The wall clock is slewed away from the clock of the samples by less than a jump."""
    take(child, "A", 1)
    time.wall += 0.09
    began_s = time.wall
    time.pass_by(0.05)
    child.buses[URL].take(IDS["A"].status, STATUS_FRAME.pack(Mode.AUTOMATIC, 0, 50.0, 0, 0))
    time.pass_by(0.01)
    child.learn(Learn("A", InEffect(began_s, 50.0, Mode.AUTOMATIC, False, (1.0,) * 6, 0.1)))
    assert child.report().to_read == ["A"]


def test_bins_are_handed_over_once_in_blocks_that_follow_each_other(child: Child, time: Time) -> None:
    blocks = []
    for n in range(1, 1501):
        take(child, "A", n)
        time.pass_by(0.1)
        if n % 10 == 0:
            blocks += child.report().blocks
    blocks += child.report(finished=True).blocks
    assert 3 <= len(blocks) <= 4
    assert sum(unpacked(block.data, block.count).bins["count"].sum() for block in blocks) == 1500
    assert [block.after_s for block in blocks] == [None, *(block.last_s for block in blocks[:-1])]
    assert all(block.last_s - block.first_s < BLOCK_S + 5.0 for block in blocks)


def test_plant_io_that_feeds_two_controllers_is_heard_for_both(clock: Clock, time: Time) -> None:
    ids = {"A": channel_ids(1, 0x10, 0x20), "B": channel_ids(1, 0x10, 0x21)}
    child = Child({URL: ids}, clock, lambda url: Frames())
    bus = child.buses[URL]
    bus.take(ids["A"].pv, PV_FRAME.pack(50.0, 1))
    for tag in ids:
        bus.take(ids[tag].mv, MV_FRAME.pack(40.0, 1))
    assert samples(child, time, "A") == samples(child, time, "B") == [1]


def test_a_clock_that_is_put_forward_is_followed_and_one_that_is_put_back_begins_anew(child: Child, time: Time) -> None:
    for n in (1, 2):
        take(child, "A", n)
        time.pass_by(0.1)
    child.report()
    time.wall += 3600.0
    child.report()
    take(child, "A", 3)
    found = child.answer(Query(1, "A", time.wall - 7200.0, time.wall, 100)).rows
    assert found.bins["n"].tolist() == [1, 2, 3] and len(found.gaps) == 2
    time.wall -= 7200.0
    child.report()
    take(child, "A", 4)
    assert samples(child, time) == [4]


def test_heartbeats_of_the_nodes_are_heard_beside_the_process_data(clock: Clock, time: Time) -> None:
    bus = Frames()
    child = Child({URL: IDS}, clock, lambda url: bus, {URL: (16, 32)})
    child.start()
    until(lambda: not child.report().down)
    process_data = {each for ids in IDS.values() for each in (ids.pv, ids.mv, ids.status)}
    assert bus.wanted == process_data | {0x710, 0x720}
    bus.queue.put((0x720, bytes([127])))
    until(lambda: (URL, 32) in child.report().nodes)
    bus.queue.put((0x720, b"foreign"))
    time.pass_by(0.5)
    bus.queue.put((0x720, bytes([5])))
    until(lambda: child.report().nodes[URL, 32].state is NmtState.OPERATIONAL)
    report = child.report()
    assert set(report.nodes) == {(URL, 32)} and not report.nodes[URL, 32].silent
    assert child.buses[URL].new_frames() == 0, "heartbeats are no process data"
    time.pass_by(2.1)
    assert child.report().nodes[URL, 32].silent
    time.wall -= 3600.0
    assert not child.report().nodes, "a clock that was put back makes no age"
