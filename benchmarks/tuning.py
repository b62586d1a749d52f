"""How well the fast procedure tunes: many plants, several seeds, noise and load steps, judged on the true plant.

    python -m benchmarks.tuning [--plants N] [--part I/N] [--seeds N] [--cases "PI 1 %;..."] [--save FILE] [--of FILE]

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
import json
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import ss2tf

from benchmarks.disturbances import Disturbance, Disturbed
from controller.channel import Channel, Settings
from controller.pid import Parameters
from plantsim import reactor
from plantsim.plant import LinearPlant
from plantsim.plant import Plant as Process
from plantsim.reactor import Reactor
from service.rehearsal import RehearsedLoop
from service.runner import RunResult, Watch, run
from tuning.fast.design import Design, Wish
from tuning.fast.experiment import Experiment
from tuning.fast.procedure import LEAST_SAMPLES, FastOptions, FastProposal, fast
from tuning.gains import Gains
from tuning.margins import margins, ultimate_point
from tuning.models import TransferFunction, sign
from tuning.plan import Command, Mode, Plan, Sample
from tuning.reasons import Ended
from tuning.stages.common import Facts
from tuning.stages.preflight import at_rest

SAMPLES_PER_PERIOD = 80
T95_PERIODS = 3.0
ASKED = 1.6
PI = Wish(ASKED)
WRONG = 0.1
REACTOR = "reactor"


@dataclass(frozen=True, slots=True)
class Plant:
    name: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Ku: float
    Pu: float
    samples: int = SAMPLES_PER_PERIOD

    @property
    def Ts(self) -> float:
        return self.Pu / self.samples

    def model(self) -> TransferFunction:
        """With the sampled controller's half sample."""
        return TransferFunction(self.num, self.den, self.L + 0.5 * self.Ts)


UNDISTURBED = Disturbance()


@dataclass(frozen=True, slots=True)
class Case:
    """noise: of the span.  derivative: PID.  lost: share of the samples that do not arrive.

    samples: in Pu.  known: T95 as it is said over 3 Pu.  adapted: so many times the amplitude is where MV ends, and the
    procedure finds the amplitude itself.  limits: of MV, amplitudes.  Mt, noise_gain: bounds on them, this in Ku.
    """

    name: str
    noise: float
    how: Disturbance = UNDISTURBED
    derivative: bool = False
    samples: int = SAMPLES_PER_PERIOD
    known: float = 1.0
    limits: float = 2.0
    adapted: bool = False
    lost: float = 0.0
    amplitude: float = 1.0
    nonlinear: bool = False
    Mt: float | None = None
    noise_gain: float | None = None

    def wish(self, plant: Plant) -> Wish:
        bound = None if self.noise_gain is None else self.noise_gain * plant.Ku
        return Wish(ASKED, self.derivative, self.Mt, bound)


PLAIN = Case("", 0.0)
ONE, TWO = Disturbance(loads=1), Disturbance(loads=2)
CASES = {
    case.name: case
    for case in (
        Case("PI 0.5 %", 0.005),
        Case("PI 1 %", 0.01),
        Case("PI 2 %", 0.02),
        Case("PI 0.5 % + load", 0.005, ONE),
        Case("PI 1 % + load", 0.01, ONE),
        Case("PI 2 % + load", 0.02, ONE),
        Case("PID 1 %", 0.01, derivative=True),
    )
}
FURTHER = {
    case.name: case
    for case in (
        Case("noise 5 %", 0.05),
        Case("noise of pole 0.5", 0.01, Disturbance(pole=0.5)),
        Case("noise of pole 0.8", 0.01, Disturbance(pole=0.8)),
        Case("spikes, 1 in 100", 0.01, Disturbance(spikes=0.01)),
        Case("PV in steps of span/100", 0.005, Disturbance(quantum=0.01)),
        Case("PV in steps of span/50", 0.005, Disturbance(quantum=0.02)),
        Case("PV in steps of span/50, no noise", 0.0, Disturbance(quantum=0.02)),
        Case("drift 2 % in Pu", 0.01, Disturbance(drift=0.02)),
        Case("two loads", 0.01, TWO),
        Case("not at rest", 0.01, Disturbance(loads=1, unrest=True)),
        Case("valve sticks by 0.1", 0.01, Disturbance(stiction=0.1)),
        Case("valve sticks by 0.3", 0.01, Disturbance(stiction=0.3)),
        Case("dead band 0.05", 0.01, Disturbance(dead_band=0.05)),
        Case("dead band 0.2", 0.01, Disturbance(dead_band=0.2)),
        Case("actuator ends at 0.7", 0.01, Disturbance(ends=0.7)),
        Case("MV ends at 1.05", 0.01, limits=1.05),
        Case("amplitude found, much room", 0.01, limits=20.0, adapted=True),
        Case("amplitude found, little room", 0.01, limits=0.8, adapted=True),
        Case("T95 a tenth", 0.01, known=0.1),
        Case("T95 ten times", 0.01, known=10.0),
        Case("Ts = Pu/30", 0.01, samples=30),
        Case("Ts = Pu/100", 0.01, samples=100),
        Case("2 % of samples lost", 0.01, lost=0.02),
        Case("gain doubles with the new gains", 0.01, Disturbance(gain=2.0)),
        Case("gain falls to 0.4 with them", 0.01, Disturbance(gain=0.4)),
        Case("dead time 0.25 Pu longer with them", 0.01, Disturbance(later=0.25)),
        Case("Mt at most 1.05", 0.01, Mt=1.05),
        Case("noise gain at most 0.25 Ku", 0.01, noise_gain=0.25),
        Case("PID, noise gain at most 2 Ku", 0.01, derivative=True, noise_gain=2.0),
        Case("nonlinear reactor, 5 %", 0.01, amplitude=5.0, nonlinear=True),
        Case("nonlinear reactor, 15 %", 0.01, amplitude=15.0, nonlinear=True),
    )
}


