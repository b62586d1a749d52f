"""One run of a procedure on a plant in trouble, and what its proposal is worth on the worst linearisation."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
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
from loopwright.service.execution.runner import run
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.manual_procedure import MANUAL, by_manual
from loopwright.tuning.fast.options import DesignOptions
from loopwright.tuning.fast.procedure import FAST, FastOptions, FastProposal, fast
from loopwright.tuning.fast.setpoint_procedure import setpoint
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Plan, Sample, SetGains, SetMode, SetOutput, SetSetpoint
from loopwright.tuning.reasons import Ended

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
    """Says to the plant when the test begins and when the new gains take over."""

    def __init__(self, process: Chain, channel: Channel, sample_time_s: float) -> None:
        super().__init__(process, channel, sample_time_s)
        self._process, self._begun = process, False

    def step(self, commands: Sequence[Command]) -> Sample:
        begins = any(
            isinstance(each, SetSetpoint | SetOutput) or each == SetMode(Mode.EXPERIMENT) for each in commands
        )
        if begins and not self._begun:
            self._begun = True
            self._process.begin()
        if any(isinstance(each, SetGains) for each in commands):
            self._process.change()
        return super().step(commands)


def measure(given: Draw) -> TroubledRun:
    """given: its second is the procedure."""
    plant, method, case, seed = given
    trouble = TROUBLES[case]
    plant = replace(trouble.of(plant), samples=trouble.samples)
    begun = time.process_time()
    process, ran, ended, stages = _run(plant, method, trouble, seed)
    seconds = time.process_time() - begun
    passed = sum(value for stage, value in stages.items() if stage not in (PREFLIGHT, SETTLE)) / plant.Pu
    found = TroubledRun(case, plant.name, method, seed, passed, seconds)
    if ran is None:
        assert ended is not None
        return replace(found, reason=ended.reason.value, detail=ended.detail)
    worst = process.worst(ran)
    return replace(found, Ms=worst.Ms if worst.stable else None, Kp=ran.Kp, Ti=ran.Ti)


def _run(
    plant: Plant, method: str, trouble: Trouble, seed: int
) -> tuple[Chain, Gains | None, Ended | None, dict[str, float]]:
    """The plant after the run, the gains proposed, why there are none, and the plant time of each stage, s."""
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
    result = run(plan, loop, limits=RunLimits(max_time_s=100.0 * plant.Pu))
    return process, result.value.gains if result.value else None, result.ended, result.plant_time_s
