"""Loops in operation on one bus, and the service that retunes some of them: processes, as a user starts them."""

from __future__ import annotations

import json
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import httpx
import yaml

from loopwright.plantsim.catalogue import find
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.cli.demo import vcan_usable
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.security.keys import Scope
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Mode

TS_S = 0.1
MODELS = (18, 29, 12, 14)
"""Of the 50, the quickest to retune."""
FRACTION_OF_KU, FRACTION_OF_PU = 0.3, 0.8
SP = 50.0
SILENT, SILENT_NODE = "SILENT", 0x30
START_S = 300.0


class Site:
    """keys: of an operator, of a stranger who may operate too, and one that strangers guess at."""

    def __init__(self, stack: ExitStack, folder: Path, loops: int) -> None:
        self._stack, self._folder = stack, folder
        self.tags = [f"T-{n}" for n in range(loops)]
        self.bus = "socketcan:vcan0"
        if not vcan_usable():
            self.bus = self._start("hub", "loopwright.protocol.hub", "--port", "0").split()[1]
        facts = [find(f"model-{MODELS[n % len(MODELS)]}").facts for n in range(loops)]
        entries: list[dict[str, Any]] = []
        gains: list[dict[str, Any]] = []
        for n, (tag, fact) in enumerate(zip(self.tags, facts, strict=True)):
            assert fact.Ku_on_bus and fact.Pu_s and fact.T95_s and fact.static_gain
            step = 5.0 * fact.static_gain / fact.mv_per_unit  # of the set-point: MV moves by 5 percent
            limits = {"low": SP - 10 * step, "high": SP + 10 * step}
            entries.append({
                "tag": tag, "bus": self.bus, "controller_node": CONTROLLER_NODE, "plant_node": PLANT_NODE,
                "channel": n + 1, "pv_unit": "unit", "pv_limits": limits, "t95_s": fact.T95_s, "sp_deviation": step,
            })  # fmt: skip
            gains.append({"kp": FRACTION_OF_KU * fact.Ku_on_bus, "ti": FRACTION_OF_PU * fact.Pu_s, "sp": SP})
        entries.append(entries[0] | {"tag": SILENT, "controller_node": SILENT_NODE, "plant_node": None, "channel": 1})
        (folder / "loops.yaml").write_text(yaml.safe_dump({"loops": entries, "buses": {self.bus: {"at_once": loops}}}))
        (folder / "channels.yaml").write_text(yaml.safe_dump(gains))
        common = ("--bus", self.bus, "--ts", str(TS_S))
        self._start("controller", "loopwright.controller", *common, "--config", str(folder / "channels.yaml"))
        plants = (f"--model=model-{MODELS[n % len(MODELS)]}" for n in range(loops))
        self._start("plant", "loopwright.plantsim", *common, *plants, "--speed", "1")
        with closing(Store(folder / "data")) as store:
            keyring = Keyring(store.engine)
            self.operator, self.stranger, self.guessed = (
                keyring.create(name, scope)[1]
                for name, scope in (("operator", Scope.ADMIN), ("stranger", Scope.OPERATE), ("guessed", Scope.READ))
            )
        self.home = {tag: self.read(tag) for tag in self.tags}
        where = ("--loops", str(folder / "loops.yaml"), "--data", str(folder / "data"), "--port", "0", "--auth")
        self.url = self._start("service", "loopwright.service", "serve", *where).split()[1]

    def _start(self, name: str, *command: str) -> str:
        process = ChildProcess(name, command, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        if name == "service":
            self.service = process
        return process.wait_ready(START_S)

    def attackers(self, *names: str, key: str = "") -> ChildProcess:
        number = len(list(self._folder.glob("attackers-*.log")))
        arguments = ("tests.hostile.attackers", self.url, *names, f"--silent={SILENT}", f"--loop={self.tags[-1]}")
        process = ChildProcess(
            "attackers", (*arguments, *([f"--key={key}"] if key else [])), self._folder / f"attackers-{number}.log"
        )
        self._stack.callback(process.stop)
        process.wait_ready(START_S)
        return process

    def listener(self, tag: str) -> ChildProcess:
        """A process that listens to the heartbeat and the sessions of a loop; `heard` has what it found, once it was
        stopped."""
        command = ("tests.hostile.listening", self.bus, str(self.tags.index(tag) + 1))
        process = ChildProcess("listener", command, self._folder / "listener.log")
        self._stack.callback(process.stop)
        process.wait_ready(START_S)
        return process

    def heard(self) -> dict[str, list[tuple[float, float]]]:
        """When, and by how many seconds, heartbeat and machine were late; when sessions were opened (1) or over (0)."""
        found: dict[str, list[tuple[float, float]]] = json.loads(
            (self._folder / "listener.log").read_text().splitlines()[-1]
        )
        return found

    def ask(self, method: str, path: str, **more: Any) -> httpx.Response:
        """As the operator, on a connection of its own. verify: no certificates are read for what is plain HTTP, which
        takes longer than many an answer."""
        headers = {"Authorization": f"Bearer {self.operator}"}
        with httpx.Client(base_url=self.url, timeout=60.0, trust_env=False, verify=False, headers=headers) as client:
            return client.request(method, path, **more)

    def event_loop_late_s(self) -> float:
        """The longest time for which the service's event loop was held up."""
        name = "loopwright_event_loop_late_worst_seconds "
        lines = self.ask("GET", "/metrics").text.splitlines()
        return next(float(line.removeprefix(name)) for line in lines if line.startswith(name))

    def read(self, tag: str) -> LoopState:
        """By another way than the service's."""
        loop = BusLoop(self.bus, CONTROLLER_NODE, PLANT_NODE, self.tags.index(tag) + 1)
        try:
            return loop.read()
        finally:
            loop.close()

    def unsafe(self) -> dict[str, str]:
        """The loops that are not as they were, each in words."""
        found = {}
        for tag, home in self.home.items():
            state = self.read(tag)
            wrong = [
                f"{name} is {is_}, was {was}"
                for name, is_, was in (
                    ("mode", state.mode, Mode.AUTOMATIC), ("SP", state.sp, home.sp), ("gains", state.gains, home.gains),
                    ("trial", state.on_trial, False),
                )
                if is_ != was
            ]  # fmt: skip
            if wrong:
                found[tag] = "; ".join(wrong)
        return found