class Troubled(RehearsedLoop):
    """Some samples do not arrive, never two in a row; the plant changes as the new gains take over."""

    def __init__(self, process: Disturbed, channel: Channel, sample_time_s: float, lost: float, seed: int) -> None:
        super().__init__(process, channel, sample_time_s)
        self._process, self._lost, self._random = process, lost, np.random.default_rng([seed, 2])
        self._relaying = False

    def step(self, commands: Sequence[Command]) -> Sample:
        sample = super().step(commands)
        relaying = sample.mode == Mode.EXPERIMENT
        if self._relaying and not relaying:
            self._process.change()
        elif relaying and not self._relaying:
            self._process.relay()
        self._relaying = relaying
        return super().step(()) if self._random.random() < self._lost else sample


def plants() -> list[Plant]:
    batch = json.loads((Path(__file__).parent.parent / "tests/data/plants-batch.json").read_text())["processes"]
    found = [Plant(p["id"], tuple(p["num"]), tuple(p["den"]), p["delay"], p["Ku"], p["Tu"]) for p in batch]
    for m in json.loads((files("plantsim") / "models-50.json").read_text())["models"]:
        found.append(_of(f"model-{m['id']}", TransferFunction(tuple(m["num"]), tuple(m["den"]), m["delay"])))
    found.append(_of(REACTOR, linear_reactor()))
    return found


def _of(name: str, model: TransferFunction) -> Plant:
    Ku, Pu = ultimate_point(model)
    return Plant(name, model.num, model.den, model.L, Ku, Pu)


