"""The real thing: a hub, a plant, a controller and a service, each a process, and the history over HTTP."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.tuner import Tuner
from loopwright.service.cli.child_process import ChildProcess
from tests.unit.service.fakes import TAG, loop_entry
from tests.unit.service.processes import descendants, gone, until

pytestmark = pytest.mark.timeout(600)  # processes that start slowly on a busy machine


class Site:
    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, self._folder = stack, folder
        self.hub = self.run("hub", "loopwright.protocol.hub", "--port", "0")
        self.bus = self.hub.wait_ready().split()[1]
        common = ("--bus", self.bus, "--ts", "0.1")
        self.run("controller", "loopwright.controller", *common, "--kp", "0.5", "--ti", "20", "--sp", "50")
        self.plant = self.run("plant", "loopwright.plantsim", *common, "--model", "model-1", "--speed", "1")
        loop = loop_entry() | {"bus": self.bus, "controller_node": CONTROLLER_NODE, "plant_node": PLANT_NODE}
        (folder / "loops.yaml").write_text(yaml.safe_dump({"loops": [loop]}))
        self.serve()

    def run(self, name: str, *arguments: str) -> ChildProcess:
        process = ChildProcess(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        process.wait_ready(180)
        return process

    def serve(self) -> None:
        where = ("--loops", str(self._folder / "loops.yaml"), "--data", str(self._folder / "data"), "--port", "0")
        self.service = self.run("service", "loopwright.service", "serve", *where)
        self.http = httpx.Client(base_url=self.service.ready.split()[1], timeout=60.0, trust_env=False)
        self._stack.callback(self.http.close)

    def history(self, **query: Any) -> dict[str, Any]:
        answer = self.http.get(f"/loops/{TAG}/history", params={"points": 5000, **query})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def until(self, wanted: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def there() -> object:
            found.update(self.history())
            return wanted(found)

        until(there)
        return found

    def metric(self, name: str) -> float:
        lines = self.http.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))

    def child(self) -> int:
        """The process that listens."""
        ours = [pid for pid in descendants(self.service.pid) if "listening.child" in _command(pid)]
        return ours[0] if ours else 0


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


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
    assert found["not_heard"] is None and found["gains"][0] is None, "what was not read yet is unknown"
    assert (found["sp"][-1], found["mode"][-1]) == (50.0, "automatic")
    assert found["gain_sets"][found["gains"][-1]] == {
        "form": "ISA", "Kp": 0.5, "Ti": 20.0, "Td": 0.0, "Tf": 0.0, "b": 1.0, "c": 0.0
    }  # fmt: skip
    assert len(site.history(points=5)["at_s"]) <= 5
    until(lambda: site.metric("loopwright_frames_heard_total") > 40)
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
    found = site.until(lambda found: found["at_s"] and found["at_s"][-1] > last_s + 1.0)
    assert found["at_s"][0] <= last_s, "what was heard before is there"
    assert any(gap["from_s"] >= last_s - 0.2 for gap in inner_gaps(found))
    site.until(lambda found: found["gains"][-1] is not None)

    # A service that is killed takes the process along.
    child = site.child()
    site.service.kill()
    until(lambda: gone(child))


def test_a_bus_that_goes_down_and_comes_back_is_a_gap(site: Site) -> None:
    site.until(lambda found: len(found["at_s"]) > 5)
    port = site.bus.rpartition(":")[2]
    site.hub.kill()
    found = site.until(lambda found: found["not_heard"])
    assert "socketcand" in found["not_heard"] and site.metric("loopwright_listening_up") == 0
    site.run("hub again", "loopwright.protocol.hub", "--port", port)
    site.until(lambda found: found["not_heard"] is None)
    assert site.metric("loopwright_listener_restarts_total") == 0
