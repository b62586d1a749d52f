"""A sensor that lies within PV's limits, in each phase of each procedure: how soon the test ends, how far the true PV
has gone by then; and how often a true one is taken for false.

The rules were set on RULE_PLANTS, and are judged on JUDGED, which were written down before the first run and never
looked at while a rule was set. A false sensor sends, from a moment on that is drawn within a phase: its last value,
0.0, half its last value, half of what it should (`halved`), its last value with a quarter of its noise (`quiet`) or
with four times of it (`loud`). The test has to end as FalsePv within 15 samples or Pu / 10, whichever is longer, and
twice the longest run of equal values at rest; in that time and a dead time the true PV may go as far as the highest and
the lowest MV of the test take it. A true sensor is rounded to 0.1 to 3 noises, renewed every 2 to 20 samples, without
noise, on a fast plant, and under a stepped load.

    python -m benchmarks.false_sensor
    python -m benchmarks.false_sensor --true 100 --whole --moments 1 --plants rule
"""

from __future__ import annotations

import copy
import json
import math
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from benchmarks.command import parser_of
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.plantsim.sensors import SensedPlant, SensorFault
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE, at_rest
from loopwright.tuning.experiments.primitives import Facts, record
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.manual.procedure import MANUAL, by_manual
from loopwright.tuning.fast.pulses.procedure import SETPOINT, setpoint
from loopwright.tuning.fast.relay.procedure import FAST, FastOptions, fast
from loopwright.tuning.fast.relay.relay_test import RelayTest
from loopwright.tuning.five_stage.procedure import PROCEDURE, Options, five_stage
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Command, Event, Mode, Plan, Sample, SetMode, SetOutput, SetSetpoint, StageStarted
from loopwright.tuning.reasons import Ended, FalsePv

SP, MV = 60.0, 40.0
"""Where every loop is at rest."""
METHODS = (FAST, SETPOINT, PROCEDURE, MANUAL)
MOVES = "moves"
RUN_OF_REST, SAMPLES, PART_OF_PERIOD = 2, 15, 10.0
"""The time in which a test has to end."""


@dataclass(frozen=True, slots=True)
class Process:
    """A plant and its loop. num, den, L (s): of the plant.  Ts, T95: s.  step: the permitted set-point step, PV units.
    noise: PV units."""

    name: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Ts: float
    T95: float
    step: float
    noise: float

    @property
    def gain(self) -> float:
        return self.num[-1] / self.den[-1]

    def plant(self) -> LinearPlant:
        return LinearPlant(self.num, self.den, self.L, self.Ts, MV, SP, mv_low=0.0, mv_high=100.0)

    def ultimate(self) -> tuple[float, float]:
        return ultimate_point(TransferFunction(self.num, self.den, self.L + 0.5 * self.Ts))


