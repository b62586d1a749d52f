"""`loopwright probe`: the nodes of a bus, and two devices that share a node-ID."""

from __future__ import annotations

import pytest

from loopwright.controller.channel import Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.protocol.bus import BusError
from loopwright.protocol.objects import Device
from loopwright.protocol.profile import CONTROLLER_NODE, HEARTBEAT_FRAME, PLANT_NODE, NmtState, heartbeat_id
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
