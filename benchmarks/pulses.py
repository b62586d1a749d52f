"""How well pulses tune, of the set-point or (in manual) of the manual output, judged on the true plant.

    python -m benchmarks.tuning --method setpoint|manual [--plants N] [--part I/N] [--seeds N] [--cases "PI 1 %;..."]
                                                         [--of-batch | --kept-apart] [--save FILE] [--of FILE]

Each plant has three kinds of present gains: sluggish (Ms 1.1 to 1.2), typical (1.3 to 2) and nearly unstable (2.8 to
3.2), with Ti of half to 2.5 times that of the best PI. Noise is white, its standard deviation a part of the permitted
step of the set-point; a load step is 10 to 50 % of the MV that moves PV by that step (an integrating plant: of 0.3 Ku),
of random sign and time within 3.5 Pu after the first pulse; a drift is in permitted steps per Pu. MV ends at three
times what the permitted step needs, at rest or by the proportional action of the present gains, where "little MV" is
said. Ms 1.6 is asked for. Plant time counts from the first pulse, the trial included, which pulses of the manual output
have not. A plant with a fault of the valve, or whose gain differs above and below rest, is judged where it is steepest.
The plants of the batch are those on which rules are set (--of-batch); the others are kept apart from that.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from benchmarks.cases import ASKED, ONE, TWO, Case
from benchmarks.command import check_names
from benchmarks.disturbances import Disturbance, Disturbed
from benchmarks.drawn_runs import Draw, DrawNames, run_all, saved
from benchmarks.operation import PRESENT, chosen, present_gains
from benchmarks.plants import Plant, plants
from benchmarks.random_plants import random_plants
from benchmarks.tuning import T95_PERIODS, WRONG, Ran, evaluated, loads, some
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import run
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE
from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.manual.procedure import MANUAL, by_manual
from loopwright.tuning.fast.pulses.procedure import SETPOINT, setpoint
from loopwright.tuning.models import sign
from loopwright.tuning.plan import Command, Event, Mode, Sample, SetGains, SetOutput, SetSetpoint, StageStarted
from loopwright.tuning.reasons import Ended

STEP = 1.0
"""The permitted step of the set-point, PV units."""
CASES = {
    case.name: case
    for case in (
        Case("PI 0.5 %", 0.005, limits=math.inf),
        Case("PI 1 %", 0.01, limits=math.inf),
        Case("PI 2 %", 0.02, limits=math.inf),
        Case("PI 1 % + load", 0.01, ONE, limits=math.inf),
        Case("PI 2 % + load", 0.02, ONE, limits=math.inf),
        Case("PI 1 %, drift 1 % in Pu", 0.01, Disturbance(drift=0.01), limits=math.inf),
        Case("PI 1 %, little MV", 0.01, limits=3.0),
        Case("PID 1 %", 0.01, derivative=True, limits=math.inf),
    )
}
FURTHER = {
    case.name: case
    for case in (
        Case("PI 1 %, up", 0.01, limits=math.inf, directions="up"),
        Case("PI 1 %, down", 0.01, limits=math.inf, directions="down"),
        Case("PI 2 % + load, up", 0.02, ONE, limits=math.inf, directions="up"),
        Case("PI 1 %, a step in 0.25 Pu", 0.01, limits=math.inf, sp_rate=4.0),
        Case("PI 1 %, a step in 1 Pu", 0.01, limits=math.inf, sp_rate=1.0),
        Case("PI 1 %, a step in 2 Pu", 0.01, limits=math.inf, sp_rate=0.5),
        Case("PI 1 %, a step in 4 Pu", 0.01, limits=math.inf, sp_rate=0.25),
        Case("PI 1 %, up, a step in 1 Pu", 0.01, limits=math.inf, directions="up", sp_rate=1.0),
    )
}
"""Loops that may be moved to one side only, or no faster than at a rate: asked for by name."""
IN_MANUAL = {
    case.name: case
    for case in (
        *(Case(f"gain below {below:g} of that above", 0.01, Disturbance(below=below), limits=math.inf)
          for below in (0.5, 0.7, 0.85, 1.2, 1.5, 2.0)),
        Case("valve sticks by 0.1", 0.01, Disturbance(stiction=0.1), limits=math.inf),
        Case("valve sticks by 0.3", 0.01, Disturbance(stiction=0.3), limits=math.inf),
        Case("dead band 0.05", 0.01, Disturbance(dead_band=0.05), limits=math.inf),
        Case("dead band 0.2", 0.01, Disturbance(dead_band=0.2), limits=math.inf),
        Case("two loads", 0.01, TWO, limits=math.inf),
        Case("noise of pole 0.8", 0.01, Disturbance(pole=0.8), limits=math.inf),
        Case("T95 a fifth", 0.01, known=0.2, limits=math.inf),
        Case("T95 five times", 0.01, known=5.0, limits=math.inf),
    )
}  # fmt: skip
"""What pulses of the manual output cannot have tried by a step under the new gains: asked for by name."""
EVERY = CASES | FURTHER | IN_MANUAL


@dataclass(frozen=True, slots=True)
class Pulsed(Ran):
    """How one run ended.

    present: the kind of the present gains.
    pv: the largest |PV| before the trial, in permitted steps; at_limit, at_limit_trial: how long MV was at its limit,
    before and in the trial, Pu.
    beyond: the largest PV to the side that is not permitted, in permitted steps; None where both are.
    """

    present: str = ""
    pv: float = 0.0
    at_limit: float = 0.0
    at_limit_trial: float = 0.0
    beyond: float | None = None

    @property
    def draw(self) -> DrawNames:
        return self.plant, self.present, self.case, self.seed


class PulsedLoop(RehearsedLoop):
    """Loads count from the first pulse; the samples since then are kept by stage."""

    def __init__(self, process: Disturbed, channel: Channel, sample_time_s: float) -> None:
        super().__init__(process, channel, sample_time_s)
        self._process = process
        self._stage = ""
        self.taken: dict[str, list[Sample]] = {}

    def step(self, commands: Sequence[Command]) -> Sample:
        if any(isinstance(each, SetSetpoint | SetOutput) for each in commands):
            self._process.relay()
        if any(isinstance(each, SetGains) for each in commands):
            self._process.change()
        sample = super().step(commands)
        self.taken.setdefault(self._stage, []).append(sample)
        return sample

    def hear(self, event: Event) -> None:
        if isinstance(event, StageStarted):
            self._stage = event.stage


def measure(plant: Plant, present: str, case: Case, seed: int, method: str = SETPOINT) -> Pulsed:
    plant = replace(plant, samples=case.samples)
    random = np.random.default_rng([seed, len(plant.name), int(1e6 * plant.Pu), list(PRESENT).index(present)])
    gains = present_gains(plant, present, random)
    model = plant.model()
    unit = STEP * (abs(1.0 / model.static_gain) if math.isfinite(model.static_gain) else 0.3 * plant.Ku)
    limit = min(case.limits * max(unit, gains.Kp * STEP), 1e9)
    process = LinearPlant(plant.num, plant.den, plant.L, plant.Ts, seed=seed)
    disturbed = Disturbed(
        process, case.how, case.noise * STEP, loads(plant, unit, seed, case), STEP, plant.samples, unit, seed
    )
    reverse = sign(model) > 0.0
    settings = Settings(mv_low=-limit, mv_high=limit, pv_low=-1e9, pv_high=1e9, reverse=reverse)
    mode = Mode.MANUAL if method == MANUAL else Mode.AUTOMATIC
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(mode), 0.0)
    facts = Facts(
        plant.Ts, case.known * T95_PERIODS * plant.Pu, -limit, limit, STEP, gains, reverse,
        directions=Directions(case.directions), sp_rate_max_per_s=case.sp_rate * STEP / plant.Pu,
    )  # fmt: skip
    loop, spec = PulsedLoop(disturbed, channel, plant.Ts), case.spec(plant)
    options = DesignOptions(spec.Ms, spec.derivative, spec.Mt, spec.noise_gain, propose_anyway=True)
    begun = time.process_time()
    plan = by_manual(facts, options, MANUAL) if method == MANUAL else setpoint(facts, options)
    result = run(plan, loop, limits=RunLimits(max_time_s=100.0 * plant.Pu), on_event=loop.hear)
    seconds = time.process_time() - begun
    passed = sum(value for stage, value in result.plant_time_s.items() if stage not in (PREFLIGHT, SETTLE)) / plant.Pu
    before = [each for stage in ("pulses", "manual", "design") for each in loop.taken.get(stage, [])]
    trial = loop.taken.get("verify", [])
    ran = Pulsed(
        case.name, plant.name, seed, passed, seconds, present=present,
        pv=max((abs(each.pv) for each in before), default=0.0) / STEP,
        at_limit=sum(abs(each.mv) >= 0.9999 * limit for each in before) / plant.samples,
        at_limit_trial=sum(abs(each.mv) >= 0.9999 * limit for each in trial) / plant.samples,
        beyond=max(-facts.side * each.pv for each in [*before, *trial]) / STEP if facts.one_sided and before else None,
    )  # fmt: skip
    if result.value is None:
        assert isinstance(result.ended, Ended)
        return replace(ran, reason=result.ended.reason.value, detail=result.ended.detail)
    moved = [each.mv for each in before]
    steepest = case.how.steepest(min(moved), max(moved))
    judged = replace(plant, num=tuple(steepest * each for each in plant.num))
    found = evaluated(ran, judged, result.value.gains, spec)
    assert isinstance(found, Pulsed)
    return found


def _measured(given: Draw, method: str) -> Pulsed:
    plant, present, case, seed = given
    return measure(plant, present, EVERY[case], seed, method)


HEAD = (
    "| case | present gains | proposed | time, Pu: p50 / p90 / p99 | error of Ms: p50 / p90 / p99 / max | "
    "J over the best: p50 / p90 / p99 | wrong by 0.1 | unstable | PV, permitted steps: p50 / p90 / max | "
    "MV at its limit, pulses / trial | refused |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def line(name: str, present: str, runs: Sequence[Pulsed]) -> str:
    """One row of the table in Markdown."""
    proposed = [each for each in runs if each.reason is None]
    causes = Counter(each.reason for each in runs if each.reason is not None).most_common()
    errors = [each.error for each in proposed if each.Ms is not None]
    return (
        f"| {name} | {present} | {len(proposed)}/{len(runs)} | {spread([e.passed for e in proposed], 2)} | "
        f"{spread(errors, 3, largest=True)} | {spread([each.ratio for each in proposed if each.ratio], 3)} | "
        f"{sum(error > WRONG for error in errors)} | {len(proposed) - len(errors)} | "
        f"{spread([each.pv for each in runs], 2, (50, 90), largest=True)} | "
        f"{sum(each.at_limit > 0.0 for each in runs)} / {sum(each.at_limit_trial > 0.0 for each in runs)} | "
        f"{', '.join(f'{cause} {count}' for cause, count in causes) or '-'} |"
    )


def spread(values: Sequence[float], digits: int, at: Sequence[int] = (50, 90, 99), largest: bool = False) -> str:
    if not values:
        return "-"
    shown = [*np.percentile(values, at), *([max(values)] if largest else [])]
    return " / ".join(f"{each:.{digits}f}" for each in shown)


def table(runs: Sequence[Pulsed]) -> Iterator[str]:
    yield HEAD
    for name in EVERY:
        of_case = [each for each in runs if each.case == name]
        for present in PRESENT:
            if mine := [each for each in of_case if each.present == present]:
                yield line(name, present, mine)
        if len({each.present for each in of_case}) > 1:
            yield line(name, "all", of_case)


def runs(given: argparse.Namespace) -> Iterator[Pulsed]:
    """The runs asked for: those that the file holds, and the others, on so many processes."""
    cases = given.cases.split(";")
    which = chosen("kept-apart", 1) if given.kept_apart else plants()
    if given.random:
        which = random_plants(given.random)
    if given.of_batch:
        apart = chosen("kept-apart", 1)
        which = [each for each in which if each not in apart]
    which = some(which, given)
    # a batch that is stopped leaves rows of the same plants, drawn at random
    todo: list[Draw] = [
        (which[i], present, case, seed)
        for seed in given.seeds
        for i in np.random.default_rng(seed).permutation(len(which))
        for present, case in product(PRESENT, cases)
    ]
    return run_all(Pulsed, partial(_measured, method=given.method), todo, given.save, given.processes)


def main(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """parser, given: of `benchmarks.tuning`."""
    given.cases = given.cases or ";".join(CASES)
    check_names(parser, "case", given.cases.split(";"), EVERY)
    found = saved(Pulsed, given.of) if given.of else list(runs(given))
    if not found:
        parser.exit(2, f"{parser.prog}: no run: {given.of or 'no plants or no seeds'}\n")
    print(*table(found), sep="\n")
    for name in FURTHER:
        if beyond := [each.beyond for each in found if each.case == name and each.beyond is not None]:
            spread_of = spread(beyond, 2, (50, 90), largest=True)
            print(f"\n{name}: PV beyond its rest, permitted steps: p50 / p90 / max {spread_of}.")
    seconds = [each.seconds for each in found]
    print(
        f"\n{len(found)} runs, {np.median(seconds):.2f} s of processor each (median), {np.mean(seconds):.2f} s (mean), "
        f"{max(seconds):.2f} s (most); Ms {ASKED:g} asked for."
    )
    for each in found:
        if each.reason is None and each.error > WRONG:
            print(f"{each.case}, {each.plant}, {each.present}, seed {each.seed}: Ms {each.Ms}")
