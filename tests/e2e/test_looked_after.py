"""A third node stops the controller in the middle of a test: the service says so until somebody starts it again.

On the loopback hub, so that it runs where there is no vcan0 too.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import NMT_FRAME, NMT_ID, NmtCommand
from tests.e2e.plantsite import MODEL_14, STAGES, TAG, Plantsite
from tests.forked import ForkedProcess

pytestmark = pytest.mark.timeout(300)
CONTROLLER = 0x20


@pytest.fixture
def here(tmp_path: Path) -> Iterator[Plantsite]:
    with ExitStack() as stack:
        hub = ForkedProcess("hub", ("loopwright.protocol.hub", "--port", "0"), tmp_path / "hub.log")
        stack.callback(hub.stop)
        site = Plantsite(stack, tmp_path, MODEL_14, hub.wait_ready().split()[1])
        site.at_rest(5.0)
        yield site


def nmt(here: Plantsite, command: NmtCommand) -> None:
    with closing(open_bus(here.bus)) as bus:
        bus.send(NMT_ID, NMT_FRAME.pack(command, CONTROLLER))


def test_a_controller_stopped_by_another_is_looked_after_until_it_is_started(here: Plantsite) -> None:
    url = here.in_stage(STAGES["fast-relay"])
    nmt(here, NmtCommand.PRE_OPERATIONAL)
    job = here.finished(url)
    assert (job["state"], job["reason"], job["restored"]) == ("failed", "node_not_operational", None)
    shown = here.http.get(f"/loops/{TAG}").json()
    assert shown["live"]["node_state"] == "node 20h (32) is pre-operational"
    assert (shown["restore_unconfirmed"]["job"], shown["restore_unconfirmed"]["reason"]) == (
        url,
        "node_not_operational",
    )
    ready = here.http.get("/readyz")
    detail = ready.json()["parts"][f"loop {TAG}"]["detail"]
    assert ready.status_code == 503 and "node 20h (32) is pre-operational" in detail and "start it (NMT)" in detail

    nmt(here, NmtCommand.START)
    until = time.monotonic() + 60
    while here.http.get(f"/loops/{TAG}").json()["restore_unconfirmed"] and time.monotonic() < until:
        time.sleep(0.2)
    assert here.is_home() and here.job(url)["restored"]["mode"] == "automatic"
    assert here.job(url)["state"] == "failed"
    time.sleep(2.1)  # an answer of /readyz is given again for so long
    assert here.http.get("/readyz").status_code == 200
