"""How well the fast procedure tunes: many plants, several seeds, noise and load steps, judged on the true plant.

    python -m benchmarks.tuning [--plants N] [--part I/N] [--seeds N] [--cases "PI 1 %;..."] [--save FILE] [--of FILE]
    python -m benchmarks.tuning --method setpoint ...       # pulses of the set-point: `benchmarks.pulses`
    python -m benchmarks.tuning --cases trouble [--method setpoint] ...      # plants in trouble: `benchmarks.trouble`
    python -m benchmarks.tuning --random 1000-1099 [--method setpoint] ...   # plants drawn at random

The plants are 70 of the Astrom-Hagglund batch, the 50 models of the five-stage paper and the linearised reactor (every
n-th with --plants N). Each run is a rehearsal: listening, relay, fit, step, fit. Noise is white, its standard deviation
a part of PV's span under the noise-free relay; a load step is 10 to 50 % of the relay's larger amplitude, of random
sign and time within 3.5 Pu after the relay starts. "--cases further" takes the other disturbances. Ms 1.6 is asked
for; the sampled controller's Ts/2 counts as dead time on the true plant. J is the criterion of `tuning.fast.design`,
against the best PI (or PID) on the true plant.
Plant time counts from the start of the relay. A result is silently wrong when it is proposed and Ms is off by more
than 0.1.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.cases import ASKED, CASES, FURTHER, PI, PLAIN, Case
from benchmarks.command import check_names, parser_of
from benchmarks.disturbances import Disturbed
from benchmarks.drawn_runs import kept, saved
from benchmarks.plants import REACTOR, SAMPLES_PER_PERIOD, Plant, plants
from benchmarks.random_plants import random_plants
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim import reactor
from loopwright.plantsim.plant import LinearPlant
from loopwright.plantsim.plant import Plant as Simulated
from loopwright.plantsim.reactor import Reactor
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE, at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.design import DesignSpec, GainDesign
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.relay.procedure import MIN_SAMPLES, FastOptions, FastProposal, fast
from loopwright.tuning.fast.relay.relay_test import RelayTest
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import sign
from loopwright.tuning.plan import Command, Event, Mode, Plan, Sample, StageStarted
from loopwright.tuning.reasons import Ended

T95_PERIODS = 3.0
WRONG = 0.1


class Troubled(RehearsedLoop):
    """Some samples do not arrive, never two in a row; the plant changes as the new gains take over."""

    def __init__(self, process: Disturbed, channel: Channel, sample_time_s: float, lost: float, seed: int) -> None:
        super().__init__(process, channel, sample_time_s)
        self._process, self._lost, self._random = process, lost, np.random.default_rng([seed, 2])
        self._relaying = False
        self.taken: list[Sample] = []

    def step(self, commands: Sequence[Command]) -> Sample:
        sample = super().step(commands)
        relaying = sample.mode == Mode.EXPERIMENT
        if self._relaying and not relaying:
            self._process.change()
        elif relaying and not self._relaying:
            self._process.relay()
        self._relaying = relaying
        if self._random.random() < self._lost:
            sample = super().step(())
        self.taken.append(sample)
        return sample

    def hear(self, event: Event) -> None:
        """The last look at the loop is where its record begins."""
        if isinstance(event, StageStarted) and event.stage == PREFLIGHT:
            self.taken.clear()

    def record(self, tail: int) -> ExperimentRecord | None:
        """Of what was taken, without the last so many samples."""
        columns = zip(*self.taken[: len(self.taken) - tail], strict=True)
        named = dict(zip(("t_s", "sp", "pv", "mv", "mode"), columns, strict=True))
        record = stored_record({"stage": len(named["t_s"]) * [PREFLIGHT], **named})
        return record.experiment_record() if record else None


def loop_of(
    plant: Plant, amplitude: float, deviation: float, noise: float, seed: int, case: Case = PLAIN
) -> tuple[Troubled, Facts]:
    """A loop at rest under sluggish gains, in deviation variables. deviation: the largest permitted set-point step."""
    process: Simulated = LinearPlant(plant.num, plant.den, plant.L, plant.Ts, noise_std=noise, seed=seed)
    nominal = (0.0, 0.0)
    if case.nonlinear:
        process, nominal = Reactor(plant.Ts, noise, seed), (reactor.MV_NOMINAL, reactor.STEADY_STATE[2])
    reverse = sign(plant.model()) > 0.0
    limit = case.limits * amplitude
    settings = Settings(mv_low=-limit, mv_high=limit, pv_low=-1e9, pv_high=1e9, reverse=reverse)
    gains = Gains(Kp=0.15 * plant.Ku, Ti=2.0 * plant.Pu)
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    facts = Facts(plant.Ts, case.known * T95_PERIODS * plant.Pu, -limit, limit, deviation, gains, reverse)
    steps = loads(plant, amplitude, seed, case)
    troubled = Disturbed(process, case.how, noise, steps, 2.0 * deviation, plant.samples, amplitude, seed, nominal)
    return Troubled(troubled, channel, plant.Ts, case.lost, seed), facts


def loads(plant: Plant, amplitude: float, seed: int, case: Case) -> list[tuple[int, float]]:
    """Of each step of the load: the sample, from the start of the relay (of the first listening), and its size."""
    random = np.random.default_rng([seed, len(plant.name), int(1e6 * plant.Pu)])
    found = []
    for i in range(case.how.loads):
        size = float(random.choice((-1.0, 1.0)) * random.uniform(0.1, 0.3 if i else 0.5))
        if case.how.unrest and not i:
            at = case.known * T95_PERIODS * plant.samples / 2.0 * random.uniform(0.0, 1.0)
        else:
            at = plant.samples * random.uniform(*(3.0, 5.5) if i else (0.0, 3.5))
        found.append((round(at), amplitude * size))
    return found


def relay_span(plant: Plant) -> float:
    """Of PV under four switches of a relay of amplitude 1, without noise."""

    def plan(facts: Facts) -> Plan[float]:
        point, listened = yield from at_rest(facts, 0.0, MIN_SAMPLES)
        experiment = RelayTest(facts, point, listened, 1.0)
        yield from experiment.relay(4)
        return experiment.experiment_record().output_range

    loop, facts = loop_of(plant, 1.0, 1.0 / plant.Ku, 0.0, 1)
    result = run(plan(facts), loop, limits=RunLimits())
    assert result.value is not None, result.ended
    return result.value


@dataclass(frozen=True, slots=True)
class Ran:
    """How one run ended. passed: in Pu.  Ms, ratio (J over the best): on the true plant, None where it is unstable.

    reason: why nothing was proposed, None if something was.  seconds: of processor.  over: how far the bound that binds
    is missed, of Ms, Mt or (relative) the noise gain.
    """

    case: str
    plant: str
    seed: int
    passed: float
    seconds: float
    reason: str | None = None
    detail: str = ""
    Ms: float | None = None
    ratio: float | None = None
    over: float | None = None

    @property
    def error(self) -> float:
        over = self.over if self.over is not None or self.Ms is None else self.Ms - ASKED
        return math.inf if over is None else abs(over)


@cache
def optimum(plant: Plant, spec: DesignSpec) -> tuple[GainDesign, float, tuple[float, float]]:
    """The design on the true plant, its J, and the least integrals that J is counted in."""
    design = GainDesign(plant.model(), spec, plant.Pu)
    best = design.best()
    assert design.minimum is not None
    return design, best.J, (design.minimum.setpoint, design.minimum.load)


@cache
def span_of(plant: Plant) -> float:
    return relay_span(plant)


def fast_run(plant: Plant, case: Case, seed: int) -> tuple[RunResult[FastProposal], float]:
    """What the procedure came to, and its time from the start of the relay, Pu."""
    result, passed, _ = _run(plant, case, seed)
    return result, passed


def _run(plant: Plant, case: Case, seed: int) -> tuple[RunResult[FastProposal], float, Troubled]:
    span = case.amplitude * span_of(replace(plant, samples=SAMPLES_PER_PERIOD))
    # a step that the preflight can tell from the noise
    deviation = span * max(0.5, 12.0 * case.noise)
    loop, facts = loop_of(plant, case.amplitude, deviation, case.noise * span, seed, case)
    spec = case.spec(plant)
    amplitude = None if case.adapted else case.amplitude
    # what is judged is the design, whatever it is worth beside the gains that the loop has to begin with
    options = FastOptions(spec.Ms, spec.derivative, spec.Mt, spec.noise_gain, amplitude=amplitude, propose_anyway=True)
    result = run(fast(facts, options), loop, limits=RunLimits(max_time_s=100.0 * plant.Pu), on_event=loop.hear)
    passed = sum(value for stage, value in result.plant_time_s.items() if stage not in (PREFLIGHT, SETTLE))
    return result, passed / plant.Pu, loop


def measure(case: Case, plant: Plant, seed: int) -> Ran:
    plant = replace(plant, samples=case.samples)
    start = time.process_time()
    result, passed, loop = _run(plant, case, seed)
    seconds = time.process_time() - start
    ran = Ran(case.name, plant.name, seed, passed, seconds)
    if result.value is None:
        assert isinstance(result.ended, Ended)
        return replace(ran, reason=result.ended.reason.value, detail=result.ended.detail)
    gains = result.value.gains
    if case.tail:
        evidence = loop.record(round(case.tail * case.samples))
        assert evidence is not None
        again = evaluate_again(evidence, case.spec(plant))
        if again.reason is not None:
            return replace(ran, reason=again.reason, detail=again.detail)
        gains = again.best.gains
    # a plant that has changed is judged as it is now, a curved one where the test found it steepest
    moved = [each.mv for each in loop.taken]
    gain = case.how.gain * case.how.steepest(min(moved), max(moved))
    now = replace(plant, num=tuple(gain * c for c in plant.num), L=plant.L + case.how.later * plant.Pu)
    return evaluated(ran, now, gains, case.spec(plant))


def evaluated(ran: Ran, plant: Plant, gains: Gains, spec: DesignSpec = PI) -> Ran:
    """With what the gains are worth on the true plant."""
    true = margins(plant.model(), gains)
    if not true.stable:
        return ran
    over = true.Ms - spec.Ms
    if spec.Mt is not None:
        over = max(over, true.Mt - spec.Mt)
    if spec.noise_gain is not None:
        over = max(over, gains.Kp * (1.0 + spec.N if gains.Td else 1.0) / spec.noise_gain - 1.0)
    return replace(ran, Ms=true.Ms, over=over, ratio=cost_over_best(plant, gains, spec))


def cost_over_best(plant: Plant, gains: Gains, spec: DesignSpec = PI) -> float:
    """J of gains that are stable on the true plant, over that of the best PI (or PID) for it."""
    design, best, minimum = optimum(plant, spec)
    cost, share = design.cost(gains.Kp, gains.Ti, gains.Td, design.spec.N, gains.b), spec.aim.share
    return (share * cost.setpoint / minimum[0] + (1.0 - share) * cost.load / minimum[1]) / best


def line(name: str, runs: Sequence[Ran]) -> str:
    """One row of the table in Markdown."""
    proposed = [each for each in runs if each.reason is None]
    causes = Counter(each.reason for each in runs if each.reason is not None).most_common()
    errors = [each.error for each in proposed if each.Ms is not None]
    within = " / ".join(f"{100.0 * sum(e <= limit for e in errors) / max(len(errors), 1):.1f}" for limit in (0.1, 0.05))
    return (
        f"| {name} | {len(proposed)}/{len(runs)} | {spread([each.passed for each in proposed], 2)} | "
        f"{spread(errors, 3)} | {within} | {spread([each.ratio for each in proposed if each.ratio], 3)} | "
        f"{sum(error > WRONG for error in errors)} | {len(proposed) - len(errors)} | "
        f"{', '.join(f'{cause} {count}' for cause, count in causes) or '-'} |"
    )


HEAD = (
    "| case | proposed | time, Pu: p50 / p90 / max | error of Ms: p50 / p90 / max | within 0.1 / 0.05, % | "
    "J over the best: p50 / p90 / max | silently wrong | unstable | refused |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def spread(values: Sequence[float], digits: int) -> str:
    if not values:
        return "-"
    return " / ".join(f"{v:.{digits}f}" for v in (*np.percentile(values, (50, 90)), max(values)))


def runs_parser(doc: str | None) -> argparse.ArgumentParser:
    """With what every table of runs asks for."""
    parser = parser_of(doc)
    parser.add_argument("--plants", type=int, help="so many, spread over the list; by default all")
    parser.add_argument(
        "--part", type=_part, default="0/1", metavar="I/N", help="every N-th of these plants, from the I-th on"
    )
    parser.add_argument(
        "--random", type=numbers_of, metavar="FIRST-LAST", help="plants drawn at random: `benchmarks.random_plants`"
    )
    parser.add_argument("--seeds", type=numbers_of, default="1", metavar="N", help="so many, or FIRST-LAST")
    parser.add_argument("--save", type=Path, help="a line of JSON for every run; what it holds is not run again")
    parser.add_argument("--of", type=Path, help="the table of such a file, nothing is run")
    return parser


def _part(text: str) -> tuple[int, int]:
    part, parts = map(int, text.split("/"))
    if not 0 <= part < parts:
        raise ValueError(text)
    return part, parts


def numbers_of(text: str) -> range:
    """The numbers of "FIRST-LAST", or from 1 to the one given."""
    first, _, last = text.rpartition("-")
    return range(int(first or 1), int(last) + 1)


def runs_of(parser: argparse.ArgumentParser, given: argparse.Namespace, runs: Iterator[Ran]) -> list[Ran]:
    """Those of the file that was asked for, or what is run now; at least one."""
    found = saved(Ran, given.of) if given.of else list(runs)
    if not found:
        parser.exit(2, f"{parser.prog}: no run: {given.of or 'no plants or no seeds'}\n")
    return found


def main() -> None:
    parser = runs_parser(__doc__)
    parser.add_argument("--method", choices=("fast", "setpoint", "manual"), default="fast")
    parser.add_argument("--cases", help="names, separated by ';', or 'further' (fast), or 'trouble'")
    apart = parser.add_mutually_exclusive_group()
    apart.add_argument("--of-batch", action="store_true", help="pulses: the plants of the batch alone")
    apart.add_argument("--kept-apart", action="store_true", help="pulses: the other plants alone")
    parser.add_argument(
        "--processes", type=int, default=2, help="of pulses and of trouble, at the same time (default: %(default)s)"
    )
    given = parser.parse_args()
    from benchmarks import pulses  # these need this module
    from benchmarks.trouble import report

    if given.cases and report.is_trouble(given.cases):
        report.main(parser, given)
        return
    if given.method != "fast":
        pulses.main(parser, given)
        return
    given.cases = given.cases or ";".join(CASES)
    if given.cases == "further":
        given.cases = ";".join(FURTHER)
    check_names(parser, "case", given.cases.split(";"), CASES | FURTHER)
    runs = runs_of(parser, given, _runs(given))
    print(HEAD)
    for name in CASES | FURTHER:
        if of_case := [each for each in runs if each.case == name]:
            print(line(name, of_case))
    seconds = [each.seconds for each in runs]
    print(f"\n{len(runs)} runs, {np.median(seconds):.2f} s of processor each (median), {max(seconds):.2f} s (most).")
    for each in runs:
        if each.reason is not None:
            print(f"{each.case}, {each.plant}, seed {each.seed}: {each.reason}: {each.detail}")
        elif each.error > WRONG:
            print(f"{each.case}, {each.plant}, seed {each.seed}: Ms {each.Ms}")


def asked_for(given: argparse.Namespace) -> list[Plant]:
    """Of the list, or those drawn at random."""
    return some(random_plants(given.random) if given.random else plants(), given)


def some(everything: Sequence[Plant], given: argparse.Namespace) -> list[Plant]:
    """As many of these plants as were asked for, spread over the list."""
    step = len(everything) / min(given.plants or len(everything), len(everything))
    part, parts = given.part
    chosen = [everything[int(i * step)] for i in range(round(len(everything) / step))]
    return chosen[part::parts]


def _runs(given: argparse.Namespace) -> Iterator[Ran]:
    chosen = asked_for(given)
    cases = given.cases.split(";")
    done = {(ran.case, ran.plant, ran.seed): ran for ran in saved(Ran, given.save)}
    # a batch that is stopped leaves rows of the same plants, drawn at random
    for seed in given.seeds:
        shuffled = [chosen[i] for i in np.random.default_rng(seed).permutation(len(chosen))]
        for plant in shuffled:
            for case in ((CASES | FURTHER)[name] for name in cases):
                if case.nonlinear and plant.name != REACTOR:
                    continue
                yield done.get((case.name, plant.name, seed)) or kept(measure(case, plant, seed), given.save)


if __name__ == "__main__":
    main()
