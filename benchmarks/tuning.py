"""How well the fast procedure tunes: many plants, several seeds, noise and load steps, judged on the true plant.

    python -m benchmarks.tuning [--plants N] [--seeds N] [--cases pi-1,pid-1,...] [--methods fast,five-stage,...]

The plants are 70 of the Astrom-Hagglund batch, the 50 models of the five-stage paper and the linearised reactor (every
n-th with --plants N). Each run is a rehearsal: listening, relay, fit, step, fit. Noise is white, its standard deviation
a part of PV's span under the noise-free relay; a load step is 10 to 50 % of the relay's larger amplitude, of random
sign and time within 3.5 Pu after the relay starts. Ms 1.6 is asked for; the sampled controller's Ts/2 counts as dead
time on the true plant. J is the criterion of `tuning.fast.design`, against the best PI (or PID) on the true plant.
Plant time counts from the start of the relay. A result is silently wrong when it is proposed and Ms is off by more
than 0.1.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np

from controller.channel import Channel, Settings
from controller.pid import Parameters
from plantsim.plant import LinearPlant
from service.rehearsal import RehearsedLoop
from service.runner import RunResult, Watch, run
from tuning.fast.design import Design, Wish
from tuning.fast.experiment import Experiment
from tuning.fast.procedure import LEAST_SAMPLES, FastOptions, FastProposal, fast
from tuning.gains import Gains
from tuning.margins import margins
from tuning.models import TransferFunction, sign
from tuning.plan import Mode, Plan
from tuning.reasons import Ended
from tuning.stages.common import Facts, Trace
from tuning.stages.preflight import preflight

SAMPLES_PER_PERIOD = 80
T95_PERIODS = 3.0
ASKED = 1.6
WRONG = 0.1


@dataclass(frozen=True, slots=True)
class Plant:
    name: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Ku: float
    Pu: float

    @property
    def Ts(self) -> float:
        return self.Pu / SAMPLES_PER_PERIOD

    def model(self) -> TransferFunction:
        """With the sampled controller's half sample."""
        return TransferFunction(self.num, self.den, self.L + 0.5 * self.Ts)


@dataclass(frozen=True, slots=True)
class Case:
    """noise: of the span.  derivative: PID."""

    name: str
    noise: float
    load: bool = False
    derivative: bool = False


CASES = {
    case.name: case
    for case in (
        Case("PI 0.5 %", 0.005),
        Case("PI 1 %", 0.01),
        Case("PI 2 %", 0.02),
        Case("PI 0.5 % + load", 0.005, load=True),
        Case("PI 1 % + load", 0.01, load=True),
        Case("PI 2 % + load", 0.02, load=True),
        Case("PID 1 %", 0.01, derivative=True),
    )
}


class Loaded(LinearPlant):
    """A plant whose load steps at one sample."""

    at, size, n = -1, 0.0, 0

    def step(self, mv: float) -> float:
        if self.n == self.at:
            self.disturbance = self.size
        self.n += 1
        return super().step(mv)


def plants() -> list[Plant]:
    batch = json.loads((Path(__file__).parent.parent / "tests/data/plants-batch.json").read_text())["processes"]
    found = [
        Plant(p["id"], tuple(p["num"]), tuple(p["den"]), p["delay"], p["Ku"], p["Tu"]) for p in batch
    ]
    models = json.loads((files("plantsim") / "models-50.json").read_text())["models"]
    for m in models:
        model = TransferFunction(tuple(m["num"]), tuple(m["den"]), m["delay"])
        at = margins(model, Gains(Kp=1.0))
        assert at.GM is not None and at.wpc is not None
        found.append(Plant(f"model-{m['id']}", model.num, model.den, model.L, at.GM, 2.0 * math.pi / at.wpc))
    return found


def loop_of(plant: Plant, amplitude: float, span: float, noise: float, seed: int) -> tuple[RehearsedLoop, Facts, Loaded]:
    """A loop at rest under sluggish gains, in deviation variables."""
    process = Loaded(plant.num, plant.den, plant.L, plant.Ts, noise_std=noise, seed=seed)
    reverse = sign(plant.model()) > 0.0
    limit = 2.0 * amplitude
    settings = Settings(mv_low=-limit, mv_high=limit, pv_low=-1e9, pv_high=1e9, reverse=reverse)
    gains = Gains(Kp=0.15 * plant.Ku, Ti=2.0 * plant.Pu)
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    facts = Facts(plant.Ts, T95_PERIODS * plant.Pu, -limit, limit, span, gains, reverse)
    return RehearsedLoop(process, channel, plant.Ts), facts, process


def relay_span(plant: Plant) -> float:
    """Of PV under four switches of a relay of amplitude 1, without noise."""

    def plan(facts: Facts) -> Plan[float]:
        listened = Trace()
        point = yield from preflight(facts, LEAST_SAMPLES, listened)
        experiment = Experiment(facts, point, listened, 1.0)
        yield from experiment.relay(4)
        return experiment.evidence().span

    loop, facts, _ = loop_of(plant, 1.0, 1.0 / plant.Ku, 0.0, 1)
    result = run(plan(facts), loop, watch=Watch())
    assert result.value is not None, result.ended
    return result.value


