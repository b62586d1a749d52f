"""Plant, controller and service as three processes on vcan0, for the tests that drive them through HTTP."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from protocol.tuner import Tuner
from service.bus_loop import BusLoop
from service.demo import vcan_usable
from service.loop import LoopState
from service.processes import Process
from tuning.plan import Mode

NEEDS_VCAN = [
    pytest.mark.skipif(
        not vcan_usable() and not os.environ.get("LOOPWRIGHT_REQUIRE_VCAN"), reason="there is no vcan0 here"
    ),
    pytest.mark.timeout(300),
]
BUS = "socketcan:vcan0"
TAG = "LOOP"


@dataclass(frozen=True)
class Case:
    """A loop on the bus. Ku in percent per PV unit, Pu in s: the exact values."""

    model: str
    ts: float
    kp: float
    ti: float
    sp: float
    pv_limits: tuple[float, float]
    t95_s: float
    sp_deviation: float
    Ku: float
    Pu_s: float


MODEL_14 = Case("model-14", 0.02, 80.0, 1.2, 50.0, (49.0, 51.0), 9.1, 0.1, 205.0, 3.32)
MODEL_41 = Case("model-41", 0.1, 20.0, 12.0, 50.0, (49.0, 51.0), 25.0, 0.1, 118.77, 17.719)
SOPDT = Case("sopdt", 0.1, 100.0, 12.0, 50.0, (49.0, 51.0), 37.8, 0.1, 787.57, 11.66)
REACTOR = Case("reactor", 0.25, 0.5, 30.0, 49.2838831323648137, (30.0, 70.0), 31.8, 1.0, 1.529, 42.5)


class Plantsite:
    """The three processes of one case. more_loops: further entries of loops.yaml, what they change of the first."""

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        case: Case,
        more_loops: tuple[dict[str, Any], ...] = (),
        bus: str = BUS,
    ) -> None:
        self.case, self.bus = case, bus
        self._stack, self._folder, self._more_loops = stack, folder, more_loops
        self.start_controller()
        self._service = self._launch_service()
        self.controller.wait_ready()
        model = ("--model", case.model, "--ts", str(case.ts), "--speed", "max")
        self.plant = self.launch("plant", "plantsim", "--bus", self.bus, *model)
        self.plant.wait_ready()
        self._connect()

    def start_controller(self) -> None:
        case = self.case
        gains = ("--kp", str(case.kp), "--ti", str(case.ti), "--sp", str(case.sp))
        kept = ("--keep", str(self._folder / "kept.json"))
        where = ("--bus", self.bus, "--ts", str(case.ts))
        self.controller = self.launch("controller", "controller", *where, *gains, *kept)

    def launch(self, name: str, *arguments: str) -> Process:
        """Starts a process and does not wait for it."""
        process = Process(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        return process

    def serve(self) -> None:
        """The service anew on the same data."""
        self._service = self._launch_service()
        self._connect()

    def _launch_service(self) -> Process:
        case = self.case
        low, high = case.pv_limits
        loop = {
            "tag": TAG, "bus": self.bus, "controller_node": 0x20, "plant_node": 0x10, "pv_unit": "unit",
            "pv_limits": {"low": low, "high": high}, "t95_s": case.t95_s, "sp_deviation": case.sp_deviation,
        }  # fmt: skip
        loops = self._folder / "loops.yaml"
        loops.write_text(yaml.safe_dump({"loops": [loop, *(loop | change for change in self._more_loops)]}))
        data = str(self._folder / "data")
        return self.launch("service", "service", "serve", "--loops", str(loops), "--data", data, "--port", "0")

    def _connect(self) -> None:
        self.service = self._service
        self.http = httpx.Client(base_url=self.service.wait_ready().split()[1], timeout=30.0, trust_env=False)
        self._stack.callback(self.http.close)

    def retune(self, tag: str = TAG, **options: Any) -> str:
        answer = self.http.post(f"/loops/{tag}/retune", json=options)
        assert answer.status_code == 202, answer.text
        return answer.headers["location"]

    def job(self, url: str) -> dict[str, Any]:
        job: dict[str, Any] = self.http.get(url).json()
        return job

    def until(self, url: str, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline:
            job = self.job(url)
            if wanted(job):
                return job
            assert job["state"] in ("queued", "running"), f"ended before: {job}"
            time.sleep(0.05)
        raise AssertionError(f"still {job}")

    def finished(self, url: str) -> dict[str, Any]:
        return self.until(url, lambda job: job["state"] not in ("queued", "running"))

    def state(self) -> LoopState:
        """Read from the controller itself, not through the service."""
        loop = BusLoop(self.bus, 0x20, 0x10)
        try:
            return loop.read()
        finally:
            loop.close()

    def read(self, name: str) -> float:
        tuner = Tuner(self.bus, 0x20, 0x10)
        try:
            return tuner.number(name)
        finally:
            tuner.close()

    def write(self, name: str, value: float) -> None:
        """By SDO, as somebody else on the bus would."""
        tuner = Tuner(self.bus, 0x20, 0x10)
        try:
            tuner.write(name, value)
        finally:
            tuner.close()

    def is_home(self, sp: float | None = None) -> bool:
        """On its accepted gains, in automatic, at its set-point."""
        state = self.state()
        return (
            state.mode is Mode.AUTOMATIC
            and not state.on_trial
            and state.sp == pytest.approx(self.case.sp if sp is None else sp)
            and state.gains.Kp == pytest.approx(self.case.kp)
            and state.gains.Ti == pytest.approx(self.case.ti)
        )
