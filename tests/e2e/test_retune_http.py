"""Plant, controller and service as three processes on vcan0, driven through HTTP as an operator would."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from service.bus_loop import BusLoop
from service.demo import vcan_usable
from service.loop import LoopState
from service.processes import Process
from tuning.plan import Mode

pytestmark = [
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


class Plantsite:
    """The three processes of one case."""

    def __init__(self, stack: ExitStack, folder: Path, case: Case) -> None:
        self.case = case
        self._stack, self._folder = stack, folder
        ts = str(case.ts)
        gains = ("--kp", str(case.kp), "--ti", str(case.ti), "--sp", str(case.sp))
        self.controller = self.start("controller", "controller", "--bus", BUS, "--channels", "1", "--ts", ts, *gains)
        self.plant = self.start("plant", "plantsim", "--bus", BUS, "--model", case.model, "--ts", ts, "--speed", "max")
        self.serve()

    def start(self, name: str, *arguments: str) -> Process:
        process = Process(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        process.wait_ready()
        return process

    def serve(self) -> None:
        case = self.case
        low, high = case.pv_limits
        loop = {
            "tag": TAG, "bus": BUS, "controller_node": 0x20, "plant_node": 0x10, "pv_unit": "unit",
            "pv_limits": {"low": low, "high": high}, "t95_s": case.t95_s, "sp_deviation": case.sp_deviation,
        }  # fmt: skip
        loops = self._folder / "loops.yaml"
        loops.write_text(yaml.safe_dump({"loops": [loop]}))
        data = str(self._folder / "data")
        self.service = self.start("service", "service", "serve", "--loops", str(loops), "--data", data, "--port", "0")
        self.http = httpx.Client(base_url=self.service.ready.split()[1], timeout=30.0, trust_env=False)
        self._stack.callback(self.http.close)

    def retune(self, **options: Any) -> str:
        answer = self.http.post(f"/loops/{TAG}/retune", json=options)
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
            time.sleep(0.05)
        raise AssertionError(f"still {job}")

    def finished(self, url: str) -> dict[str, Any]:
        return self.until(url, lambda job: job["state"] not in ("queued", "running"))

    def state(self) -> LoopState:
        """Read from the controller itself, not through the service."""
        loop = BusLoop(BUS, 0x20, 0x10)
        try:
            return loop.read()
        finally:
            loop.close()

    def is_home(self) -> bool:
        state = self.state()
        return (
            state.mode is Mode.AUTOMATIC
            and not state.on_trial
            and state.sp == pytest.approx(self.case.sp)
            and state.gains.Kp == pytest.approx(self.case.kp)
            and state.gains.Ti == pytest.approx(self.case.ti)
        )


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Callable[[Case], Plantsite]]:
    with ExitStack() as stack:
        yield lambda case: Plantsite(stack, tmp_path, case)


@pytest.mark.parametrize("case", [MODEL_14, MODEL_41], ids=lambda case: case.model)
def test_a_live_loop_is_retuned_and_the_change_taken_back(site: Callable[[Case], Plantsite], case: Case) -> None:
    here = site(case)
    url = here.retune()
    job = here.finished(url)
    assert job["state"] == "proposed", (job["reason"], job["detail"])
    assert job["ultimate"]["Ku"] == pytest.approx(case.Ku, rel=0.015)
    assert job["ultimate"]["Pu_s"] == pytest.approx(case.Pu_s, rel=0.02)
    assert job["predicted"]["Ms"] <= 2.0
    assert job["old_gains"]["Kp"] == pytest.approx(case.kp) and job["restored"]["mode"] == "automatic"
    assert here.is_home()
    samples = here.http.get(f"{url}/samples?stage=verify").json()
    assert len(samples["t_s"]) > 100 and set(samples["stage"]) == {"verify"}
    accepted = here.http.post(f"{url}/accept").json()
    assert accepted["state"] == "accepted"
    assert here.state().gains.Kp == pytest.approx(job["new_gains"]["Kp"], rel=1e-6)
    assert here.http.post(f"{url}/rollback").json()["state"] == "rolled_back"
    assert here.is_home()


def test_busy_then_aborted_by_the_operator(site: Callable[[Case], Plantsite]) -> None:
    here = site(MODEL_14)
    url = here.retune()
    here.until(url, lambda job: job["stage"] == "baseline")
    busy = here.http.post(f"/loops/{TAG}/retune", json={})
    assert busy.status_code == 409 and busy.json()["job"] == url
    assert here.http.post(f"{url}/abort").status_code == 202
    job = here.finished(url)
    assert (job["state"], job["reason"]) == ("aborted", "operator")
    assert here.is_home()


def test_sigterm_in_mid_stage_restores_the_loop(site: Callable[[Case], Plantsite]) -> None:
    here = site(MODEL_14)
    url = here.retune()
    here.until(url, lambda job: job["stage"] == "relay")
    here.service.stop()
    assert here.is_home()
    here.serve()
    job = here.job(url)
    assert (job["state"], job["reason"]) == ("aborted", "service_stopped")


@pytest.mark.parametrize("stage", ["baseline", "relay", "ultimate"])
def test_kill_9_leaves_the_controller_to_itself(site: Callable[[Case], Plantsite], stage: str) -> None:
    here = site(MODEL_14)
    url = here.retune()
    here.until(url, lambda job: job["stage"] == stage)
    here.service.kill()
    deadline = time.monotonic() + 3.0
    while not here.is_home() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert here.is_home()
    here.serve()
    assert (here.job(url)["state"], here.job(url)["reason"]) == ("interrupted", "service_stopped")


def test_a_controller_that_dies_in_mid_stage(site: Callable[[Case], Plantsite]) -> None:
    here = site(MODEL_14)
    url = here.retune()
    here.until(url, lambda job: job["stage"] == "baseline")
    here.controller.kill()
    job = here.finished(url)
    assert job["state"] == "failed" and job["reason"] in ("node_lost", "samples_lost") and job["advice"]
