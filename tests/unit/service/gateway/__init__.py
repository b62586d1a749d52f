"""A service as a process of its own, whose loops are files: what a test may kill.

    python -m tests.unit.service.gateway FOLDER --tag TAG ... [--host NAME] [--database URL] [--no-resume]

A stage lasts until FOLDER/go-STAGE (or FOLDER/go) is there; the controllers outlive the process as FOLDER/TAG.json.
With --hours-back its clock is set back as soon as FOLDER/clock-is-back is there. The loops of --on-bus are on a bus in
memory, on which no node answers.
Nothing is restored while FOLDER/TAG.held is there. --streams-grace-s: after how long a stop ends the streams of jobs.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, tzinfo
from ipaddress import ip_network
from pathlib import Path
from typing import Any, Self

import yaml

from loopwright.protocol.station import Station
from loopwright.service.api.gate.limits import RequestLimits
from loopwright.service.execution.procedures import Hooks, Outcome
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.loops.loop import Loop, Restored
from loopwright.service.server import serving
from loopwright.service.server.serving import Setup, open_bus_loop, serve
from loopwright.service.states.loop_state import LoopState, differences, loop_state, state_json
from loopwright.service.store import clock
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Sample, SetGains, SetSetpoint, StageDone, StageStarted
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason
from tests.unit.service.fakes import NEW, OLD, RESULT, Found, loop_entry

STAGES = ("relay", "ultimate", "zn_pi", "estimate", "verify")
HOME = LoopState(Mode.AUTOMATIC, 50.0, 50.0, 40.0, OLD, False, 0.0, 100.0, 0.1, True)


def read_loop(folder: Path, tag: str) -> LoopState:
    """The controller of a loop, whatever became of the service."""
    return loop_state(json.loads((folder / f"{tag}.json").read_text()))


def write_loop(folder: Path, tag: str, state: LoopState) -> None:
    new = folder / f"{tag}.new"
    new.write_text(json.dumps(state_json(state)))
    new.replace(folder / f"{tag}.json")


class FileLoop:
    """A controller that keeps what it is told, even when its tuner dies: the service has to close its session."""

    waits = False

    def __init__(self, folder: Path, tag: str) -> None:
        self._folder, self._tag = folder, tag
        self._n = 0
        self._session = folder / f"{tag}.session"
        if not (folder / f"{tag}.json").exists():
            write_loop(folder, tag, HOME)

    def read(self, beside_tests: bool = False) -> LoopState:
        if (self._folder / f"{self._tag}.silent").exists():
            raise Failed(Reason.NODE_LOST, "node 32 does not answer")
        return read_loop(self._folder, self._tag)

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        home, number = self.read(), time.time_ns() % 2**32
        note_session(number)
        self._session.write_text(json.dumps({"number": number, "home": state_json(home)}))
        return home

    def step(self, commands: Sequence[Command]) -> Sample:
        for command in commands:
            state = self.read()
            if isinstance(command, SetSetpoint):
                write_loop(self._folder, self._tag, replace(state, sp=command.value))
            elif isinstance(command, SetGains):
                write_loop(self._folder, self._tag, replace(state, gains=command.gains, on_trial=True))
        self._n += 1
        return Sample(0.1 * self._n, 50.0, 50.0, 40.0, int(Mode.AUTOMATIC))

    def hold(self) -> None:
        raise NotImplementedError("PV is true here")

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        while (self._folder / f"{self._tag}.held").exists():
            time.sleep(0.005)
        state = self.read()
        known = json.loads(self._session.read_text()) if self._session.exists() else {}
        if session is None or known.get("number") == session:
            write_loop(self._folder, self._tag, loop_state(known["home"]))
            self._session.unlink()
            return Restored(self.read(), "the session was closed")
        return Restored(state, "the controller knows nothing of the session", differences(state, home))

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        """FOLDER/TAG.accepted has a line for each time."""
        with (self._folder / f"{self._tag}.accepted").open("a") as accepted:
            accepted.write(f"{gains.Kp}\n")
        write_loop(self._folder, self._tag, replace(self.read(), gains=gains))
        return self.read()

    def close(self) -> None:
        """Nothing is open."""


def tune_in(folder: Path) -> Callable[[LoopConfig, RetuneRequest, Loop, LoopState, Hooks], Outcome]:
    """Five stages on trial gains; one that is done already is not run again."""

    def tune(config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
        done = {event.data["stage"] for event in hooks.earlier if event.kind == "stage_done"}
        ended: Ended | None = None
        hooks.on_home(loop.begin(hooks.stop, hooks.note_session))
        try:
            for stage in STAGES:
                if stage in done:
                    continue
                hooks.on_event(StageStarted(stage, 1.0, 1.0))
                with (folder / f"{config.tag}.ran").open("a") as ran:
                    ran.write(f"{stage}\n")
                hooks.on_samples([loop.step((SetGains(NEW),) if n == 0 else ()) for n in range(10)])
                while not ((folder / "go").exists() or (folder / f"go-{stage}").exists()):
                    loop.step(())
                    if reason := hooks.stop():
                        raise Aborted(reason, f"in stage {stage}")
                    time.sleep(0.005)
                hooks.on_event(StageDone(stage, Found(2.05, 3.32)))
        except Ended as error:
            ended = error
        return Outcome(None if ended else RESULT, ended, loop.restore(state).state, {})

    return tune


def set_back(flag: Path, seconds: float) -> None:
    """The wall clock of this process is that much behind from the moment on in which the flag is there."""
    real = time.time
    time.time = lambda: real() - (seconds if flag.exists() else 0.0)

    class Clock(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            return cls.fromtimestamp(time.time(), tz)

    vars(clock)["datetime"] = Clock


def ended_by(sent: signal.Signals, when: str, name: str) -> None:
    """Somebody ends this process just `before` or `after` the function MODULE:CLASS.NAME is called the first time."""
    module, _, path = name.partition(":")
    owner, function = path.split(".")
    holder = getattr(importlib.import_module(module), owner)
    real = getattr(holder, function)

    def cut(*arguments: Any, **more: Any) -> Any:
        setattr(holder, function, real)
        if when == "after":
            found = real(*arguments, **more)
        os.kill(os.getpid(), sent)
        time.sleep(0.2)
        return found if when == "after" else real(*arguments, **more)

    setattr(holder, function, cut)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--host", default="local")
    parser.add_argument("--tag", action="append", required=True)
    parser.add_argument("--database")
    parser.add_argument("--no-resume", action="store_true")
    parser.add_argument("--hours-back", type=float, default=0.0)
    parser.add_argument("--sigterm")
    parser.add_argument("--auth", action="store_true")
    parser.add_argument("--limits", type=json.loads, default={})
    parser.add_argument("--trusted-proxy", action="append", type=ip_network, default=[])
    parser.add_argument("--on-bus", action="append", default=[])
    parser.add_argument("--sigkill")
    parser.add_argument("--streams-grace-s", type=float, default=serving.STREAMS_GRACE_S)
    asked = parser.parse_args()
    serving.STREAMS_GRACE_S = asked.streams_grace_s
    if asked.sigterm:
        ended_by(signal.SIGTERM, *asked.sigterm.split())
    if asked.sigkill:
        ended_by(signal.SIGKILL, *asked.sigkill.split())
    asked.folder.mkdir(parents=True, exist_ok=True)
    set_back(asked.folder / "clock-is-back", 3600 * asked.hours_back)
    loops = asked.folder / "loops.yaml"
    entries = [loop_entry(tag=tag, channel=n + 1) for n, tag in enumerate((*asked.tag, *asked.on_bus))]
    loops.write_text(yaml.safe_dump({"loops": entries}))
    setup = Setup(
        loops, asked.folder / "data", "127.0.0.1", 0, asked.database, asked.host, not asked.no_resume, poll_s=0.05,
        auth=asked.auth or None, limits=RequestLimits(**asked.limits), trusted_proxies=tuple(asked.trusted_proxy),
    )  # fmt: skip
    station = Station()

    def open_loop(config: LoopConfig) -> Loop:
        if config.tag in asked.on_bus:
            return open_bus_loop(station, config)
        return FileLoop(asked.folder, config.tag)

    serve(setup, open_loop, tune_in(asked.folder))
