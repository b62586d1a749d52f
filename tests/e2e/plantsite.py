"""Plant, controller and service as three processes on one bus, for the tests that drive them through HTTP."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import httpx
import pytest
import yaml

from loopwright.protocol.bus import BusError
from loopwright.protocol.profile import FOREVER
from loopwright.protocol.tuner import Tuner, TunerError
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.plan import Mode
from tests.forked import ForkedProcess
from tests.pulse_phases import Phase, PulseWatch

VCAN = "socketcan:vcan0"
HUB, ON_VCAN = "hub", pytest.param("vcan", marks=pytest.mark.vcan)
"""The parameters of the fixture `bus`."""
TAG = "LOOP"


@dataclass(frozen=True)
class Case:
    """A loop on the bus. Ku in percent per PV unit, Pu in s: the exact values of the plant without its sampling.

    An ultimate period has some seventy samples, each of which takes the processes of the loop a few ms.
    """

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


MODEL_14 = Case("model-14", 0.05, 80.0, 1.2, 50.0, (49.0, 51.0), 9.1, 0.1, 205.0, 3.32)
MODEL_41 = Case("model-41", 0.3, 20.0, 12.0, 50.0, (49.0, 51.0), 25.0, 0.1, 118.77, 17.719)
SOPDT = Case("sopdt", 0.2, 100.0, 12.0, 50.0, (49.0, 51.0), 37.8, 0.1, 787.57, 11.66)
REACTOR = Case("reactor", 0.25, 0.5, 30.0, 49.2838831323648137, (30.0, 70.0), 31.8, 1.0, 1.529, 42.5)


@dataclass(frozen=True)
class Stage:
    """How to come to a stage soon. pace: of the plant, where the stage is too short for the usual one (as a factor).
    untouched: in this stage the loop is held, but as it was.  phase: of a pulse of the manual output, of a loop that is
    found in manual; None for a loop that is found in automatic."""

    stage: str
    options: dict[str, Any]
    pace: float = 1.0
    untouched: bool = False
    phase: Phase | None = None

    @property
    def in_manual(self) -> bool:
        return self.phase is not None


_FIVE: dict[str, Any] = {"method": "five-stage"}
_SOON = {**_FIVE, "baseline": False}
_TO_VERIFY = {**_SOON, "start": "optimise", "model": {"K": 0.02, "T_s": 2.0, "L_s": 1.0}}
_PULSES: dict[str, Any] = {"method": "setpoint"}
STAGES = {
    "preflight": Stage("preflight", _TO_VERIFY, 0.3, untouched=True),
    "baseline": Stage("baseline", _FIVE),
    "relay": Stage("relay", _SOON),
    "ultimate": Stage("ultimate", _SOON),
    "zn_pi": Stage("zn_pi", {**_SOON, "start": "zn_pi", "Ku": 205.0, "Pu_s": 3.32}),
    "verify": Stage("verify", _TO_VERIFY),
    "fast-preflight": Stage("preflight", {}, 0.3, untouched=True),
    "fast-relay": Stage("relay", {}),
    "fast-verify": Stage("verify", {}),
    "setpoint-preflight": Stage("preflight", _PULSES, 0.3, untouched=True),
    "setpoint-pulses": Stage("pulses", _PULSES),
    "setpoint-verify": Stage("verify", _PULSES, 0.4),
    **{f"manual-{phase.value}": Stage("manual", {}, 0.15, phase=phase) for phase in Phase},
}
"""Of model 14. Those of a loop in manual need a site of which `MANUAL_PERMITTED` permits them."""
MANUAL_PERMITTED: Mapping[str, object] = MappingProxyType({"test": {"excitations": ["relay", "manual"]}})
LEFT_ALONE_PACE = 0.1
RESTED = 0.25
"""Part of an ultimate period after a pulse of the manual output from which on PV is left to itself."""


class Plantsite:
    """The three processes of one case.

    more_loops: further entries of loops.yaml, what they change of the first.  launcher: a module that starts the
    service.  served_with: more options of the service.  speed: of the plant as it starts; one that starts at "max"
    makes way for others on its processor.  on_answer: told of each answer.  changes: of the entry of the first loop.
    """

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        case: Case,
        bus: str,
        more_loops: tuple[dict[str, Any], ...] = (),
        launcher: Sequence[str] = (),
        served_with: Sequence[str] = (),
        speed: str = "max",
        on_answer: Callable[[httpx.Response], None] = lambda answer: None,
        changes: Mapping[str, object] = MappingProxyType({}),
    ) -> None:
        self.case, self.bus = case, bus
        self._stack, self._folder, self._more_loops = stack, folder, more_loops
        self._launcher, self._served_with, self._speed, self._on_answer = launcher, served_with, speed, on_answer
        self._changes = changes
        self.tag = str(changes.get("tag", TAG))
        self.data = folder / "data"
        self.controller_module = "loopwright.controller"
        self.mode = Mode.AUTOMATIC
        """In which the loop is found by a test."""
        self.output = 0.0
        """The manual output found, of a loop in manual."""
        self.start_controller()
        self._service = self.launch_service()
        self.controller.wait_ready()
        self.start_plant()
        self.plant.wait_ready()
        self._connect()

    def start_plant(self) -> None:
        case = self.case
        model = ("--model", case.model, "--ts", str(case.ts), "--speed", self._speed)
        self.plant = self.launch("plant", "loopwright.plantsim", "--bus", self.bus, *model)

    def start_controller(self) -> None:
        case = self.case
        gains = ("--kp", str(case.kp), "--ti", str(case.ti), "--sp", str(case.sp))
        kept = ("--keep", str(self._folder / "kept.json"))
        where = ("--bus", self.bus, "--ts", str(case.ts))
        self.controller = self.launch("controller", self.controller_module, *where, *gains, *kept)

    def launch(self, name: str, *arguments: str, kind: type[ChildProcess] = ForkedProcess) -> ChildProcess:
        """Starts a process and does not wait for it."""
        process = kind(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        return process

    def serve(self) -> None:
        """The service anew on the same data."""
        self._service = self.launch_service()
        self._connect()

    def launch_service(self) -> ChildProcess:
        """A service on our data, not waited for."""
        case = self.case
        low, high = case.pv_limits
        loop = {
            "tag": self.tag, "bus": self.bus, "controller_node": 0x20, "plant_node": 0x10, "pv_unit": "unit",
            "pv_limits": {"low": low, "high": high}, "t95_s": case.t95_s, "sp_deviation": case.sp_deviation,
            **self._changes,
        }  # fmt: skip
        loops = self._folder / "loops.yaml"
        loops.write_text(yaml.safe_dump({"loops": [loop, *(loop | change for change in self._more_loops)]}))
        serve = ("serve", "--loops", str(loops), "--data", str(self.data), "--port", "0", *self._served_with)
        # A launcher changes what is imported after it.
        kind = ChildProcess if self._launcher else ForkedProcess
        return self.launch("service", *self._launcher, "loopwright.service", *serve, kind=kind)

    def _connect(self) -> None:
        self.service = self._service
        self.url = self.service.wait_ready().split()[1]
        self.http = self.client()
        self._stack.callback(self.http.close)

    def client(self) -> httpx.Client:
        told = {"response": [self._on_answer]}
        return httpx.Client(base_url=self.url, timeout=30.0, trust_env=False, event_hooks=told)

    def at_rest(self, pace: float) -> None:
        """Everything well and alive again, PV at its set-point, and the plant at that pace."""
        if self._service.poll() is not None:
            self.serve()
        for name, value in (
            ("plant_noise", 0.0),
            ("plant_disturbance", 0.0),
            ("controller_mode_command", Mode.AUTOMATIC),
            ("controller_setpoint", self.case.sp),
            ("plant_pace", 0.0),
            ("plant_samples_to_run", FOREVER),
        ):
            self.write(name, value)
        deadline = time.monotonic() + 30
        self.mode = Mode.AUTOMATIC
        near = 0
        while near < 5:
            state = self.state()
            assert time.monotonic() < deadline, state
            near = near + 1 if abs(state.pv - self.case.sp) < 2e-4 else 0
            time.sleep(0.02)  # some seconds of the plant, which runs as fast as it can
        self.write("plant_pace", pace)
        assert self.is_home()

    def left_alone(self) -> None:
        """Until the next `at_rest` nobody looks, so the plant hardly samples: at ten times real time the five processes
        take more than half a processor. What a test has ended does not answer, and has stopped anyway."""
        with suppress(TunerError, BusError):
            self.write("plant_pace", LEFT_ALONE_PACE, tries=3)

    def put_in_manual(self) -> None:
        """Where MV is."""
        self.write("controller_mode_command", Mode.MANUAL)
        self.mode, self.output = Mode.MANUAL, self.read("controller_manual_output")
        assert self.is_home()

    def in_stage(self, stage: Stage, **options: Any) -> str:
        """A job in the middle of this stage: the loop is held, and no longer as it was where the stage moves it."""
        if stage.in_manual:
            self.put_in_manual()
        url = self.retune(**stage.options | options)
        self.until(url, lambda job: job["stage"] == stage.stage and job["attempts"] == 1)
        if stage.phase is not None:
            self._in_phase(stage.phase, url)
            return url
        deadline = time.monotonic() + 10
        while not (self.read("controller_session") if stage.untouched else not self.is_home()):
            assert time.monotonic() < deadline, self.job(url)
            time.sleep(0.02)
        job = self.job(url)
        assert (job["state"], job["stage"]) == ("running", stage.stage)
        return url

    def _in_phase(self, phase: Phase, url: str) -> None:
        """Waits for this phase, of the first pulse of the manual output; for rest of the second one, after which PV is
        not needed for anything."""
        deadline = time.monotonic() + 60
        tuner, watch = Tuner(self.bus, 0x20, 0x10), PulseWatch(RESTED * self.case.Pu_s / self.case.ts)
        wanted = phase, 2 if phase is Phase.REST else 1
        try:
            while True:
                away = tuner.number("controller_manual_output") != pytest.approx(self.output)
                if (watch.see(away, tuner.number("sample_number")), watch.pulses) == wanted:
                    return
                assert watch.pulses <= 2 and time.monotonic() < deadline, self.job(url)
                time.sleep(0.002)
        finally:
            tuner.close()

    def retune(self, tag: str | None = None, **options: Any) -> str:
        answer = self.http.post(f"/loops/{tag or self.tag}/retune", json={"by": "me"} | options)
        assert answer.status_code == 202, answer.text
        return answer.headers["location"]

    def job(self, url: str) -> dict[str, Any]:
        """Asked again while the database does not answer."""
        give_up = time.monotonic() + 60
        while (answer := self.http.get(url)).status_code == 503 and time.monotonic() < give_up:
            time.sleep(0.5)
        job: dict[str, Any] = answer.json()
        return job

    def until(
        self, url: str, wanted: Callable[[dict[str, Any]], bool], patience_s: float = 200.0, every_s: float = 0.1
    ) -> dict[str, Any]:
        """Each look takes some 10 ms of processor time, in user-mode Linux many times that."""
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            job = self.job(url)
            if wanted(job):
                return job
            assert job["state"] in ("queued", "running"), f"ended before: {job}"
            time.sleep(every_s)
        raise AssertionError(f"still {job}")

    def finished(self, url: str, patience_s: float = 200.0) -> dict[str, Any]:
        return self.until(url, lambda job: job["state"] not in ("queued", "running"), patience_s, every_s=0.4)

    def until_watched(
        self, url: str, wanted: Callable[[dict[str, Any]], bool], patience_s: float = 200.0
    ) -> dict[str, Any]:
        """The watch of a job whose gains were accepted, once it is as wanted."""
        deadline = time.monotonic() + patience_s
        while not wanted(watch := self.job(url)["monitoring"]):
            assert time.monotonic() < deadline, watch
            time.sleep(0.1)
        return dict(watch)

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

    def write(self, name: str, value: float, tries: int = 20) -> None:
        """By SDO, as somebody else on the bus would, who waits for a busy machine."""
        tuner = Tuner(self.bus, 0x20, 0x10, sdo_tries=tries)
        try:
            tuner.write(name, value)
        finally:
            tuner.close()

    def is_home(self, sp: float | None = None) -> bool:
        """On its accepted gains, in the mode in which it was found, at its set-point, and in manual at its output."""
        state = self.state()
        outputs = (state.manual_output, state.mv) if self.mode is Mode.MANUAL else ()
        return (
            state.mode is self.mode
            and all(output == pytest.approx(self.output) for output in outputs)
            and not state.on_trial
            and state.sp == pytest.approx(self.case.sp if sp is None else sp)
            and state.gains.Kp == pytest.approx(self.case.kp)
            and state.gains.Ti == pytest.approx(self.case.ti)
        )
