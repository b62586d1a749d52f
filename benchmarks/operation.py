"""How many set-point changes of normal operation give gains, and how right these are: judged on the true plant.

    python -m benchmarks.operation [--plants batch|kept-apart | --random 1000-1099] [--seeds N]
        [--kinds "quiet;loads"] ...

The plants of "batch" are every second of the Astrom-Hagglund batch; on them the rules were set. Those kept apart are
the 50 models of the five-stage paper and the linearised reactor. Plants drawn at random judge from number 1000 on.
An operator moves the set-point by 0.3 to 1 of the permitted step, up or down, every 14 ultimate periods; noise is
white, of 1 % of the permitted step. The gains in effect are sluggish (Ms 1.1 to 1.2), typical (1.3 to 2) or nearly
unstable (2.8 to 3.2), with Ti of half to 2.5 times that of the best PI. After 1, 2, 3, 4, 6, 8 and 12 changes the
operation is evaluated; the first proposal counts. Ms 1.6 is asked for.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.cases import ASKED, PI
from benchmarks.command import check_names, parser_of
from benchmarks.drawn_runs import Draw, DrawNames, run_all
from benchmarks.plants import Plant, plants
from benchmarks.random_plants import random_plants
from benchmarks.tuning import cost_over_best, numbers_of, optimum, spread
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import sign
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.observation import observe
from loopwright.tuning.plan import Mode

SAMPLES = 40
"""Samples in an ultimate period."""
SPACING = 14.0
"""Ultimate periods from one set-point change to the next."""
LOOKS = (1, 2, 3, 4, 6, 8, 12)
PRESENT = {"sluggish": (1.1, 1.2), "typical": (1.3, 2.0), "nearly unstable": (2.8, 3.2)}
"""Ms of the gains in effect, least and largest."""
WRONG = 0.1


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of operation.

    noise: the standard deviation of the white noise, in permitted steps.
    wandering: the standard deviation of a load disturbance that wanders, in MV units that move PV by a permitted step.
    loads: whether the load steps, by 0.1 to 0.5 of these units, once for each change on average.
    most_loads: the largest number of steps of the load, None for as many as changes.
    drift: whether the load drifts at a constant rate, by 0.1 to 0.5 of these units from one change to the next.
    gain: by how much the plant's gain has changed after the second change.
    later: by how many ultimate periods the dead time has become longer then.
    sizes: the least and the largest change of the set-point, in permitted steps.
    stiction: the valve stays until MV is off by this, in the same units.
    """

    noise: float = 0.01
    wandering: float = 0.0
    loads: bool = False
    most_loads: int | None = None
    drift: bool = False
    gain: float = 1.0
    later: float = 0.0
    sizes: tuple[float, float] = (0.3, 1.0)
    stiction: float = 0.0


KINDS = {
    "quiet": Kind(),
    "2 % noise": Kind(noise=0.02),
    "loads": Kind(loads=True),
    "wandering load": Kind(wandering=0.02),
    "gain x 1.5 after two changes": Kind(gain=1.5),
    "changes of 5 to 20 standard deviations of the noise": Kind(sizes=(0.05, 0.2)),
    "valve that sticks": Kind(stiction=0.02),
    "drift": Kind(drift=True),
    "gain x 0.7 after two changes": Kind(gain=0.7),
    "dead time 0.1 Pu longer after two changes": Kind(later=0.1),
}


@dataclass(frozen=True, slots=True)
class Operated:
    """What a history came to.

    changes: the number of changes of the first proposal, None without one.
    reason: why nothing was proposed, at the last look.
    Ms, ratio (J over the best): on the true plant at the end, None where it is unstable or nothing was proposed.
    seconds: processor time of one look, at the last.
    """

    plant: str
    present: str
    kind: str
    seed: int
    changes: int | None
    reason: str | None
    detail: str
    Ms: float | None
    ratio: float | None
    seconds: float

    @property
    def draw(self) -> DrawNames:
        return self.plant, self.present, self.kind, self.seed

    @property
    def error(self) -> float:
        return math.inf if self.Ms is None else abs(self.Ms - ASKED)


def present_gains(plant: Plant, present: str, random: np.random.Generator) -> Gains:
    """Gains of the Ms drawn, by bisection of Kp."""
    best = optimum(plant, PI)[0].best().gains
    Ms, Ti = random.uniform(*PRESENT[present]), best.Ti * math.exp(random.uniform(math.log(0.5), math.log(2.5)))
    low, high = math.log(1e-3 * plant.Ku), math.log(plant.Ku)
    for _ in range(40):
        Kp = math.exp(0.5 * (low + high))
        found = margins(plant.model(), Gains(Kp, Ti))
        low, high = (math.log(Kp), high) if found.stable and found.Ms < Ms else (low, math.log(Kp))
    return Gains(math.exp(low), Ti)


