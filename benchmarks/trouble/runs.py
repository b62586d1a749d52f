"""One run of a procedure on a plant in trouble, and what its proposal is worth on the worst linearisation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.cases import ASKED
from benchmarks.drawn_runs import Draw, DrawNames
from benchmarks.operation import present_gains
from benchmarks.plants import SAMPLES_PER_PERIOD, Plant
from benchmarks.trouble.cases import Trouble
from benchmarks.trouble.chain import Chain, Setting
from benchmarks.trouble.kinds import TROUBLES
from benchmarks.tuning import T95_PERIODS, span_of
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.manual.procedure import MANUAL, by_manual
from loopwright.tuning.fast.pulses.procedure import setpoint
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.relay.procedure import FAST, FastOptions, FastProposal, fast
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import (
    Command,
    Event,
    Mode,
    Plan,
    Sample,
    SetGains,
    SetMode,
    SetOutput,
    SetSetpoint,
    StageStarted,
)

PRESENT = "typical"
"""The gains in effect under pulses of the set-point: Ms 1.3 to 2 on the plant without trouble."""
ROOM = 10.0
"""MV's limits under pulses of the set-point, in what the permitted step needs, at rest or at once by Kp."""


@dataclass(frozen=True, slots=True)
class TroubledRun:
    """How one run ended.

    passed: from the beginning of the test, Pu.  seconds: of processor.  reason: why nothing was proposed, None if
    something was.  Ms: of the worst linearisation, None where that is unstable or nothing was proposed.
    Kp, Ti (s): what was proposed.
    """

    case: str
    plant: str
    method: str
    seed: int
    passed: float
    seconds: float
    reason: str | None = None
    detail: str = ""
    Ms: float | None = None
    Kp: float | None = None
    Ti: float | None = None

    @property
    def draw(self) -> DrawNames:
        return self.plant, self.method, self.case, self.seed

    @property
    def over(self) -> float:
        """Ms over what was asked for; infinite where the loop is unstable."""
        return math.inf if self.Ms is None else self.Ms - ASKED


class TroubledLoop(RehearsedLoop):
    """Says to the plant when the test begins and when the new gains take over; keeps the samples since the loop was
    found at rest, with their stage."""

    def __init__(self, process: Chain, channel: Channel, sample_time_s: float) -> None:
        super().__init__(process, channel, sample_time_s)
        self.plant, self._begun, self._stage = process, False, ""
        self.taken: list[tuple[str, Sample]] = []

    def hear(self, event: Event) -> None:
        """The last look at the loop is where its record begins."""
        if isinstance(event, StageStarted):
            self._stage = event.stage
            if event.stage == PREFLIGHT:
                self.taken.clear()

    def record(self) -> ExperimentRecord | None:
        """What was recorded; None where too little was."""
        stages, samples = zip(*self.taken, strict=True)
        columns = dict(zip(("t_s", "sp", "pv", "mv", "mode"), zip(*samples, strict=True), strict=True))
        stored = stored_record({"stage": list(stages), **columns})
        return stored.experiment_record() if stored else None

    def step(self, commands: Sequence[Command]) -> Sample:
        begins = any(isinstance(each, SetSetpoint | SetOutput) or each == SetMode(Mode.EXPERIMENT) for each in commands)
        if begins and not self._begun:
            self._begun = True
            self.plant.begin()
        if any(isinstance(each, SetGains) for each in commands):
            self.plant.change()
        sample = super().step(commands)
        self.taken.append((self._stage or PREFLIGHT, sample))
        return sample


def measure(given: Draw) -> TroubledRun:
    """given: its second is the procedure."""
    plant, method, case, seed = given
    trouble = TROUBLES[case]
    plant = replace(trouble.of(plant), samples=trouble.samples)
    begun = time.process_time()
    result, loop = run_of(plant, method, trouble, seed)
    seconds = time.process_time() - begun
    stages = result.plant_time_s.items()
    passed = sum(value for stage, value in stages if stage not in (PREFLIGHT, SETTLE)) / plant.Pu
    found = TroubledRun(case, plant.name, method, seed, passed, seconds)
    if result.value is None:
        assert result.ended is not None
        return replace(found, reason=result.ended.reason.value, detail=result.ended.detail)
    gains = result.value.gains
    worst = loop.plant.worst(gains)
    return replace(found, Ms=worst.Ms if worst.stable else None, Kp=gains.Kp, Ti=gains.Ti)


def run_of(
    plant: Plant, method: str, trouble: Trouble, seed: int, on_event: Callable[[Event], None] = lambda event: None
) -> tuple[RunResult[FastProposal], TroubledLoop]:
    """What the procedure came to, and the loop after it.

    on_event: gets what the procedure reports.
    """
    if method != FAST:
        step = 0.5 * trouble.amplitude
        random = np.random.default_rng([seed, len(plant.name), int(1e6 * plant.Pu)])
        gains, noise, deviation = present_gains(plant, PRESENT, random), trouble.noise * step, step
        limit = ROOM * step * max(1.0, gains.Kp)
    else:
        span = trouble.amplitude * span_of(replace(plant, samples=SAMPLES_PER_PERIOD))
        # a step that the preflight can tell from the noise
        deviation = span * max(0.5, 12.0 * trouble.noise)
        gains, noise, limit = Gains(0.15 * plant.Ku, 2.0 * plant.Pu), trouble.noise * span, 2.0 * trouble.amplitude
    process = Chain(Setting(plant, trouble.substeps, noise, seed), trouble.build)
    settings = Settings(mv_low=-limit, mv_high=limit, pv_low=-1e9, pv_high=1e9, reverse=True)
    mode = Mode.MANUAL if method == MANUAL else Mode.AUTOMATIC
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(mode), 0.0)
    facts = Facts(plant.Ts, T95_PERIODS * plant.Pu, -limit, limit, deviation, gains, True)
    # what is judged is the design, whatever it is worth beside the gains that the loop has to begin with
    plan: Plan[FastProposal]
    options = DesignOptions(ASKED, propose_anyway=True)
    if method == FAST:
        plan = fast(facts, FastOptions(ASKED, amplitude=trouble.amplitude, propose_anyway=True))
    else:
        plan = by_manual(facts, options, MANUAL) if method == MANUAL else setpoint(facts, options)
    loop = TroubledLoop(process, channel, plant.Ts)

    def heard(event: Event) -> None:
        loop.hear(event)
        on_event(event)

    return run(plan, loop, limits=RunLimits(max_time_s=100.0 * plant.Pu), on_event=heard), loop
