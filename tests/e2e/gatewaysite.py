"""Two services over one PostgreSQL database: one has a loop on the hub, the other one watches and decides it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from loopwright.protocol.profile import FOREVER
from loopwright.protocol.tuner import Tuner
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.plan import Mode
from tests.e2e.plantsite import MODEL_14
from tests.forked import ForkedProcess
from tests.unit.service.postgres import Server, binaries
from tests.unit.service.processes import until

WATCHING, OTHER = "gw-1", "gw-2"
UNREACHED, LOOP = "TIC-1", "TIC-2"
CASE = MODEL_14


@contextmanager
def database_server() -> Iterator[Server]:
    """A private server. Skips where there is none to start, but not where the tests must be complete."""
    found = binaries()
    if found is None:
        assert not os.environ.get("CI"), "the tests need the package postgresql"
        pytest.skip("no PostgreSQL server is installed")
    server = Server(found)
    try:
        yield server
    finally:
        server.close()


def patiently(condition: Callable[[], object]) -> None:
    """Waits, and leaves the processor to the services that are asked."""
    until(lambda: condition() or time.sleep(0.2))


class GatewaySite:
    """Plant and controller of one loop, the other's loop has no node on the bus. answered_s: time of the last POST."""

    def __init__(self, stack: ExitStack, folder: Path, database: Server) -> None:
        self._stack, self._folder, self._database = stack, folder, database.database()
        self.bus = self._run("hub", "loopwright.protocol.hub", "--port", "0").wait_ready().split()[1]
        own = ("--kp", str(CASE.kp), "--ti", str(CASE.ti), "--sp", str(CASE.sp), "--ts", str(CASE.ts))
        self._run("controller", "loopwright.controller", "--bus", self.bus, *own).wait_ready()
        model = ("--model", CASE.model, "--ts", str(CASE.ts), "--speed", "4")
        self._run("plant", "loopwright.plantsim", "--bus", self.bus, *model).wait_ready()
        self.answered_s = 0.0
        self.watching = self.serve(WATCHING, UNREACHED, 0x30, "0x7C")
        self.start_other()

    def start_other(self) -> None:
        self.other = self.serve(OTHER, LOOP, 0x20, "0x7D", "--own-url", "https://gw-2.example")
        self.other.wait_ready(180)  # its loop is in the database

    def _run(self, name: str, *arguments: str) -> ChildProcess:
        process = ForkedProcess(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        return process

    def serve(self, host: str, tag: str, controller: int, node: str, *more: str) -> ChildProcess:
        low, high = CASE.pv_limits
        loop = {
            "tag": tag, "bus": self.bus, "controller_node": controller, "plant_node": controller - 0x10,
            "pv_unit": "degC", "pv_limits": {"low": low, "high": high}, "t95_s": CASE.t95_s,
            "sp_deviation": CASE.sp_deviation,
        }  # fmt: skip
        loops = self._folder / f"{host}.yaml"
        loops.write_text(yaml.safe_dump({"loops": [loop]}))
        where = ("--loops", str(loops), "--data", str(self._folder / host), "--port", "0", "--node", node)
        shared = ("--database", self._database, "--gateway", host)
        return self._run(host, "loopwright.service", "serve", *where, *shared, *more)

    @property
    def url(self) -> str:
        """The gateway that is asked: it does not reach the loop."""
        return str(self.watching.wait_ready(180).split()[1])

    def get(self, path: str) -> Any:
        answer = httpx.get(f"{self.url}{path}", timeout=30.0, trust_env=False)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def post(self, path: str, **body: Any) -> httpx.Response:
        began_s = time.monotonic()
        answer = httpx.post(f"{self.url}{path}", json=body, timeout=30.0, trust_env=False)
        self.answered_s = time.monotonic() - began_s
        return answer

    def live(self) -> Any:
        """The loop as the other gateway has it, once it is known."""
        patiently(lambda: self.get(f"/loops/{LOOP}")["live"])
        return self.get(f"/loops/{LOOP}")["live"]

    def kp(self) -> float:
        """Read from the controller itself, through no service."""
        loop = BusLoop(self.bus, 0x20, 0x10)
        try:
            return loop.read().gains.Kp
        finally:
            loop.close()

    def at_rest(self) -> None:
        tuner = Tuner(self.bus, 0x20, 0x10)
        try:
            for name, value in (
                ("controller_mode_command", Mode.AUTOMATIC),
                ("controller_setpoint", CASE.sp),
                ("plant_pace", 0.0),
                ("plant_samples_to_run", FOREVER),
            ):
                tuner.write(name, value)
            patiently(lambda: abs(self.live()["pv"] - CASE.sp) < 2e-4)
            tuner.write("plant_pace", 4.0)
        finally:
            tuner.close()

    def retune(self) -> str:
        self.at_rest()
        answer = self.post(f"/loops/{LOOP}/retune", by="A. Lind")
        assert answer.status_code == 202, answer.text
        return str(answer.headers["location"])

    def proposal(self) -> str:
        """A job whose proposal nobody has decided yet: the one that a test has left, or a new one."""
        latest = self.get(f"/loops/{LOOP}")["last_job"]
        if latest is not None and latest["state"] == "proposed":
            return str(latest["url"])
        job = self.retune()
        patiently(lambda: self.get(job)["state"] not in ("queued", "running"))
        assert self.get(job)["state"] == "proposed", self.get(job)
        return job
