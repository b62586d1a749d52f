"""Plants in trouble as processes on CAN buses, their controllers, and one service that retunes all of them at once.

Each plant has a bus, a plant node and a controller node of its own, in its own time; a kind of trouble is a channel.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx
import yaml

from benchmarks.bus import INTERFACE
from benchmarks.cases import ASKED
from benchmarks.command import Missing
from benchmarks.plants import SAMPLES_PER_PERIOD, Plant
from benchmarks.trouble.bus_cases import REST, BusCase
from benchmarks.trouble.kinds import TROUBLES
from benchmarks.tuning import T95_PERIODS, span_of
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.tuner import Tuner
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.states.job_state import ACTIVE

START_S = 300.0
LOOK_S = 0.3
PATIENCE_S = 900.0
FRACTION_OF_KU, FRACTION_OF_PU = 0.15, 2.0
"""The gains in effect, as in the rehearsals."""


def interfaces(count: int) -> list[str]:
    """The URLs of so many virtual CAN interfaces, which are made where there are fewer. Raises Missing."""
    names = [f"{INTERFACE[:-1]}{n}" for n in range(count)]
    for name in names:
        if not Path(f"/sys/class/net/{name}").exists():
            for command in (("ip", "link", "add", name, "type", "vcan"), ("ip", "link", "set", name, "up")):
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    raise Missing(f"no interface {name}: {' '.join(command)}: {done.stderr.strip()}")
    return [f"socketcan:{name}" for name in names]


@dataclass
class BusLoop:
    """A loop and its job. began: the sample of the plant at which its gain began to drift; None: it has not."""

    tag: str
    bus: str
    channel: int
    plant: Plant
    case: BusCase
    seed: int
    noise: float
    url: str = ""
    began: int | None = None


def span(plant: Plant, case: BusCase) -> float:
    """Of PV under the relay."""
    return TROUBLES[case.name].amplitude * span_of(replace(plant, samples=SAMPLES_PER_PERIOD))


class TroubleSite:
    """The processes, with one plant on each of the buses.

    plants: each with the kinds of trouble that it is tried in.
    sample_wall_s: wall time of a sample of every plant, s.
    """

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        buses: Sequence[str],
        plants: Sequence[tuple[Plant, Sequence[BusCase]]],
        seed: int,
        sample_wall_s: float,
    ) -> None:
        self._stack, self._folder = stack, folder
        self.loops: list[BusLoop] = []
        started = []
        for n, (bus, (plant, cases)) in enumerate(zip(buses, plants, strict=True)):
            mine = [
                BusLoop(f"{n}-{at}", bus, at + 1, plant, case, seed, TROUBLES[case.name].noise * span(plant, case))
                for at, case in enumerate(cases)
            ]
            self.loops += mine
            started += self._devices(n, bus, plant, mine, seed, sample_wall_s)
        for process in started:
            process.wait_ready(START_S)
        site = {"loops": [_entry(each) for each in self.loops], "buses": {bus: {"at_once": 100} for bus in buses}}
        loops = folder / "loops.yaml"
        loops.write_text(yaml.safe_dump(site))
        # no history of the loops: it would hear every frame a second time, and a retune by the relay needs none
        where = ("--loops", str(loops), "--data", str(folder / "data"), "--port", "0", "--no-listen")
        url = self._launch("service", "loopwright.service", "serve", *where).wait_ready(START_S).split()[1]
        self._http = stack.enter_context(httpx.Client(base_url=url, timeout=120.0, trust_env=False))

    def retuned(self) -> list[tuple[BusLoop, dict[str, Any], dict[str, list[Any]]]]:
        """Every loop with its job at its end and the job's samples. Raises RuntimeError."""
        for each in self.loops:
            asked = {
                "method": "fast", "Ms": ASKED, "amplitude_pct": TROUBLES[each.case.name].amplitude,
                "excitations": ["relay"], "propose_anyway": True,
            }  # fmt: skip
            answer = self._http.post(f"/loops/{each.tag}/retune", json=asked | {"by": "benchmark"})
            if answer.is_error:
                raise RuntimeError(f"{each.plant.name}, {each.case.name}: {answer.text}")
            each.url = answer.headers["location"]
        waits, drifting = list(self.loops), [each for each in self.loops if each.case.drift[1]]
        give_up = time.monotonic() + PATIENCE_S
        while waits:
            drifting = [each for each in drifting if self._drifts(each)]
            if self._http.get(waits[0].url).json()["state"] not in ACTIVE:
                waits.pop(0)
                continue
            if time.monotonic() > give_up:
                raise RuntimeError(f"{len(waits)} jobs have not ended in {PATIENCE_S:g} s, see {self._folder}")
            time.sleep(LOOK_S)
        return [
            (each, self._http.get(each.url).json(), self._http.get(f"{each.url}/samples").json()) for each in self.loops
        ]

    def _drifts(self, loop: BusLoop) -> bool:
        """Moves the gain of a plant that drifts to where it is now; whether it moves on."""
        if loop.began is None:
            job = self._http.get(loop.url).json()
            if job["state"] not in ACTIVE:
                return False
            if job["stage"] != "relay":
                return True
        tuner = Tuner(loop.bus, CONTROLLER_NODE, PLANT_NODE, loop.channel, sdo_timeout_s=5.0)
        try:
            now = int(tuner.number("sample_number", node=PLANT_NODE))
            loop.began = now if loop.began is None else loop.began
            end, periods = loop.case.drift
            passed = min((now - loop.began) / (periods * loop.plant.samples), 1.0)
            tuner.write("plant_gain", 1.0 + (end - 1.0) * passed)
        finally:
            tuner.close()
        return passed < 1.0

    def _devices(
        self, n: int, bus: str, plant: Plant, loops: Sequence[BusLoop], seed: int, sample_wall_s: float
    ) -> list[ChildProcess]:
        channels = [{"model": each.case.model(plant), "noise": each.noise} for each in loops]
        gains = [
            {"kp": FRACTION_OF_KU * plant.Ku, "ti": FRACTION_OF_PU * plant.Pu, "sp": REST, "mv": REST} for _ in loops
        ]
        config = {}
        for name, rows in (("plant", channels), ("controller", gains)):
            config[name] = self._folder / f"{name}-{n}.yaml"
            config[name].write_text(yaml.safe_dump(rows))
        common = ("--bus", bus, "--ts", f"{plant.Ts:.6f}", "--config")
        pace = ("--speed", f"{plant.Ts / sample_wall_s:.6g}", "--seed", str(seed))
        return [
            self._launch(f"controller-{n}", "loopwright.controller", *common, str(config["controller"])),
            self._launch(f"plant-{n}", "loopwright.plantsim", *common, str(config["plant"]), *pace),
        ]

    def _launch(self, name: str, *arguments: str) -> ChildProcess:
        process = ChildProcess(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        return process


def _entry(loop: BusLoop) -> dict[str, Any]:
    """The loop in loops.yaml: as the rehearsals have it."""
    trouble = TROUBLES[loop.case.name]
    # a step that the preflight can tell from the noise
    step = span(loop.plant, loop.case) * max(0.5, 12.0 * trouble.noise)
    room = 2.0 * trouble.amplitude
    return {
        "tag": loop.tag, "bus": loop.bus, "controller_node": CONTROLLER_NODE, "plant_node": PLANT_NODE,
        "channel": loop.channel, "pv_unit": "%", "pv_limits": {"low": REST - 10.0 * step, "high": REST + 10.0 * step},
        "mv_limits": {"low": REST - room, "high": REST + room}, "t95_s": T95_PERIODS * loop.plant.Pu,
        "sp_deviation": step, "description": f"{loop.plant.name}, {loop.case.name}",
    }  # fmt: skip
