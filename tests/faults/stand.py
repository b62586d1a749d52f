"""Plant, controller and service on a hub with faults, and whatever else a fault needs: a small disk, a server, a clock.

The controller starts with gains that are not its accepted ones (those are in its file): one that came back on the
gains of its options would be seen.
"""

from __future__ import annotations

import os
import subprocess
import threading
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import NamedTuple

import httpx
from sqlalchemy import create_engine, select
from sqlalchemy.orm import Session

from loopwright.controller.device import RetainedState
from loopwright.controller.pid import Parameters
from loopwright.controller.retained_state import write
from loopwright.protocol.profile import Mode
from loopwright.service.store.sample_blocks import Block, unpack
from loopwright.service.store.tables import ChunkRow
from tests.e2e.plantsite import MANUAL_PERMITTED, MODEL_14, Plantsite, Stage
from tests.faults.ending import Eye, Home, Stalls
from tests.faults.faulty_hub import FaultyHub, well
from tests.unit.service.postgres import Server, binaries

LOOP = MODEL_14
PACE = 10.0
"""As a factor of real time: one stand then takes more than half a processor."""
HOME = Home(Mode.AUTOMATIC, LOOP.sp, LOOP.kp, LOOP.ti, mv=50.0)
SMALL_DISK_MIB = 8


class StoredSample(NamedTuple):
    """A sample as the service has stored it. number: counted from the job's first sample.  pv, mv: percent; None where
    the frame carried no number."""

    number: int
    pv: float | None
    mv: float | None


@dataclass(frozen=True)
class Needs:
    """What a fault needs besides the three processes."""

    small_disk: bool = False
    own_clock: bool = False
    defect: bool = False
    noise: float = 0.0
    """Of PV, PV units."""


class Missing(Exception):
    """What a fault needs and this machine does not offer."""


class Stand:
    """Closed by the stack it was made with. Raises Missing."""

    def __init__(self, stack: ExitStack, folder: Path, database: str = "sqlite", needs: Needs | None = None) -> None:
        self.needs = needs = needs or Needs()
        self.folder = folder
        self.defects: list[str] = []
        self.left: list[StoredSample] | None = None
        """The job's samples in the database when its service had died."""
        self.server: Server | None = None
        self.database: str | None = None
        self.home = HOME
        """How the loop must end unless an outside change comes between."""
        self.defective = folder / "defective"
        """While this file is there, the service of a fault that needs a defect has one."""
        self.clock = folder / "clock"
        """Seconds that the service's wall clock is off, where a fault needs its own."""
        launcher: tuple[str, ...] = ()
        served_with: tuple[str, ...] = ()
        if database == "postgresql":
            self.server = _server(stack)
            self.database = self.server.database()
            served_with = ("--database", self.database, "--gateway", "gw-1")
        if needs.small_disk:
            _mount(stack, folder / "data")
        if needs.own_clock:
            launcher = ("tests.faults.own_clock", str(self.clock))
        if needs.defect:
            launcher = ("tests.faults.defect", str(self.defective))
        self.hub = FaultyHub()
        threading.Thread(target=self.hub.serve, daemon=True).start()
        stack.callback(self.hub.stop)
        self.eye = Eye(self.hub)
        stack.callback(self.eye.close)
        self.stalls = Stalls()
        stack.callback(self.stalls.close)
        write(folder / "kept.json", [RetainedState(Parameters(LOOP.kp, LOOP.ti), Mode.AUTOMATIC, LOOP.sp, 50.0)])
        others = replace(LOOP, kp=LOOP.kp / 2, ti=2 * LOOP.ti)
        self.site = Plantsite(
            stack, folder, others, bus=self.hub.url, launcher=launcher, served_with=served_with, speed=str(PACE),
            on_answer=self._heard, changes=MANUAL_PERMITTED,
        )  # fmt: skip
        self.site.case = LOOP

    def at_rest(self, pace: float) -> None:
        self.hub.fault, self.hub.pv_broken, self.hub.shows = well, False, None
        self.site.at_rest(pace)
        self.hub.new_job()
        if self.needs.noise:
            draw = Random(1).gauss
            self.hub.shows = lambda pv: pv + draw(0.0, self.needs.noise)
        self.home = HOME
        self.defective.unlink(missing_ok=True)
        self.defects.clear()
        self.left = None
        self.stalls.longest_s = 0.0

    def in_stage(self, stage: Stage) -> str:
        """The URL of a job in that stage, of a loop that was at rest."""
        self.at_rest(PACE * stage.pace)
        url = self.site.in_stage(stage)
        if stage.in_manual:
            self.home = replace(HOME, mode=Mode.MANUAL, mv=self.site.output, output=self.site.output)
        return url

    def serve_again(self, url: str) -> None:
        """The service that has died is started, as a supervisor would. Counts first what it has left of the job."""
        address = self.database or f"sqlite:///{self.site.data / 'loopwright.sqlite'}"
        engine = create_engine(address.replace("postgresql:", "postgresql+psycopg:"))
        mine = select(ChunkRow).where(ChunkRow.job_id == url.rsplit("/", 1)[1]).order_by(ChunkRow.seq)
        with Session(engine) as session:
            blocks = [unpack(Block(row.stage, row.first_t_s, row.count, row.data)) for row in session.scalars(mine)]
        self.left = [
            StoredSample(round(sample.t / LOOP.ts), sample.pv, sample.mv) for block in blocks for sample in block
        ]
        engine.dispose()
        self.site.serve()

    def _heard(self, answer: httpx.Response) -> None:
        """503 is an answer the API documents: a database, a bus or a service that is just going away."""
        documented = answer.status_code == 503 and answer.headers["content-type"] == "application/problem+json"
        if answer.status_code >= 500 and not documented:
            answer.read()
            asked = f"{answer.request.method} {answer.request.url.path}"
            self.defects.append(f"{asked}: {answer.status_code} {answer.text}")


def _server(stack: ExitStack) -> Server:
    found = binaries()
    if found is None:
        raise Missing("the package postgresql")
    server = Server(found)
    stack.callback(server.close)
    return server


def _mount(stack: ExitStack, folder: Path) -> None:
    """A disk of a few MiB: only its being full is like any other's."""
    folder.mkdir()
    size = f"size={SMALL_DISK_MIB}m"
    if os.getuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], check=False).returncode:
        raise Missing("root, who may mount a small disk")
    stack.callback(subprocess.run, ["umount", "--lazy", folder], check=True)
