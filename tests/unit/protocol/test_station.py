"""This process as a node: its node-ID, its heartbeat, and that nobody else has either."""

from __future__ import annotations

from itertools import pairwise

import pytest

from loopwright.protocol.bus import Frame
from loopwright.protocol.patience import WAIT_S
from loopwright.protocol.profile import HEARTBEAT_FRAME, TUNER_NODE, NmtState, heartbeat_id
from loopwright.protocol.station import HEARTBEAT_S, LISTEN_S, NodeTaken, Station
from tests.unit.protocol.memory_bus import MemoryBus, Wire

BEAT = HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL)


class Others(Wire):
    """A bus on which other nodes beat while somebody waits."""

    def __init__(self, *nodes: int, every_s: float = 0.1) -> None:
        super().__init__()
        self.node_ids, self._every_s, self.next_at = [heartbeat_id(node) for node in nodes], every_s, self.clock.now
        self._other = self.open()

    def pass_time(self) -> None:
        if self.clock.now >= self.next_at:
            self.next_at = self.clock.now + self._every_s
            for each in self.node_ids:
                self._other.send(each, BEAT)


class WaitingBus(MemoryBus):
    def __init__(self, wire: Others) -> None:
        super().__init__(wire)
        self.wire = wire

    def recv(self, timeout: float | None) -> Frame | None:
        self.wire.pass_time()
        return super().recv(timeout)


def station_on(wire: Wire, node: int = TUNER_NODE) -> Station:
    def open_bus(url: str) -> MemoryBus:
        bus = WaitingBus(wire) if isinstance(wire, Others) else MemoryBus(wire)
        wire.join(bus)
        return bus

    def sleep(seconds: float) -> None:
        wire.clock.now += seconds

    return Station(node, monotonic=wire.clock, sleep=sleep, open_bus=open_bus)


def test_a_node_id_that_beats_already_is_refused_and_named() -> None:
    station = station_on(Others(TUNER_NODE))
    with pytest.raises(NodeTaken, match=r"'wire' has node-ID 7Dh.*--node"):
        station.join("wire")


def test_one_that_beats_seldom_is_heard_too() -> None:
    wire = Others(TUNER_NODE, every_s=1.9)
    wire.clock.now += 0.1
    wire.next_at = wire.clock.now + 1.9
    with pytest.raises(NodeTaken):
        station_on(wire).join("wire")


@pytest.mark.parametrize("others", [(), (TUNER_NODE - 1, 0x10, 0x20)], ids=["nobody", "other nodes"])
def test_a_free_one_is_listened_for_two_seconds_before_the_first_beat(others: tuple[int, ...]) -> None:
    wire = Others(*others)
    began = wire.clock.now
    station_on(wire).join("wire")
    assert wire.clock.now - began == pytest.approx(LISTEN_S, abs=0.06)
    assert wire.sent(heartbeat_id(TUNER_NODE)) == []


def test_frames_from_before_the_filter_are_no_heartbeat() -> None:
    """A bus that is busy has brought some by the time it is told which ones are wanted."""
    wire = Wire()
    station = station_on(wire)
    open_bus = station.open_bus

    def busy(url: str) -> MemoryBus:
        bus = open_bus(url)
        assert isinstance(bus, MemoryBus)
        for can_id in (0x190, 0x2A0, heartbeat_id(0x20)):
            bus.take((can_id, b"\x05"))
        return bus

    station.open_bus = busy
    station.join("wire")


def test_who_has_beaten_lately_does_not_listen_again() -> None:
    """Its own loops' beats would be heard."""
    wire = Wire()
    station = station_on(wire)
    station.join("wire")
    bus, joined = station.open_bus("wire"), wire.clock.now
    for _ in range(30):
        station.beat_if_due("wire", bus)
        wire.clock.now += 0.11
        before = wire.clock.now
        station.join("wire")
        assert wire.clock.now == before
    assert wire.clock.now > joined + LISTEN_S


def test_who_has_not_beaten_for_long_listens_again() -> None:
    wire = Others()
    station = station_on(wire)
    station.join("wire")
    wire.node_ids = [heartbeat_id(TUNER_NODE)]
    wire.clock.now += 10.0
    with pytest.raises(NodeTaken):
        station.join("wire")


def test_a_beat_of_the_own_process_is_no_other_node() -> None:
    """A loop that was held up for long beats again while another one of the process listens."""

    class Late(Others):
        def pass_time(self) -> None:
            if self.clock.now > began + 1.0:
                station.beat_if_due("wire", ours)

    wire = Late()
    station, began = station_on(wire), wire.clock.now
    ours = station.open_bus("wire")
    station.join("wire")
    assert len(wire.sent(heartbeat_id(TUNER_NODE))) == 1


def test_each_bus_has_its_own_beat() -> None:
    wire = Wire()
    station = station_on(wire)
    bus = wire.open()
    for url in ("one", "two", "one"):
        station.beat_if_due(url, bus)
    assert len(wire.sent(heartbeat_id(TUNER_NODE))) == 2
    wire.clock.now += 1.1 * HEARTBEAT_S
    station.beat_if_due("one", bus)
    assert len(wire.sent(heartbeat_id(TUNER_NODE))) == 3


@pytest.mark.parametrize("every_s", [0.02, 0.033, WAIT_S, 0.06, 0.099, 0.1, 0.5])
def test_no_heartbeat_waits_for_the_next_sample(every_s: float) -> None:
    """A loop looks at its clock when a sample has come, or after the longest wait on the bus."""
    wire = Wire()
    station, bus = station_on(wire), wire.open()
    beaten_at = []
    sample_at = wire.clock.now + every_s
    for _ in range(200):
        station.beat_if_due("wire", bus)
        if len(wire.frames) > len(beaten_at):
            beaten_at.append(wire.clock.now)
        wire.clock.now = min(sample_at, wire.clock.now + WAIT_S)
        if wire.clock.now == sample_at:
            sample_at += every_s
    gaps = [later - earlier for earlier, later in pairwise(beaten_at)]
    assert min(gaps) + 1e-9 >= HEARTBEAT_S - WAIT_S and max(gaps) <= HEARTBEAT_S + 1e-9


def test_a_station_beats_with_its_own_node_id() -> None:
    wire = Wire()
    station_on(wire, 0x55).beat_if_due("wire", wire.open())
    assert wire.frames == [(heartbeat_id(0x55), BEAT)]


def test_turns_and_plants_are_of_the_bus_and_the_node() -> None:
    station = Station()
    assert station.sdo_lock("a", 1) is station.sdo_lock("a", 1)
    assert station.sdo_lock("a", 1) is not station.sdo_lock("a", 2)
    assert station.plant_lock("a", 1) is station.plant_lock("a", 1)
    assert station.plant_lock("a", 1) is not station.plant_lock("b", 1)