def operation(plant: Plant, gains: Gains, kind: Kind, random: np.random.Generator, changes: int) -> Stretch:
    """The history of so many set-point changes."""
    model = plant.model()
    unit = abs(1.0 / model.static_gain) if math.isfinite(model.static_gain) else 0.3 * plant.Ku
    every = round(SPACING * SAMPLES)
    seed = int(random.integers(1 << 30))
    process = LinearPlant(plant.num, plant.den, plant.L, plant.Ts, noise_std=kind.noise, seed=seed)
    settings = Settings(mv_low=-1e9, mv_high=1e9, pv_low=-1e9, pv_high=1e9, reverse=sign(model) > 0.0)
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    moves = [each * every + every - 1 for each in range(changes)]
    count = (changes if kind.most_loads is None else kind.most_loads) if kind.loads else 0
    loads = dict.fromkeys(random.integers(every * changes, size=count).tolist(), 0.0)
    for at in loads:
        loads[at] = unit * random.choice((-1.0, 1.0)) * random.uniform(0.1, 0.5)
    drift = unit * random.choice((-1.0, 1.0)) * random.uniform(0.1, 0.5) / every if kind.drift else 0.0
    later = round(kind.later * SAMPLES)
    at_plant: deque[float] = deque([0.0] * (later + 1), later + 1)
    rows = []
    pv, sp, load, wandering, valve = process.pv, 0.0, 0.0, 0.0, 0.0
    decay = math.exp(-1.0 / SAMPLES)
    for k in range(every * (changes + 1)):
        if k in moves:
            size = random.uniform(*kind.sizes)
            sp += size * (-1.0 if sp + size > 1.0 else 1.0 if sp - size < -1.0 else random.choice((-1.0, 1.0)))
            channel.setpoint = sp
        mv = channel.step(pv)
        rows.append((mv, pv, sp))
        load += loads.get(k, 0.0) + drift
        wandering *= decay
        wandering += math.sqrt(1.0 - decay**2) * kind.wandering * unit * random.standard_normal()
        if abs(mv - valve) >= kind.stiction * unit:
            valve = mv
        at_plant.append(valve + load + wandering)
        changed = len(moves) > 2 and k > moves[1] + every // 2
        pv = process.step(kind.gain * at_plant[0] if changed else at_plant[-1])
    columns = np.array(rows).T
    return Stretch(0.0, plant.Ts, columns[0], columns[1], columns[2], gains)


def operated(plant: Plant, present: str, kind: str, seed: int) -> Operated:
    plant = replace(plant, samples=SAMPLES)
    random = np.random.default_rng(
        [seed, len(plant.name), int(1e6 * plant.Pu), list(PRESENT).index(present), list(KINDS).index(kind)]
    )
    gains = present_gains(plant, present, random)
    whole = operation(plant, gains, KINDS[kind], random, LOOKS[-1])
    every = round(SPACING * SAMPLES)
    spent, reason, detail = 0.0, None, ""
    for looks in LOOKS:
        until = min((looks + 1) * every, len(whole.sp)) - 2
        part = replace(whole, mv=whole.mv[:until], pv=whole.pv[:until], sp=whole.sp[:until])
        begun = time.process_time()
        found = observe([part], sign(plant.model()) > 0.0, PI)
        spent = time.process_time() - begun
        reason, detail = found.reason, found.detail
        if found.reason is None and found.evaluation is not None:
            proposed = found.evaluation.best.gains
            now = plant if looks <= 2 else _changed(plant, KINDS[kind])
            true = margins(now.model(), proposed)
            Ms = true.Ms if true.stable else None
            ratio = cost_over_best(now, proposed) if true.stable else None
            return Operated(plant.name, present, kind, seed, looks, None, "", Ms, ratio, spent)
    return Operated(plant.name, present, kind, seed, None, reason.value if reason else None, detail, None, None, spent)


def _changed(plant: Plant, kind: Kind) -> Plant:
    """The plant as it is after the second change."""
    later = round(kind.later * SAMPLES) * plant.Ts
    return replace(plant, num=tuple(kind.gain * each for each in plant.num), L=plant.L + later)


def _operated(given: Draw) -> Operated:
    return operated(*given)


def chosen(name: str, every: int) -> list[Plant]:
    found = plants()
    batch = [each for each in found if not (each.name.startswith("model-") or each.name == "reactor")]
    return (batch[::2] if name == "batch" else [each for each in found if each not in batch])[::every]


def table(ran: list[Operated]) -> Iterator[str]:
    """The rows of the table in Markdown."""
    yield (
        "| operation | present gains | proposed | changes: p50 / p90 / max | error of Ms: p50 / p90 / max | "
        "J over the best: p50 / p90 / max | wrong | not proposed |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    for kind, present in product(KINDS, PRESENT):
        mine = [each for each in ran if (each.kind, each.present) == (kind, present)]
        if not mine:
            continue
        good = [each for each in mine if each.changes is not None]
        why = Counter(each.reason for each in mine if each.changes is None).most_common()
        yield (
            f"| {kind} | {present} | {len(good)} of {len(mine)} | {spread([each.changes or 0 for each in good], 0)} | "
            f"{spread([each.error for each in good], 3)} | "
            f"{spread([each.ratio for each in good if each.ratio is not None], 3)} | "
            f"{sum(each.error > WRONG for each in good)} | {', '.join(f'{a} {b}' for a, b in why) or '-'} |"
        )


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--plants", choices=("batch", "kept-apart"), default="kept-apart")
    parser.add_argument(
        "--random", type=numbers_of, metavar="FIRST-LAST", help="plants drawn at random: `benchmarks.random_plants`"
    )
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--kinds", default=";".join(KINDS))
    parser.add_argument("--present", default=";".join(PRESENT))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--save", type=Path, help="a line of JSON for every run; what it holds is not run again")
    given = parser.parse_args()
    check_names(parser, "kind", given.kinds.split(";"), KINDS)
    check_names(parser, "present", given.present.split(";"), PRESENT)
    which = random_plants(given.random) if given.random else chosen(given.plants, given.every)
    todo = [
        (plant, present, kind, seed)
        for seed in range(1, given.seeds + 1) for plant in which
        for kind in given.kinds.split(";") for present in given.present.split(";")
    ]  # fmt: skip
    ran = list(run_all(Operated, _operated, todo, given.save, given.processes))
    print(*table(ran), sep="\n")
    spent = [each.seconds for each in ran]
    print(f"\none look, processor time: {np.median(spent):.2f} s at the median, {max(spent):.2f} s at most")


if __name__ == "__main__":
    main()
