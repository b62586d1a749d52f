"""A plant of several areas: each loop is a channel of one plant and of one controller, on one bus."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, ParameterCommand
from loopwright.protocol.tuner import Tuner
from tests.browser.site import Site
from tests.forked import ForkedProcess
from tests.ports import free_port


@dataclass(frozen=True)
class Member:
    """A loop of the fleet.

    kp: percent per PV unit.  ti: s.  sp: PV units, near 50, around which the plants are at rest.  noise: standard
    deviation, PV units.  changes: of its entry in loops.yaml.  on_dead_bus: its bus cannot be opened.
    """

    tag: str
    area: str
    description: str
    pv_unit: str
    model: str = "model-14"
    kp: float = 80.0
    ti: float = 1.2
    sp: float = 50.0
    noise: float = 0.002
    mode: str = "automatic"
    changes: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    on_dead_bus: bool = False


class Fleet(Site):
    """The processes, and a service of all these loops. The first one is that of `tag`."""

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        members: Sequence[Member],
        served_with: Sequence[str] = (),
        ts: float = 0.05,
    ) -> None:
        self.members = {member.tag: member for member in members}
        self._live = [member for member in members if not member.on_dead_bus]
        self._ts = ts
        dead = f"socketcand:127.0.0.1:{free_port()}"
        first, *others = [self._entry(member, dead) for member in members]
        super().__init__(stack, folder, tuple(others), served_with, first)

    def _entry(self, member: Member, dead: str) -> dict[str, Any]:
        entry: dict[str, Any] = {
            "tag": member.tag, "area": member.area, "description": member.description, "pv_unit": member.pv_unit,
            "t95_s": 25.0 if member.model == "model-41" else 12.0,
        }  # fmt: skip
        where = {"bus": dead} if member.on_dead_bus else {"channel": self.channel(member.tag)}
        return entry | where | dict(member.changes)

    def channel(self, tag: str) -> int:
        return 1 + next(n for n, member in enumerate(self._live) if member.tag == tag)

    def start_plant(self) -> None:
        rows = [{"model": member.model, "noise": member.noise} for member in self._live]
        options = ("--ts", str(self._ts), "--speed", "1", "--config", str(self._written("plant", rows)))
        self.plant = self.launch("plant", "loopwright.plantsim", "--bus", self.bus, *options)

    def start_controller(self) -> None:
        rows = [
            {"kp": member.kp, "ti": member.ti, "sp": member.sp, "mode": member.mode, "mv": 50.0}
            for member in self._live
        ]
        options = ("--ts", str(self._ts), "--config", str(self._written("controller", rows)))
        self.controller = self.launch("controller", "loopwright.controller", "--bus", self.bus, *options)

    def _written(self, name: str, rows: list[dict[str, Any]]) -> Path:
        file = self._folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump(rows))
        return file

    def change_gains(self, tag: str, kp: float, ti: float) -> None:
        """By hand, at the controller."""
        tuner = Tuner(self.bus, CONTROLLER_NODE, PLANT_NODE, self.channel(tag))
        try:
            tuner.write("controller_staged_kp", kp)
            tuner.write("controller_staged_ti", ti)
            tuner.write("controller_parameter_command", ParameterCommand.TRY)
            tuner.write("controller_parameter_command", ParameterCommand.ACCEPT)
        finally:
            tuner.close()

    def pace(self, pace: float) -> None:
        """Of the plant of all loops, in plant time for real time."""
        self.write("plant_pace", pace)


def locked_service(stack: ExitStack, folder: Path) -> str:
    """The URL of a service that asks for a key. Of its one loop the bus cannot be opened."""
    dead = f"socketcand:127.0.0.1:{free_port()}"
    loop = {"tag": "TIC-401", "bus": dead, "controller_node": 0x20, "pv_unit": "degC", "t95_s": 30.0}
    loops = folder / "locked.yaml"
    loops.write_text(yaml.safe_dump({"loops": [loop | {"pv_limits": {"low": 0, "high": 100}, "sp_deviation": 1.0}]}))
    data = folder / "locked"
    create = ("key", "create", "operator", "--scope", "operate", "--data", str(data))
    subprocess.run([sys.executable, "-m", "loopwright.service", *create], check=True, capture_output=True)
    serve = ("serve", "--loops", str(loops), "--data", str(data), "--port", "0", "--auth")
    service = ForkedProcess("service", ("loopwright.service", *serve), folder / "locked.log")
    stack.callback(service.stop)
    return service.wait_ready().split()[1]