def linear_reactor() -> TransferFunction:
    """The reactor around its steady state, by central differences; its actuator and sensor with it."""
    at = np.array([*reactor.STEADY_STATE, reactor.MV_NOMINAL])

    def slope(x: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, c, h, T, opening = map(float, x)
        return np.array(reactor.derivative((a, b, c, h, T), opening, reactor.INLET))

    moves = np.diag(1e-5 * at)
    jacobian = np.array([(slope(at + m) - slope(at - m)) / (2.0 * m.sum()) for m in moves]).T
    num, den = ss2tf(jacobian[:, :5], jacobian[:, 5:], np.eye(5)[2:3], np.zeros((1, 1)))
    lagged = np.convolve(den, (reactor.ACTUATOR_LAG_S, 1.0))
    return TransferFunction(tuple(num[0][1:]), tuple(lagged), reactor.SENSOR_DELAY_S)


def loop_of(
    plant: Plant, amplitude: float, deviation: float, noise: float, seed: int, case: Case = PLAIN
) -> tuple[RehearsedLoop, Facts]:
    """A loop at rest under sluggish gains, in deviation variables. deviation: the largest permitted set-point step."""
    process: Process = LinearPlant(plant.num, plant.den, plant.L, plant.Ts, noise_std=noise, seed=seed)
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
        point, listened = yield from at_rest(facts, 0.0, LEAST_SAMPLES)
        experiment = Experiment(facts, point, listened, 1.0)
        yield from experiment.relay(4)
        return experiment.evidence().span

    loop, facts = loop_of(plant, 1.0, 1.0 / plant.Ku, 0.0, 1)
    result = run(plan(facts), loop, watch=Watch())
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
def optimum(plant: Plant, wish: Wish) -> tuple[Design, float, tuple[float, float]]:
    """The design on the true plant, its J, and the least integrals that J is counted in."""
    design = Design(plant.model(), wish, plant.Pu)
    best = design.best()
    assert design.least is not None
    return design, best.J, (design.least.setpoint, design.least.load)


@cache
def span_of(plant: Plant) -> float:
    return relay_span(plant)


def fast_run(plant: Plant, case: Case, seed: int) -> tuple[RunResult[FastProposal], float]:
    span = case.amplitude * span_of(replace(plant, samples=SAMPLES_PER_PERIOD))
    # a step that the preflight can tell from the noise
    deviation = span * max(0.5, 12.0 * case.noise)
    loop, facts = loop_of(plant, case.amplitude, deviation, case.noise * span, seed, case)
    wish = case.wish(plant)
    options = FastOptions(wish.Ms, wish.derivative, wish.Mt, wish.noise_gain, None if case.adapted else case.amplitude)
    result = run(fast(facts, options), loop, watch=Watch(max_time_s=100.0 * plant.Pu))
    passed = sum(value for stage, value in result.plant_time_s.items() if stage != "preflight")
    return result, passed / plant.Pu


def measure(case: Case, plant: Plant, seed: int) -> Ran:
    plant = replace(plant, samples=case.samples)
    start = time.process_time()
    result, passed = fast_run(plant, case, seed)
    seconds = time.process_time() - start
    ran = Ran(case.name, plant.name, seed, passed, seconds)
    if result.value is None:
        assert isinstance(result.ended, Ended)
        return replace(ran, reason=result.ended.reason.value, detail=result.ended.detail)
    # a plant that has changed is judged as it is now
    now = replace(plant, num=tuple(case.how.gain * c for c in plant.num), L=plant.L + case.how.later * plant.Pu)
    return judged(ran, now, result.value.gains, case.wish(plant))


def judged(ran: Ran, plant: Plant, gains: Gains, wish: Wish = PI) -> Ran:
    """With what the gains are worth on the true plant."""
    true = margins(plant.model(), gains)
    if not true.stable:
        return ran
    over = true.Ms - wish.Ms
    if wish.Mt is not None:
        over = max(over, true.Mt - wish.Mt)
    if wish.noise_gain is not None:
        over = max(over, gains.Kp * (1.0 + wish.N if gains.Td else 1.0) / wish.noise_gain - 1.0)
    return replace(ran, Ms=true.Ms, over=over, ratio=cost_over_best(plant, gains, wish))


def cost_over_best(plant: Plant, gains: Gains, wish: Wish = PI) -> float:
    """J of gains that are stable on the true plant, over that of the best PI (or PID) for it."""
    design, best, least = optimum(plant, wish)
    cost = design.cost(gains.Kp, gains.Ti, gains.Td, design.wish.N)
    return (0.5 * cost.setpoint / least[0] + 0.5 * cost.load / least[1]) / best


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


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """With what every table of runs asks for."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--plants", type=int, help="so many, spread over the list; by default all")
    parser.add_argument("--part", default="0/1", help="i/n: every n-th of these plants, from the i-th on")
    parser.add_argument("--seeds", default="1", help="so many, or first-last")
    parser.add_argument("--save", type=Path, help="a line of JSON for every run; what it holds is not run again")
    parser.add_argument("--of", type=Path, help="the table of such a file, nothing is run")
    return parser


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--cases", default=";".join(CASES), help="names, separated by ';', or 'further'")
    given = parser.parse_args()
    runs = saved(given.of) if given.of else list(_runs(given))
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


def some(given: argparse.Namespace) -> tuple[list[Plant], range]:
    """The plants and seeds that were asked for."""
    everything = plants()
    step = len(everything) / min(given.plants or len(everything), len(everything))
    part, parts = map(int, given.part.split("/"))
    first, _, last = given.seeds.rpartition("-")
    chosen = [everything[int(i * step)] for i in range(round(len(everything) / step))]
    return chosen[part::parts], range(int(first or 1), int(last) + 1)


def saved(file: Path) -> list[Ran]:
    return [Ran(**json.loads(text)) for text in file.read_text().splitlines()] if file.exists() else []


def _runs(given: argparse.Namespace) -> Iterator[Ran]:
    chosen, seeds = some(given)
    cases = FURTHER if given.cases == "further" else given.cases.split(";")
    done = {(ran.case, ran.plant, ran.seed): ran for ran in saved(given.save)} if given.save else {}
    # a batch that is stopped leaves rows of the same plants, drawn at random
    for seed in seeds:
        shuffled = [chosen[i] for i in np.random.default_rng(seed).permutation(len(chosen))]
        for plant in shuffled:
            for case in ((CASES | FURTHER)[name] for name in cases):
                if case.nonlinear and plant.name != REACTOR:
                    continue
                yield done.get((case.name, plant.name, seed)) or kept(measure(case, plant, seed), given.save)


def kept(ran: Ran, file: Path | None) -> Ran:
    if file:
        with file.open("a") as out:
            out.write(json.dumps(asdict(ran)) + "\n")
    return ran


if __name__ == "__main__":
    main()
