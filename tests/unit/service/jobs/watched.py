"""A loop that goes on after gains were accepted, in simulated time: a plant of plantsim under the pure controller."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, astuple
from typing import Any

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.catalogue import CatalogueModel, Entry, LaterPath, PlantFacts
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.watching import Watching
from loopwright.service.listening.bins import GAP_BEFORE, UNKNOWN_MODE
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.rings import Rings
from loopwright.service.states.acceptance_watch import AcceptanceWatch
from loopwright.service.store import watches
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.observing.operated import HeardBefore

TS = 0.1
PU = 3.32
"""Ultimate period of the model that the fake procedure finds, s: K 2, T 3 s, L 1 s."""
_FACTS = PlantFacts("", None, None, None, 2.0, mv_per_unit=1.0)


class HeardAfter(HeardBefore):
    """What was heard of the loop, and what is read of it by SDO beside."""

    def __init__(self) -> None:
        self.rings = Rings()
        super().__init__(self.rings)
        self.gains_are_read = True
        self.read: tuple[Gains, float] | None = None

    def gains_read_since(self, tag: str, since_s: float) -> Gains | None:
        return self.read[0] if tag == TAG and self.read is not None and self.read[1] > since_s else None

    def began_anew(self) -> None:
        """Drops the history, as the process does that listens when the clock is put back."""
        self.rings = self._rings = Rings()


class PoolHere:
    """Runs computations at once, in this process."""

    def run(self, kind: ComputationKind, work: Callable[[], Any], *, unwanted: Callable[[], bool]) -> Any:
        assert kind is ComputationKind.LOOK
        return work()


class WatchedLoop:
    """A service with a proposal for TIC-101, and the loop as it goes on; it is looked at twice in an ultimate period.

    factor: of the plant's gain, at a sample. second_path: of the plant.
    """

    def __init__(
        self,
        service: Service,
        second_path: LaterPath | None = None,
        factor: Callable[[int], float] = lambda n: 1.0,
        noise: float = 0.01,
    ) -> None:
        self.service, self.factor = service, factor
        entry = Entry("", _FACTS, CatalogueModel((2.0,), (3.0, 1.0), 1.0), second_path)
        self.plant = entry.build(TS, noise_std=noise, seed=1)
        self.now_s, self.passed_s = time.time(), 1000.0
        self.n = 0
        self.ears = HeardAfter()
        gains = service.controller.state.gains
        self.channel = Channel(TS, Settings(), Parameters(gains.Kp, gains.Ti), self.plant.pv, int(Mode.AUTOMATIC), 50.0)
        self.channel.setpoint = 50.0
        self.pv = self.plant.pv
        self.shown: Callable[[float], float] = lambda pv: pv
        """What the sensor shows of PV."""
        self.gap = GAP_BEFORE
        self.heard_at_all = True
        self.frames_lost = False
        """So many that mode and set-point are never known for long."""
        jobs = service.jobs
        self.watching = self.another()
        self.job_id = jobs.start(TAG, FastRetune()).id
        service.wait(self.job_id)

    def another(self) -> Watching:
        """The watch of a service that is started on the same database."""
        jobs = self.service.jobs
        return Watching(
            self.service.store, jobs.directory, jobs.decisions, self.ears, PoolHere(),
            lambda: self.now_s, lambda: self.passed_s,
        )  # type: ignore[arg-type]  # fmt: skip

    def accept(self, auto_rollback: bool = True) -> None:
        self.service.jobs.decisions.accept(self.job_id, "operator A", auto_rollback)
        self.now_s = max(self.now_s, time.time())  # the acceptance has the time of this machine

    def clock_is_set(self, by_s: float) -> None:
        """The wall clock jumps."""
        self.now_s += by_s
        if by_s < 0.0:
            self.ears.began_anew()
        self.gap = GAP_BEFORE

    @property
    def watch(self) -> AcceptanceWatch:
        return watches.of_jobs(self.service.store, [self.job_id])[self.job_id]

    def goes_on(self, periods: float, moved_by: float = 0.0) -> None:
        """The loop goes on for so many ultimate periods, after a change of the set-point."""
        self.channel.setpoint += moved_by
        for _ in range(round(2.0 * periods)):
            self.steps(round(0.5 * PU / TS))
            self.watching.look()
            self.watching.compare()

    def steps(self, count: int) -> None:
        controller, rings = self.service.controller, self.ears.rings
        for _ in range(count):
            gains = controller.state.gains
            parameters, mode = Parameters(**asdict(gains)), int(controller.state.mode)
            if parameters != self.channel.in_effect:
                self.channel.accept(parameters)
            if mode != self.channel.mode:
                self.channel.command_mode(mode)
            mv = self.channel.step(self.pv)
            self.now_s, self.passed_s = self.now_s + TS, self.passed_s + TS
            self.n += 1
            if self.heard_at_all:
                read = gains if self.ears.read is None or self.ears.gains_are_read else self.ears.read[0]
                known = rings.number_of(astuple(read))
                rings.put(self.now_s, self.n, self.pv, mv, self.channel.setpoint, known, mode, self.gap)
                self.gap = 0
            else:
                self.gap = GAP_BEFORE
            self.pv = self.shown(self.plant.step(50.0 + self.factor(self.n) * (mv - 50.0)))
        if self.ears.gains_are_read:
            self.ears.read = controller.state.gains, self.passed_s
        sp = self.channel.setpoint
        mode, sp = (UNKNOWN_MODE, math.nan) if self.frames_lost else (mode, sp)
        self.ears.heard = {} if not self.heard_at_all else {
            TAG: Heard(self.now_s, False, self.pv, mv, sp, mode, False, False)
        }  # fmt: skip
