"""A hub, a plant, a controller and a service, each a process: what is heard of a loop, over HTTP."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import yaml

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.service.cli.child_process import ChildProcess
from tests.forked import ForkedProcess
from tests.unit.service.fakes import TAG, loop_entry
from tests.unit.service.processes import descendants, until


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
        process = ForkedProcess(name, arguments, self._folder / f"{name}.log")
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
