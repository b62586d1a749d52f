"""`loopwright probe`: the nodes of a bus, and two devices that share a node-ID."""

from __future__ import annotations

from collections.abc import Collection

import pytest

from loopwright.controller.channel import Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.protocol.bus import BusError, Frame
from loopwright.protocol.objects import Device
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    HEARTBEAT_FRAME,
    PLANT_NODE,
    NmtState,
    heartbeat_id,
    sdo_response_id,
)
from loopwright.protocol.station import Station
from loopwright.service.loops.bus_probe import FoundNode, probe
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.bus_site import FOUND, Site


@pytest.fixture
def site() -> Site:
    site = Site(channels=3)
    site.let_run()
    return site


def test_both_devices_are_found_and_nothing_is_written(site: Site) -> None:
    plant, controller = probe("wire", site.gateway)
    assert controller == FoundNode(CONTROLLER_NODE, "operational", Device.CONTROLLER, 3, 0.1)
    assert plant == FoundNode(PLANT_NODE, "operational", Device.PLANT, 3, 0.1)
    assert site.names() == []


def test_a_device_that_is_busy_for_a_second_is_waited_for(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    pump, ran = site.pump, [0.0]

    def now_and_then() -> None:
        if site.wire.clock.now >= ran[-1] + 1.0:
            ran.append(site.wire.clock.now)
            pump()

    monkeypatch.setattr(site, "pump", now_and_then)
    plant, controller = probe("wire", site.gateway)
    assert controller == FoundNode(CONTROLLER_NODE, "operational", Device.CONTROLLER, 3, 0.1)
    assert plant == FoundNode(PLANT_NODE, "operational", Device.PLANT, 3, 0.1)
    assert len(ran) > 8, "they had to be waited for"


class AnsweringBus:
    """A bus on which each request is answered by these frames, so many seconds after it."""

    def __init__(self, answers: list[tuple[float, bytes]]) -> None:
        self._answers, self._coming, self.now = answers, list[tuple[float, bytes]](), 0.0

    def send(self, can_id: int, data: bytes) -> None:
        self._coming = [(self.now + after_s, answer) for after_s, answer in self._answers]

    def recv(self, timeout: float | None) -> Frame | None:
        until = self.now + (timeout or 0.0)
        self.now = min([until, *(at for at, _ in self._coming)])
        if self._coming and self._coming[0][0] <= self.now:
            return sdo_response_id(0x33), self._coming.pop(0)[1]
        return None

    def set_filters(self, ids: Collection[int] | None) -> None:
        """Nothing else is on this bus."""

    def close(self) -> None:
        """Nothing is open."""


# what a node answers of its device type: a value, an abort, and to another master a write and a read in blocks
VALUE, ABORT, WRITTEN, IN_BLOCKS = (bytes([first, 0, 0x10, 0, 2, 0, 0, 0]) for first in (0x43, 0x80, 0x60, 0xC6))
UNKNOWN = "its device type is 00000002h, which is none of the profile"


@pytest.mark.parametrize(
    ("answers", "problems"),
    [
        ([(0.1, WRITTEN), (1.0, VALUE)], [UNKNOWN]),
        ([(0.1, IN_BLOCKS), (1.0, VALUE)], [UNKNOWN]),
        ([(1.9, VALUE), (2.1, VALUE)], ["2 devices answer: give each a node-ID of its own", UNKNOWN]),
        ([(0.1, VALUE), (0.5, VALUE)], [UNKNOWN]),  # later than that it may be the answer to another master
        ([(0.1, ABORT)], ["it answers no SDO"]),
        ([(0.1, VALUE[:7])], ["it answers no SDO"]),
    ],
)
def test_the_answers_to_a_request_are_told_from_others(answers: list[tuple[float, bytes]], problems: list[str]) -> None:
    bus = AnsweringBus(answers)
    station = Station(monotonic=lambda: bus.now, open_bus=lambda url: bus)
    assert probe("wire", station, [0x33]) == [FoundNode(0x33, None, problems=tuple(problems))]


def test_a_node_without_sdo_and_one_that_is_asked_for(site: Site) -> None:
    others = site.wire.open()
    site.gateway.before = lambda call: others.send(heartbeat_id(0x7D), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
    found = {each.node: each for each in probe("wire", site.gateway, [0x33])}
    assert found[0x7D] == FoundNode(0x7D, "operational", problems=("it answers no SDO",))
    assert found[0x33] == FoundNode(0x33, None, problems=("it answers no SDO",))


def test_two_devices_with_one_node_id_are_found(site: Site) -> None:
    laws = [ControllerChannel(FOUND, 50.0, Settings(pv_low=40.0, pv_high=60.0))]
    second = ControllerDevice(site.wire.open(), laws, 0.1, clock=site.wire.clock)
    second.start()
    site.gateway.before = lambda call: any(not second.runtime.poll(0.0) for _ in range(100))
    found = {each.node: each for each in probe("wire", site.gateway)}
    assert found[CONTROLLER_NODE].problems == ("2 devices answer: give each a node-ID of its own",)
    assert not found[PLANT_NODE].problems


def test_a_bus_that_is_not_there(site: Site) -> None:
    site.lost = BusError("this machine has no CAN interface 'can7'; there are: vcan0")
    with pytest.raises(Failed, match="there are: vcan0") as caught:
        probe("wire", site.gateway)
    assert caught.value.reason is Reason.BUS_LOST
