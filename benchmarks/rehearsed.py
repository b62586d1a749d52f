"""Live loops without a bus: the controller's algorithm and a plant model in memory, behind the configuration of a loop.

`benchmarks.rehearsed_gateway` is a gateway that tunes so many of them, as a process of its own.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from benchmarks.command import parser_of
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.server.serving import Setup, serve
from loopwright.tuning.plan import Command, Mode, Sample

TS = 0.1
MIDDLE = 50.0
"""MV at which PV is 0, percent."""


class AroundTheMiddle:
    """K = 2 PV units per percent, T = 6 s, L = 1.5 s, for an MV in 0..100 percent."""

    def __init__(self) -> None:
        self._plant = LinearPlant([2.0], [6.0, 1.0], 1.5, TS)

    @property
    def pv(self) -> float:
        return self._plant.pv

    def step(self, mv: float) -> float:
        return self._plant.step(mv - MIDDLE)


def entry(tag: str, bus: str = "virtual:rehearsed", channel: int = 1, node: int = 32) -> dict[str, Any]:
    """Such a loop in loops.yaml."""
    return {
        "tag": tag, "bus": bus, "controller_node": node, "channel": channel, "pv_unit": "degC",
        "pv_limits": {"low": -100.0, "high": 100.0}, "t95_s": 20.0, "sp_deviation": 2.0,
    }  # fmt: skip


class Paced(RehearsedLoop):
    """Its samples come by a clock, a handful at a time."""

    pace = 0.0
    _began: float | None = None

    def step(self, commands: Sequence[Command]) -> Sample:
        sample = super().step(commands)
        if self.pace:
            now = time.monotonic()
            if self._began is None:
                self._began = now - sample.t / self.pace
            early = sample.t / self.pace + self._began - now
            if early > 0.02:
                time.sleep(early)
        return sample


def open_loop(_config: LoopConfig, pace: float = 0.0) -> RehearsedLoop:
    settings = Settings(mv_low=0.0, mv_high=100.0, safe_output=MIDDLE, pv_low=-200.0, pv_high=200.0, reverse=True)
    channel = Channel(TS, settings, Parameters(0.2, 6.0), 0.0, int(Mode.AUTOMATIC), MIDDLE)
    loop = Paced(AroundTheMiddle(), channel, TS)
    loop.pace = pace
    return loop


def main() -> None:
    """A gateway that tunes such loops."""
    parser = parser_of("A gateway that tunes loops without a bus: the controller's algorithm and a plant in memory.")
    parser.add_argument("folder", type=Path, help="for its configuration and its data")
    parser.add_argument("host", help="its name, and the beginning of its loops' tags")
    parser.add_argument("loops", type=int, help="how many")
    parser.add_argument("at_once", type=int, help="jobs at the same time")
    parser.add_argument("pace", type=float, help="plant time in times of real time; 0: as fast as the processor goes")
    parser.add_argument("database", help="the URL of a PostgreSQL database; '': a file in the folder")
    given = parser.parse_args()
    folder, host = given.folder, given.host
    folder.mkdir(parents=True, exist_ok=True)
    bus = "virtual:rehearsed"
    entries = [entry(f"{host}-{n}", bus, n % 199 + 1, 1 + n // 199) for n in range(given.loops)]
    file = folder / "loops.yaml"
    file.write_text(yaml.safe_dump({"loops": entries, "buses": {bus: {"at_once": given.at_once}}}))
    setup = Setup(file, folder / "data", "127.0.0.1", 0, given.database or None, host)
    serve(setup, partial(open_loop, pace=given.pace))