@dataclass(slots=True)
class Row:
    """Of one case and method. Times in Pu."""

    times: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    unstable: list[str] = field(default_factory=list)
    endings: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, plant: Plant, gains: Gains, time_Pu: float, derivative: bool, label: str) -> None:
        true = margins(plant.model(), gains)
        self.times.append(time_Pu)
        if not true.stable:
            self.unstable.append(label)
            return
        self.errors.append(abs(true.Ms - ASKED))
        if self.errors[-1] > WRONG:
            self.wrong.append(f"{label} (Ms {true.Ms:.2f})")
        design, best, least = optimum(plant, derivative)
        cost = design.cost(gains.Kp, gains.Ti, gains.Td, design.wish.N)
        J = 0.5 * cost.setpoint / least[0] + 0.5 * cost.load / least[1]
        self.ratios.append(J / best)


@cache
def optimum(plant: Plant, derivative: bool) -> tuple[Design, float, tuple[float, float]]:
    """The design on the true plant, its J, and the least integrals that J is counted in."""
    design = Design(plant.model(), Wish(ASKED, derivative), plant.Pu)
    best = design.best()
    assert design.least is not None
    return design, best.J, (design.least.setpoint, design.least.load)


@cache
def span_of(plant: Plant) -> float:
    return relay_span(plant)


def fast_run(plant: Plant, case: Case, seed: int) -> tuple[RunResult[FastProposal], float]:
    span = span_of(plant)
    loop, facts, process = loop_of(plant, 1.0, 0.5 * span, case.noise * span, seed)
    if case.load:
        random = np.random.default_rng([seed, len(plant.name), int(1e6 * plant.Pu)])
        process.size = float(random.choice((-1.0, 1.0)) * random.uniform(0.1, 0.5))
        start = T95_PERIODS * SAMPLES_PER_PERIOD / 2.0
        process.at = round(start + random.uniform(0.0, 3.5) * SAMPLES_PER_PERIOD)
    options = FastOptions(Ms=ASKED, derivative=case.derivative, amplitude=1.0)
    result = run(fast(facts, options), loop, watch=Watch(max_time_s=100.0 * plant.Pu))
    passed = sum(value for stage, value in result.plant_time_s.items() if stage != "preflight")
    return result, passed / plant.Pu


def measure(case: Case, chosen: Iterable[Plant], seeds: int) -> Row:
    row = Row()
    for plant in chosen:
        for seed in range(1, seeds + 1):
            start = time.process_time()
            result, passed = fast_run(plant, case, seed)
            row.seconds.append(time.process_time() - start)
            label = f"{plant.name}, seed {seed}"
            if result.value is not None:
                row.add(plant, result.value.gains, passed, case.derivative, label)
            else:
                assert isinstance(result.ended, Ended)
                row.refused[result.ended.reason.value] += 1
                row.endings.append(f"{label}: {result.ended}")
    return row


def line(name: str, row: Row) -> str:
    """One row of the table in Markdown."""
    proposed, runs = len(row.times), len(row.times) + sum(row.refused.values())
    causes = ", ".join(f"{cause} {count}" for cause, count in row.refused.most_common())
    errors = np.array(row.errors)

    def within(limit: float) -> str:
        return f"{100.0 * float(np.mean(errors <= limit)):.1f}" if len(errors) else "-"

    return (
        f"| {name} | {proposed}/{runs} | {_spread(row.times, 2)} | {_spread(row.errors, 3)} | "
        f"{within(0.1)} / {within(0.05)} | {_spread(row.ratios, 3)} | {len(row.wrong)} | {len(row.unstable)} | "
        f"{causes or '-'} |"
    )


HEAD = (
    "| case | proposed | time, Pu: p50 / p90 / max | error of Ms: p50 / p90 / max | within 0.1 / 0.05, % | "
    "J over the best: p50 / p90 / max | silently wrong | unstable | refused |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def _spread(values: Sequence[float], digits: int) -> str:
    if not values:
        return "-"
    return " / ".join(f"{v:.{digits}f}" for v in (*np.percentile(values, (50, 90)), max(values)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--plants", type=int, help="so many, spread over the list; by default all")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cases", default=",".join(CASES), help="names, comma-separated")
    given = parser.parse_args()
    everything = plants()
    step = len(everything) / min(given.plants or len(everything), len(everything))
    chosen = [everything[int(i * step)] for i in range(round(len(everything) / step))]
    print(HEAD, flush=True)
    doubtful: list[str] = []
    seconds: list[float] = []
    for name in given.cases.split(","):
        row = measure(CASES[name], chosen, given.seeds)
        print(line(name, row), flush=True)
        doubtful += [f"{name}: {each} silently wrong" for each in row.wrong]
        doubtful += [f"{name}: {each} unstable" for each in row.unstable]
        doubtful += [f"{name}: {each}" for each in row.endings]
        seconds += row.seconds
    print(f"\n{len(seconds)} runs, {np.median(seconds):.2f} s of processor each (median), {max(seconds):.2f} s (most).")
    print("\n".join(doubtful))


if __name__ == "__main__":
    main()
