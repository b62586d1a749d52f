"""What the page is looked at with: a hub, a plant, a controller and a service, and a loop with bad gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tests.e2e.plantsite import MODEL_14, Plantsite
from tests.forked import ForkedProcess
from tests.ports import free_port

CASE = MODEL_14
TAG = "TIC-101"
"""Of the loop that has its plant and its controller."""
LOOP = MappingProxyType({"tag": TAG, "description": "Jacket of reactor 1", "area": "Reactor", "pv_unit": "degC"})
ABSENT = MappingProxyType(
    {"tag": "FIC-205", "description": "Feed to column 2", "area": "Column", "pv_unit": "m3/h", "controller_node": 0x55}
)
"""An entry of loops.yaml that no controller answers for."""


class Site(Plantsite):
    """A hub of its own, and a service that comes back at the same port, as one does whose page is open.

    The plant runs as fast as it can until somebody calls at_rest(pace).  bus: of a hub that the test runs itself; None:
    a process of its own, `hub`.
    """

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        more_loops: tuple[Mapping[str, Any], ...] = (ABSENT,),
        served_with: Sequence[str] = (),
        changes: Mapping[str, Any] = LOOP,
        bus: str | None = None,
    ) -> None:
        if bus is None:
            hub_port = free_port()
            self._hub_options = ("loopwright.protocol.hub", "--port", str(hub_port))
            self.hub = ForkedProcess("hub", self._hub_options, folder / "hub.log")
            stack.callback(self.hub.stop)
            bus = self.hub.wait_ready().split()[1]
        port = ("--port", str(free_port()))
        more = tuple(dict(each) for each in more_loops)
        super().__init__(stack, folder, CASE, bus, more, served_with=(*port, *served_with), changes=changes)

    def start_hub(self) -> None:
        """The hub anew, at the address that it had, and the devices, which end with their bus."""
        self.hub = self.launch("hub", *self._hub_options)
        self.hub.wait_ready()
        for old in (self.controller, self.plant):
            old.kill()
        self.start_controller()
        self.controller.wait_ready()
        self.start_plant()
        self.plant.wait_ready()

    def ask(self, path: str) -> Any:
        """An answer of the API."""
        answer = self.http.get(path)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def latest(self) -> dict[str, Any]:
        """The latest job."""
        job: dict[str, Any] = self.ask("/jobs?limit=1")[0]
        return job
