"""`loopwright check`: what is read of a configured loop, and what is said of one that does not answer as configured."""

from __future__ import annotations

import pytest

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, NmtCommand, node_name, sdo_request_id
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.loops.bus_check import LoopCheck, check_loop
from loopwright.tuning.plan import Mode
from tests.unit.service.bus_site import Site
from tests.unit.service.fakes import loop_entry


@pytest.fixture
def site() -> Site:
    site = Site()
    site.let_run()
    return site


def checked(site: Site, **changes: object) -> LoopCheck:
    entry = {"bus": "virtual:wire", "controller_node": CONTROLLER_NODE, "plant_node": PLANT_NODE, "channel": 1}
    return check_loop(LoopConfig.model_validate(loop_entry(**(entry | changes))), site.gateway)


def test_a_loop_that_answers_is_read_and_nothing_is_written(site: Site) -> None:
    found = checked(site)
    assert found.problem is None and found.state is not None
    assert (found.state.mode, found.state.sp, found.state.gains.Kp) == (Mode.AUTOMATIC, 50.0, 200.0)
    asked = {can_id for can_id, _ in site.gateway.sent}
    assert site.names() == [] and asked == {sdo_request_id(CONTROLLER_NODE), sdo_request_id(PLANT_NODE)}


def test_nodes_that_are_swapped_are_named(site: Site) -> None:
    found = checked(site, controller_node=PLANT_NODE, plant_node=CONTROLLER_NODE)
    assert found.state is None and found.problem is not None
    assert f"node {PLANT_NODE:02X}h ({PLANT_NODE}) is a plant, not a controller" in found.problem
    assert "seem to be swapped in loops.yaml" in found.problem


def test_a_channel_beyond_the_device_is_named(site: Site) -> None:
    found = checked(site, channel=7)
    assert found.problem is not None
    assert f"controller node {node_name(CONTROLLER_NODE)} has no channel 7" in found.problem
    assert "see the channel in loops.yaml" in found.problem


def test_a_node_that_is_not_there_is_named(site: Site) -> None:
    found = checked(site, controller_node=0x55)
    assert found.problem is not None and "node 55h (85) does not answer" in found.problem


def test_a_node_that_does_not_control_is_named(site: Site) -> None:
    site.nmt(NmtCommand.PRE_OPERATIONAL)
    found = checked(site)
    assert found.problem is not None and "is pre-operational" in found.problem
