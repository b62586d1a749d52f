"""What `identify` answers to records of a loop in automatic: gains that are right, gains that are wrong, or a question.

    python -m benchmarks.in_automatic [--seeds N]

Four plants under a PI, noise of 1 % of a usual set-point change, samples as the controller takes them or every fifth of
them. Gains are wrong where Ms of the recommended method, or of any method with Ms below 2, is off by more than 0.1 on
the true plant. Without the question: those of the model that is found in any case.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.signal import lfilter

from benchmarks.command import parser_of
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.offline.automatic import identified_as_it_is, in_automatic
from loopwright.service.offline.csv_record.record import Record
from loopwright.service.offline.recommendation import recommended
from loopwright.service.offline.tunings import tune_model
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.identification.identify import Identified, identify
from loopwright.tuning.models import Model, Reals, TransferFunction
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Refused

TS, SAMPLES, NOISE, WRONG, MAX_MS = 0.2, 1500, 0.01, 0.1, 2.0
SETPOINTS: dict[str, dict[int, float]] = {
    "SP rests": {},
    "one change": {100: 1.0},
    "three changes": {100: 1.0, 500: -0.6, 900: 0.8},
    "six changes": {100 + 220 * i: size for i, size in enumerate((1.0, -0.8, 0.7, -1.0, 0.7, -0.6))},
}
LOADS = ("none", "one step", "six steps", "wanders", "wanders a little", "sine")
HEAD = (
    "| SP | load | records | refused | without the question: recommended wrong, any wrong | answered "
    "| recommended wrong, any wrong | largest error of Ms of those recommended |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)


@dataclass(frozen=True, slots=True)
class OperatedLoop:
    """A plant without its dead time, its dead time, s, and the PI that it is operated with."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float
    Kp: float
    Ti: float


LOOPS = (
    OperatedLoop((2.0,), (10.0, 1.0), 2.03, 1.5, 8.0),
    OperatedLoop((2.0,), (50.0, 15.0, 1.0), 1.04, 1.0, 12.0),
    OperatedLoop((0.1,), (3.0, 1.0, 0.0), 1.23, 1.5, 30.0),
    OperatedLoop((-2.0, 1.0), (20.0, 9.0, 1.0), 1.0, 0.5, 9.0),
)


def _load(kind: str, loop: OperatedLoop, random: np.random.Generator) -> Reals:
    """The load, MV units; its size is a part of the MV that moves PV by about 1."""
    size, load = 1.0 / max(abs(loop.num[-1]), 0.3), np.zeros(SAMPLES)
    if kind == "one step":
        load[int(0.45 * SAMPLES) :] = 0.5 * size
    elif kind == "six steps":
        for at in random.integers(50, SAMPLES, 6):
            load[at:] += 0.4 * size * random.normal()
    elif kind.startswith("wanders"):
        slow = lfilter([1.0], [1.0, -0.98], random.normal(size=SAMPLES + 500))[500:]
        load = (0.1 if kind.endswith("little") else 0.4) * size * slow / slow.std()
    elif kind == "sine":
        load = 0.3 * size * np.sin(2.0 * np.pi * np.arange(SAMPLES) * TS / (4.0 * loop.Ti))
    return load


def record(loop: OperatedLoop, setpoint: str, load: str, every: int, seed: int) -> Record:
    """A record of the loop in automatic, of every so many samples of the controller."""
    loads = _load(load, loop, np.random.default_rng(seed))
    plant = LinearPlant(loop.num, loop.den, loop.L, TS, noise_std=NOISE, seed=seed, mv_low=-1e3, mv_high=1e3)
    settings = Settings(mv_low=-1e3, mv_high=1e3)
    channel = Channel(TS, settings, Parameters(loop.Kp, loop.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    rows = []
    for k in range(SAMPLES):
        channel.setpoint += SETPOINTS[setpoint].get(k, 0.0)
        plant.disturbance = float(loads[k])
        pv = plant.pv
        rows.append((k * TS, channel.step(pv), pv, channel.setpoint))
        plant.step(rows[-1][1])
    t, u, y, sp = np.array(rows[::every]).T
    return Record(t, u, y, sp)


def errors(model: Model, true: Model) -> tuple[float, float]:
    """Errors of Ms: of the recommended method, and the largest of all methods with Ms below 2 on the model."""
    found = {each.method.name: each for each in tune_model(model)}
    off = {}
    for name, each in found.items():
        Ms = margins(model, each.gains).Ms if each.gains else None
        if each.gains and Ms is not None and Ms < MAX_MS:
            off[name] = abs((margins(true, each.gains).Ms or np.inf) - Ms)
    best = recommended({name: each.assessment for name, each in found.items() if each.assessment})
    return (off.get(best.method, 0.0) if best else 0.0), max(off.values(), default=0.0)


def judged(loop: OperatedLoop, made: Record) -> Iterator[tuple[str, float]]:
    """What came of a record, with errors of Ms."""
    automatic = in_automatic(made)
    try:
        found: Identified = identify(made.t, made.u, made.y)
    except Refused:
        yield "refused", 0.0
        return
    recommended_one, worst = errors(found.model, TransferFunction(loop.num, loop.den, loop.L))
    answered = automatic is None or identified_as_it_is(found, automatic)
    for at in ("before", "after") if answered else ("before",):
        yield at, recommended_one
        yield f"{at}, any", worst


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="so many (default: %(default)s)")
    given = parser.parse_args()
    print(HEAD)
    for setpoint, load in product(SETPOINTS, LOADS):
        if setpoint == "SP rests" and load == "none":
            continue
        count, wrong, largest = Counter[str](), Counter[str](), 0.0
        for loop, every, seed in product(LOOPS, (1, 5), range(1, given.seeds + 1)):
            count["records"] += 1
            for what, error in judged(loop, record(loop, setpoint, load, every, seed)):
                count[what] += 1
                wrong[what] += error > WRONG
                largest = max(largest, error) if what == "after" else largest
        before, after = (f"{wrong[at]}, {wrong[f'{at}, any']}" for at in ("before", "after"))
        figures = f"{count['records']} | {count['refused']} | {before} | {count['after']} | {after} | {largest:.3f}"
        print(f"| {setpoint} | {load} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