def lags(K: float, *times: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    den = np.array([1.0])
    for T in times:
        den = np.convolve(den, (T, 1.0))
    return (K,), tuple(map(float, den))


RULE_PLANTS = (
    Process("one lag", *lags(0.8, 30.0), 6.0, 0.5, 100.0, 2.0, 0.05),
    Process("dead time", *lags(0.5, 2.0), 8.0, 0.4, 16.0, 3.0, 0.05),
    Process("two lags, falling", *lags(-0.4, 20.0, 8.0), 4.0, 0.5, 75.0, 2.0, 0.06),
    Process("inverse", (-1.6, 0.8), (9.0, 6.0, 1.0), 1.0, 0.1, 16.0, 3.0, 0.08),
)
JUDGED = (
    Process("lag of 12 s", *lags(1.1, 12.0), 4.0, 0.25, 40.0, 3.0, 0.08),
    Process("three lags", *lags(0.6, 40.0, 15.0, 5.0), 3.0, 0.8, 160.0, 1.5, 0.03),
    Process("long dead time, falling", *lags(-0.7, 6.0), 10.0, 0.5, 28.0, 3.0, 0.1),
    Process("four lags", *lags(0.9, 5.0, 5.0, 5.0, 5.0), 1.0, 0.2, 40.0, 2.0, 0.04),
)


class Tested(RehearsedLoop):
    """A loop whose sensor fails at a sample, and whose load steps at others.

    at: the sample; None for never. stages: where each stage began.
    """

    def __init__(
        self,
        process: Process,
        plant: SensedPlant,
        channel: Channel,
        fault: SensorFault | None = None,
        at: int | None = None,
        loads: Sequence[tuple[int, float]] = (),
    ) -> None:
        super().__init__(plant, channel, process.Ts)
        self.sensed, self._fault, self._at, self._loads = plant, fault, at, dict(loads)
        self.stages: list[tuple[str, int]] = []
        self.samples: list[Sample] = []
        self.true: list[float] = []
        self.at_fault: LinearPlant | None = None

    def hear(self, event: Event) -> None:
        if isinstance(event, StageStarted):
            self.stages.append((event.stage, len(self.samples)))

    def step(self, commands: Sequence[Command]) -> Sample:
        plant = self.sensed.plant
        assert isinstance(plant, LinearPlant)
        if (load := self._loads.get(len(self.samples))) is not None:
            plant.disturbance = load
        if len(self.samples) == self._at:
            self.at_fault = copy.deepcopy(plant)
            self.sensed.fail(self._fault)
        sample = super().step(commands)
        self.samples.append(sample)
        self.true.append(self.sensed.true_pv)
        return sample


@dataclass(frozen=True, slots=True)
class Seen:
    """How the sensor shows PV. quantum: in noises. renewal: in samples. noise: of the process's own."""

    quantum: float = 0.0
    renewal: int = 1
    noise: float = 1.0


def tested(
    process: Process,
    method: str,
    seed: int,
    seen: Seen = Seen(),
    fault: SensorFault | None = None,
    at: int | None = None,
    loads: Sequence[tuple[int, float]] = (),
) -> tuple[RunResult[object], Tested]:
    """The run of a procedure, and its loop."""
    Ku, Pu = process.ultimate()
    gains = Gains(0.25 * Ku, 0.8 * Pu) if method == SETPOINT else Gains(0.15 * Ku, 2.0 * Pu)
    reverse = process.gain > 0.0
    settings = Settings(mv_low=0.0, mv_high=100.0, safe_output=0.0, pv_low=-1e9, pv_high=1e9, reverse=reverse)
    mode = Mode.MANUAL if method == MANUAL else Mode.AUTOMATIC
    channel = Channel(process.Ts, settings, Parameters(gains.Kp, gains.Ti), SP, int(mode), MV)
    facts = Facts(process.Ts, process.T95, 0.0, 100.0, process.step, gains, reverse)
    plans: dict[str, Callable[[], Plan[object]]] = {
        FAST: lambda: fast(facts, FastOptions(propose_anyway=True)),
        SETPOINT: lambda: setpoint(facts, DesignOptions(propose_anyway=True)),
        PROCEDURE: lambda: five_stage(facts, Options(propose_anyway=True)),
        MANUAL: lambda: by_manual(facts, DesignOptions(propose_anyway=True), MANUAL),
        MOVES: lambda: moves(facts, Gains(0.3 * Ku, 0.6 * Pu), Pu),
    }
    noise = seen.noise * process.noise
    plant = SensedPlant(process.plant(), noise, seen.quantum * process.noise, seen.renewal, seed)
    loop = Tested(process, plant, channel, fault, at, loads)
    T95, step = process.T95, process.step
    limits = RunLimits(-1e6, 1e6, 0.0, 100.0, max_time_s=500.0 * T95, max_frozen_s=3.0 * T95, sp_deviation=step)
    return run(plans[method](), loop, limits=limits, on_event=loop.hear), loop


@dataclass(frozen=True, slots=True)
class Case:
    process: Process
    method: str
    phase: str
    fault: SensorFault
    seed: int
    at: int
    seen: Seen = field(default=Seen())


@dataclass(frozen=True, slots=True)
class Found:
    """How a run with a false sensor ended.

    told: it ended as FalsePv. samples: from the fault to the end. allowed: the largest number of them. beyond: how far
    the true PV went beyond what it may, PV units; 0 for not at all.
    """

    case: Case
    reason: str
    told: bool
    samples: int
    allowed: float
    beyond: float

    @property
    def good(self) -> bool:
        return self.told and self.samples <= self.allowed and self.beyond <= 0.0


def phases(process: Process, method: str, seed: int, seen: Seen = Seen()) -> dict[str, list[tuple[int, int]]]:
    """The first and the last sample of each phase of a run with a true sensor after the preflight."""
    _, loop = tested(process, method, seed, seen)
    found: dict[str, list[tuple[int, int]]] = {}
    starts = [*loop.stages, ("", len(loop.samples))]
    for (stage, begin), (_, end) in pairwise(starts):
        if stage not in (PREFLIGHT, SETTLE) and end - begin > 2 * SAMPLES:
            found.setdefault(stage, []).append((begin, end))
    return found


def cases(processes: Sequence[Process], methods: Sequence[str], moments: int, seed: int) -> Iterator[Case]:
    for process in processes:
        for method in methods:
            rng = random.Random(f"{process.name} {method} {seed}")
            for phase, parts in phases(process, method, seed).items():
                for fault in SensorFault:
                    for _ in range(moments):
                        begin, end = rng.choice(parts)
                        yield Case(process, method, phase, fault, seed, rng.randrange(begin + 3, end - SAMPLES))


def measured(case: Case) -> Found:
    process = case.process
    result, loop = tested(process, case.method, case.seed, case.seen, case.fault, case.at)
    begun = next(at for stage, at in loop.stages if stage not in (PREFLIGHT, SETTLE))
    run = longest_run([sample.pv for sample in loop.samples[:begun]])
    _, Pu = process.ultimate()
    allowed = max(SAMPLES, Pu / PART_OF_PERIOD / process.Ts) + RUN_OF_REST * run
    ended = result.ended
    samples = len(loop.samples) - case.at
    return Found(
        case,
        ended.reason.value if ended else "proposed",
        isinstance(ended, FalsePv),
        samples,
        allowed,
        _beyond(process, loop, case.at, allowed),
    )


def longest_run(pv: Sequence[float]) -> int:
    edges = np.flatnonzero(np.diff(pv)) + 1
    return int(np.diff([0, *edges, len(pv)]).max())


def _beyond(process: Process, loop: Tested, at: int, allowed: float) -> float:
    """How far the true PV went beyond where the highest and the lowest MV of the test take it in the samples allowed
    and a dead time."""
    if loop.at_fault is None:
        return math.inf
    mv = [sample.mv for sample in loop.samples]
    samples = math.ceil(allowed + process.L / process.Ts)
    ways = []
    for held in (min(mv), max(mv)):
        plant = copy.deepcopy(loop.at_fault)
        ways += [plant.pv, *(plant.step(held) for _ in range(samples))]
    true = loop.true[at:]
    return max(0.0, max(true) - max(ways) - 1e-9, min(ways) - min(true) - 1e-9)


def moves(facts: Facts, gains: Gains, period_s: float) -> Plan[object]:
    """What the procedures move on a loop, without their computations: the relay, set-point steps under gains on trial,
    pulses of the set-point and of the manual output."""
    point, listened = yield from at_rest(facts, 0.0)
    test = RelayTest(facts, point, listened, None)
    yield from test.relay(8)
    yield from test.step(gains, period_s)
    yield from test.step_back()
    span = 0.4 * facts.T95_s + period_s
    for part in (1.0, -1.0, 1.0, 0.0):
        yield from record(span, (SetSetpoint(point.sp + part * facts.sp_deviation),))
    yield from record(span, (SetMode(Mode.MANUAL), SetOutput(point.mv)))
    for part in (1.0, -1.0, 0.5):
        yield from record(0.3 * span, (SetOutput(point.mv + 0.5 * part * point.room),))
        yield from record(span, (SetOutput(point.mv),))
    return None


def true_sensor(seed: int, quick: bool = True) -> tuple[str, Ended | None]:
    """A run with a true sensor, drawn; what it was, and how it ended.

    quick: of the moves of the procedures, or of five-stage, rather than of any procedure with its computations.
    """
    rng = random.Random(f"true {seed}")
    process = drawn_process(rng)
    method = rng.choice((MOVES, MOVES, MOVES, PROCEDURE)) if quick else rng.choice(METHODS)
    kind = rng.choice(("rounded", "renewed", "both", "no noise", "no noise, rounded", "loaded", "loaded"))
    seen = {
        "rounded": Seen(quantum=rng.uniform(0.1, 3.0)),
        "renewed": Seen(renewal=rng.randint(2, 20)),
        "both": Seen(rng.uniform(0.1, 3.0), rng.randint(2, 10)),
        "no noise": Seen(noise=0.0, renewal=rng.choice((1, 1, rng.randint(2, 20)))),
        "no noise, rounded": Seen(rng.uniform(0.1, 10.0), noise=0.0),
        "loaded": Seen(),
    }[kind]
    loads: list[tuple[int, float]] = []
    if kind == "loaded" or rng.random() < 0.4:
        span = process.T95 / process.Ts
        for _ in range(rng.randint(1, 3)):
            loads.append((int(rng.uniform(0.6, 4.0) * span), rng.choice((-1, 1)) * rng.uniform(2.0, 40.0)))
    result, _ = tested(process, method, seed, seen, loads=loads)
    words = f"{seed}: {method}, {kind}, {seen}, {len(loads)} loads, {process.name}"
    return words, result.ended


def drawn_process(rng: random.Random) -> Process:
    """A plant of one to three lags, or with a dead time beside which they hardly count, sampled finely or coarsely."""
    K = rng.choice((-1.0, 1.0)) * rng.uniform(0.3, 2.0)
    T = 10.0 ** rng.uniform(0.0, 2.0)
    kind = rng.choice(("lags", "lags", "fast", "near the sampling"))
    L = T * rng.uniform(0.05, 1.0)
    count = rng.randint(1, 3)
    Ts = (L + 0.3 * count * T) / rng.uniform(15.0, 80.0)
    if kind != "lags":
        count, L = 1, T * rng.uniform(3.0, 20.0)
        Ts = L / rng.uniform(10.0, 50.0)
        if kind == "near the sampling":
            T = Ts * rng.uniform(0.5, 2.0)
    times = [T * rng.uniform(0.2, 1.0) ** n for n in range(count)]
    T95 = (L + 3.0 * sum(times)) * rng.uniform(0.8, 1.5)
    step = abs(K) * rng.uniform(2.0, 6.0)
    num, den = lags(K, *times)
    name = f"{kind}: K {K:.2f}, T {', '.join(f'{each:.3g}' for each in times)}, L {L:.3g}, Ts {Ts:.3g}, T95 {T95:.3g}"
    return Process(name, num, den, L, Ts, T95, step, step * rng.uniform(0.005, 0.04))


def figures(found: Sequence[Found]) -> dict[str, object]:
    """Of each kind of fault: how many ended in time, how many ended as FalsePv at all."""
    answer: dict[str, object] = {}
    for fault in SensorFault:
        of = [each for each in found if each.case.fault is fault]
        late = [each for each in of if not each.good]
        answer[fault.value] = {
            "runs": len(of),
            "in_time": len(of) - len(late),
            "false_pv": sum(each.told for each in of),
            "median_of_allowed": float(np.median([each.samples / each.allowed for each in of])) if of else None,
            "late": dict(Counter(f"{each.case.method} {each.case.phase}: {each.reason}" for each in late)),
        }
    return answer


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--plants", choices=("rule", "judged"), default="judged", help="default: judged")
    parser.add_argument("--moments", type=int, default=2, help="of each phase, for each fault (default: 2)")
    parser.add_argument("--true", type=int, default=1000, help="runs with a true sensor (default: 1000)")
    parser.add_argument("--first", type=int, default=1, help="the seed of the first of them (default: 1)")
    parser.add_argument("--whole", action="store_true", help="these with whole procedures, which compute for seconds")
    parser.add_argument("--methods", nargs="*", default=METHODS, choices=METHODS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="each run that is not as it should be")
    given = parser.parse_args(argv)
    processes = RULE_PLANTS if given.plants == "rule" else JUDGED
    found = [measured(case) for case in cases(processes, given.methods, given.moments, given.seed)]
    alarms, ends = [], Counter[str]()
    for seed in range(given.first, given.first + given.true):
        words, ended = true_sensor(seed, not given.whole)
        ends[ended.reason.value if ended else "through"] += 1
        if isinstance(ended, FalsePv):
            alarms.append(f"{words}: {ended}")
    if given.show:
        for each in found:
            if not each.good:
                print(each, file=sys.stderr)
        for alarm in alarms:
            print(alarm, file=sys.stderr)
    answer = {"false": figures(found), "true": {"runs": given.true, "alarms": len(alarms), "ended": dict(ends)}}
    print(json.dumps(answer, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
