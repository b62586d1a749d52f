"""The live stream of a real site: samples as they come, a plant that stops, a bus that goes, a service that stops."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.tuner import Tuner
from loopwright.service.listening.heard_loop import SILENCE_S
from tests.unit.service.fakes import TAG
from tests.unit.service.heard_site import Site
from tests.unit.service.live_viewer import viewing

pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as stack:
        yield Site(stack, tmp_path)


def test_samples_come_once_and_what_stops_is_no_longer_shown(site: Site) -> None:
    base = str(site.http.base_url)
    site.until(lambda found: len(found["at_s"]) > 20)
    with viewing(base, f"/live?loops={TAG}&back_s=60") as viewer:
        past = viewer.until("samples")
        assert past["past"] and len(past["n"]) > 20
        numbers, times, gaps = list(past["n"]), list(past["at_s"]), list(past["gap_before"])
        while len(numbers) < len(past["n"]) + 30:
            new = viewer.until("samples")
            assert not new["past"]
            gaps += [len(numbers) + at for at in new["gap_before"]]
            numbers += new["n"]
            times += new["at_s"]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "each once, in order"
        assert times == sorted(times)
        stood_still = [at for at in range(1, len(times)) if times[at] - times[at - 1] > SILENCE_S]
        assert gaps == [0, *stood_still], "no gap but where a busy machine let the plant stand still"

        row = viewer.row(TAG, lambda row: row["mode"])
        assert (row["mode"], row["sp"], row["no_data"], row["on_trial"]) == ("automatic", 50.0, None, False)
        assert row["age_s"] < 3.0 and row["pv"] is not None and row["mv"] is not None
        buses = [message for name, message in viewer.messages if name == "buses"]
        assert buses[-1] == {"buses": [{"gateway": "local", "bus": site.bus, "up": True, "why": None}]}

        tuner = Tuner(site.bus, CONTROLLER_NODE, PLANT_NODE)
        tuner.write("controller_setpoint", 50.5)
        tuner.close()
        assert viewer.until("samples", lambda new: new["sp"][-1] == 50.5)

        viewer.becomes("alarms", lambda message: message.get("alarms") == [])
        site.plant.stop()
        row = viewer.row(TAG, lambda row: row["pv"] is None)
        assert row["sp"] is row["mv"] is row["mode"] is None and row["age_s"] > 3.0
        assert row["no_data"].startswith("no data for ")
        viewer.becomes("alarms", lambda message: [each["kind"] for each in message.get("alarms", [])] == ["node_lost"])
        (alarm,) = site.http.get("/alarms").json()
        assert (alarm["priority"], alarm["subject"], alarm["loops"]) == (2, f"node 10h on {site.bus}", [TAG])
        assert site.metric('loopwright_alarms{priority="2"}') == 1.0

        site.hub.stop()
        down = viewer.until("buses", lambda message: message["buses"][0]["up"] is False)
        assert down["buses"][0]["why"]
        row = viewer.row(TAG, lambda row: site.bus in row["no_data"])
        assert row["pv"] is None
        viewer.becomes("alarms", lambda message: [each["kind"] for each in message.get("alarms", [])] == ["bus_down"])
        assert site.service.stop() == 0
        viewer.rest()
