"""The real thing: a hub, a plant, a controller and a service, each a process, and the history over HTTP."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.tuner import Tuner
from tests.unit.service.heard_site import Site
from tests.unit.service.processes import gone, until

pytestmark = pytest.mark.timeout(600)  # processes that start slowly on a busy machine


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as stack:
        yield Site(stack, tmp_path)


def inner_gaps(found: dict[str, Any]) -> list[dict[str, float]]:
    """Those between samples."""
    return [gap for gap in found["gaps"] if gap["to_s"] > found["at_s"][0] and gap["to_s"] <= found["at_s"][-1]]


def covers(found: dict[str, Any], at_s: float) -> bool:
    return any(gap["from_s"] <= at_s <= gap["to_s"] for gap in found["gaps"])


def test_a_loop_is_heard_read_and_kept_over_deaths(site: Site) -> None:
    found = site.until(lambda found: len(found["at_s"]) > 20 and found["gains"][-1] is not None)
    assert found["no_data"] is None and found["gains"][0] is None, "what was not read yet is unknown"
    assert (found["sp"][-1], found["mode"][-1]) == (50.0, "automatic")
    assert found["gain_sets"][found["gains"][-1]] == {
        "form": "ISA", "Kp": 0.5, "Ti": 20.0, "Td": 0.0, "Tf": 0.0, "b": 1.0, "c": 0.0
    }  # fmt: skip
    assert len(site.history(points=5)["at_s"]) <= 5
    until(lambda: site.metric("loopwright_frames_received_total") > 40)
    assert site.metric("loopwright_listening_up") == 1

    # An operator's set-point comes by a status, the service's own reading is not needed.
    tuner = Tuner(site.bus, CONTROLLER_NODE, PLANT_NODE)
    tuner.write("controller_setpoint", 50.5)
    tuner.close()
    site.until(lambda found: found["sp"][-1] == 50.5)

    # The process dies: a gap, and another one listens.
    first, before_s = site.child(), site.history()["until_s"][-1]
    os.kill(first, signal.SIGKILL)
    found = site.until(lambda found: found["at_s"] and found["at_s"][-1] > before_s + 2.0)
    assert covers(found, before_s + 0.2) and site.child() not in (0, first)
    assert site.metric("loopwright_listener_restarts_total") == 1
    found = site.until(lambda found: found["sp"][-1] == 50.5 and found["gains"][-1] is not None)

    # The service ends and begins again: what was heard is still there, with a gap.
    child, last_s = site.child(), found["until_s"][-1]
    assert site.service.stop() == 0
    until(lambda: gone(child))
    site.serve()
    # until the new one has heard something: what the old one heard while it ended is later than last_s too
    found = site.until(lambda found: found["at_s"] and any(gap["from_s"] >= last_s - 0.2 for gap in inner_gaps(found)))
    assert found["at_s"][0] <= last_s, "what was heard before is there"
    site.until(lambda found: found["gains"][-1] is not None)

    # A service that is killed takes the process along.
    child = site.child()
    site.service.kill()
    until(lambda: gone(child))


def test_a_bus_that_goes_down_and_comes_back_is_a_gap(site: Site) -> None:
    site.until(lambda found: len(found["at_s"]) > 5)
    port = site.bus.rpartition(":")[2]
    site.hub.kill()
    found = site.until(lambda found: found["no_data"])
    assert "socketcand" in found["no_data"] and site.metric("loopwright_listening_up") == 0
    site.run("hub again", "loopwright.protocol.hub", "--port", port)
    site.until(lambda found: found["no_data"] is None)
    assert site.metric("loopwright_listener_restarts_total") == 0
