"""The same plants, noise and judge as `benchmarks.tuning`, tuned by others: how long it takes and what it is worth.

    python -m benchmarks.peers [--plants N] [--part I/N] [--seeds N] [--case "PI 1 %"] [--save FILE] [--of FILE]

    five-stage   the procedure of that name in rehearsal, whole
    SIMC, AMIGO  a step of MV in manual, as large as the relay of "fast", and the FOPDT that is nearest to it in least
                 squares. It lasts until PV stays within 2 % of its end (an integrating plant: 10 Pu)
    ZN           the relay of the five stages, until it is steady; the PI of Ku and Pu

Each is given the plant's true T95. Plant time counts from the first move of MV.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from benchmarks.cases import ASKED, CASES, PLAIN, Case
from benchmarks.command import check_names
from benchmarks.drawn_runs import kept, saved
from benchmarks.plants import Plant
from benchmarks.tuning import (
    T95_PERIODS,
    WRONG,
    Ran,
    asked_for,
    evaluated,
    loads,
    loop_of,
    runs_of,
    runs_parser,
    span_of,
    spread,
)
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import run
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE, preflight
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.five_stage.procedure import Options, five_stage
from loopwright.tuning.five_stage.relay import relay_test
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import integrators
from loopwright.tuning.plan import Plan, StageStarted
from loopwright.tuning.reasons import Ended
from loopwright.tuning.rules.registry import METHODS
from validation.step_fits import fit_step

SAMPLES = 1500
"""Of a step's record at most: a longer one is of averages."""
SETTLED, T95 = 0.02, 0.05
AT_REST = 0.1
"""Of the record, before the step."""
INTEGRATING_PERIODS = 10.0
Tuned = tuple[Gains | Ended, float]
"""Gains, or why there are none; plant time, s."""


@cache
def settled_s(plant: Plant, within: float) -> float:
    """When the answer to a step of MV stays so near to its end, s."""
    if integrators(plant.model()):
        return INTEGRATING_PERIODS * plant.Pu
    slowest = max(1.0 / abs(float(pole.real)) for pole in np.roots(plant.den))
    dt = max(slowest, plant.L) / 400.0
    model = LinearPlant(plant.num, plant.den, plant.L, dt)
    y = np.array([model.step(1.0) for _ in range(round((12.0 * slowest + plant.L) / dt))])
    return dt * (float(np.flatnonzero(np.abs(y - y[-1]) > within * abs(y[-1]))[-1]) + 2.0)


def by_step(rule: str, plant: Plant, case: Case, seed: int) -> Tuned:
    """By a rule on the FOPDT that a step of MV shows. The load comes anywhere in the record."""
    lasts = settled_s(plant, SETTLED)
    Ts = max(plant.Ts, lasts / SAMPLES)
    noise = case.noise * span_of(plant) * (plant.Ts / Ts) ** 0.5
    model = LinearPlant(plant.num, plant.den, plant.L, Ts, noise_std=noise, seed=seed)
    rest = [model.pv, *(model.step(0.0) for _ in range(round(AT_REST * lasts / Ts)))]
    u = np.ones(round(lasts / Ts))
    for at, size in loads(plant, 1.0, seed, case):
        u[at % len(u) :] += size
    y = [rest[-1], *(model.step(float(value)) for value in u)]
    try:
        found = fit_step(Ts * np.arange(len(y), dtype=float), np.array(y), 1.0, float(np.mean(rest)))
        return METHODS[rule].tune(found).gains, lasts
    except Ended as ended:
        return ended, lasts


def by_relay(facts: Facts) -> Plan[Gains]:
    """Ziegler and Nichols' PI of the Ku and Pu that a symmetric relay shows."""
    point = yield from preflight(facts, 0.0)
    yield (StageStarted("relay", 0.0, 0.0),)
    found = yield from relay_test(facts, point)
    return METHODS["zn-ultimate"].tune_measured(found.Ku_a, found.Pu_a_s).gains


def by_five_stages(facts: Facts) -> Plan[Gains]:
    return (yield from five_stage(facts, Options(propose_anyway=True))).gains


def rehearsed(plan: Callable[[Facts], Plan[Gains]], limits: float, plant: Plant, case: Case, seed: int) -> Tuned:
    known = settled_s(plant, T95) / (T95_PERIODS * plant.Pu)
    case = replace(case, known=known, limits=limits)
    loop, facts = loop_of(plant, 1.0, 0.5 * span_of(plant), case.noise * span_of(plant), seed, case)
    result = run(plan(facts), loop, limits=RunLimits(max_time_s=500.0 * facts.T95_s))
    passed = sum(value for stage, value in result.plant_time_s.items() if stage not in (PREFLIGHT, SETTLE))
    answer = result.value or result.ended
    assert answer is not None
    return answer, passed


METHODS_COMPARED: dict[str, Callable[[Plant, Case, int], Tuned]] = {
    "five-stage": partial(rehearsed, by_five_stages, PLAIN.limits),
    "SIMC": partial(by_step, "simc"),
    "AMIGO": partial(by_step, "amigo"),
    "Ziegler-Nichols": partial(rehearsed, by_relay, 1.0),
}
HEAD = (
    "| method | gains given | time, Pu: p50 / p90 / max | Ms: p50 / p90 / max | Ms up to 1.7, % | "
    "J over the best: p50 / p90 / max | unstable | refused |\n| --- | --- | --- | --- | --- | --- | --- | --- |"
)


def measure(method: str, plant: Plant, case: Case, seed: int) -> Ran:
    start = time.process_time()
    found, passed = METHODS_COMPARED[method](plant, case, seed)
    ran = Ran(method, plant.name, seed, passed / plant.Pu, time.process_time() - start)
    if isinstance(found, Ended):
        return replace(ran, reason=found.reason.value, detail=found.detail)
    return evaluated(ran, plant, found)


def line(name: str, runs: Sequence[Ran]) -> str:
    """One row of the table in Markdown."""
    given = [each for each in runs if each.reason is None]
    Ms = [each.Ms for each in given if each.Ms is not None]
    causes = Counter(each.reason for each in runs if each.reason is not None).most_common()
    modest = 100.0 * sum(value <= ASKED + WRONG for value in Ms) / max(len(given), 1)
    return (
        f"| {name} | {len(given)}/{len(runs)} | {spread([each.passed for each in given], 1)} | {spread(Ms, 2)} | "
        f"{modest:.0f} | {spread([each.ratio for each in given if each.ratio is not None], 2)} | "
        f"{len(given) - len(Ms)} | {', '.join(f'{cause} {count}' for cause, count in causes) or '-'} |"
    )


def main() -> None:
    parser = runs_parser(__doc__)
    parser.add_argument("--case", default="PI 1 %", help="of benchmarks.tuning: its noise and load")
    given = parser.parse_args()
    check_names(parser, "case", [given.case], CASES)
    runs = runs_of(parser, given, _runs(given))
    print(HEAD)
    for name in dict.fromkeys(each.case for each in runs):
        print(line(name, [each for each in runs if each.case == name]))


def _runs(given: argparse.Namespace) -> Iterator[Ran]:
    chosen = asked_for(given)
    done = {(ran.case, ran.plant, ran.seed): ran for ran in saved(Ran, given.save)}
    for seed in given.seeds:
        for plant in chosen:
            for name in METHODS_COMPARED:
                found = done.get((name, plant.name, seed))
                yield found or kept(measure(name, plant, CASES[given.case], seed), given.save)


if __name__ == "__main__":
    main()
