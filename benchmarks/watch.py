"""What the watch after an acceptance says: of models that are right, and of plants that are other than the model.

    python -m benchmarks.watch [--plants batch|kept-apart] [--every N] [--seeds N] [--kinds "quiet;loads"] ...

Gains are proposed by fast with the relay, noise 1 % of the span of PV under it. They are accepted, and an operator then
moves the set-point three times by 0.3 to 1 of the permitted step, up or down, every 14 ultimate periods; noise goes on.
The plant is then the one of the test, or has a second path that acts later, or another gain or dead time. The plants of
"batch" are every second of the Astrom-Hagglund batch; on them the thresholds were set. Those kept apart are the 50
models of the five-stage paper and the linearised reactor. --seeds counts operations of each proposal.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.cases import CASES
from benchmarks.command import check_names, parser_of
from benchmarks.drawn_runs import Draw, DrawNames, run_all
from benchmarks.operation import SAMPLES, SPACING, chosen
from benchmarks.plants import SAMPLES_PER_PERIOD, Plant
from benchmarks.tuning import fast_run, spread
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.analysis.recursion import recursive
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.models import Reals, TransferFunction, sign
from loopwright.tuning.operation.accepted_model import AcceptedModel
from loopwright.tuning.operation.change_findings import ComparedChange
from loopwright.tuning.operation.compared_change import AFTER, compare_change
from loopwright.tuning.operation.growing_oscillation import growing
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.load_changes import load_changes
from loopwright.tuning.operation.model_conclusion import ModelState, conclusion_of
from loopwright.tuning.plan import Mode

CHANGES = 3
NOISE = 0.02
"""Standard deviation of the noise, in permitted steps: 1 % of the span under the relay, twice the permitted step."""
TEST = CASES["PI 1 %"]


@dataclass(frozen=True, slots=True)
class Kind:
    """What operation is like since the acceptance.

    share, later: of a second path, its gain over that of the plant, and how much later it acts, ultimate periods.
    gain: of the plant over that of the test. dead_time: how much longer it is, ultimate periods.
    drift: the gain reaches this factor at the end.
    noise: in permitted steps. loads: steps of the load in all, of 0.1 to 0.5 of what moves PV by a permitted step.
    pole: of coloured noise, in a fortieth of an ultimate period. wandering: of a load, as loads.
    moves: whether the set-point is moved.
    """

    share: float = 0.0
    later: float = 4.1
    gain: float = 1.0
    dead_time: float = 0.0
    drift: float = 1.0
    noise: float = NOISE
    loads: int = 0
    pole: float = 0.0
    wandering: float = 0.0
    moves: bool = True


KINDS = {
    "quiet": Kind(),
    "twice the noise": Kind(noise=2.0 * NOISE),
    "noise of pole 0.8": Kind(pole=0.8),
    "one load": Kind(loads=1),
    "three loads": Kind(loads=3),
    "wandering load": Kind(wandering=0.02),
    "three loads alone": Kind(loads=3, moves=False),
    "30 % of the effect 4.1 Pu later": Kind(share=0.3 / 0.7),
    "60 % of the effect 4.1 Pu later": Kind(share=0.6 / 0.4),
    "30 % of the effect 2.7 Pu later": Kind(share=0.3 / 0.7, later=2.7),
    "30 % of the effect 8 Pu later": Kind(share=0.3 / 0.7, later=8.0),
    "-30 % of the effect 4.1 Pu later": Kind(share=-0.3 / 1.3),
    "30 % 4.1 Pu later, three loads": Kind(share=0.3 / 0.7, loads=3),
    "gain x 1.3": Kind(gain=1.3),
    "gain x 1.6": Kind(gain=1.6),
    "gain x 0.6": Kind(gain=0.6),
    "gain drifts to x 1.6": Kind(drift=1.6),
    "dead time 0.1 Pu longer": Kind(dead_time=0.1),
    "dead time 0.2 Pu longer": Kind(dead_time=0.2),
}
FALSE = (
    "quiet", "twice the noise", "noise of pole 0.8", "one load", "three loads", "wandering load", "three loads alone",
)  # fmt: skip
"""Kinds of operation on the plant of the test."""


@dataclass(frozen=True, slots=True)
class WatchedRun:
    """How a watch ended. verdict: None where nothing was proposed.

    confirmed: changes that confirm the model. differs: those that show another plant, each by itself.
    instead, size, delay: what fits instead, the latter in ultimate periods. grows: whether an oscillation was said to
    grow. stable: whether PV stayed within 10 permitted steps.
    """

    plant: str
    present: str
    kind: str
    seed: int
    verdict: str | None
    confirmed: int = 0
    differs: int = 0
    instead: str | None = None
    size: float = 0.0
    delay: float = 0.0
    Ms: float = 0.0
    grows: bool = False
    stable: bool = True
    seconds: float = 0.0

    @property
    def draw(self) -> DrawNames:
        return self.plant, self.present, self.kind, self.seed


@cache
def proposal(plant: Plant) -> FastProposal | None:
    """What the relay proposes for the plant of the test."""
    return fast_run(replace(plant, samples=SAMPLES_PER_PERIOD), TEST, 1)[0].value


def operated(plant: Plant, found: FastProposal, kind: Kind, random: np.random.Generator) -> Stretch:
    """The operation since the acceptance."""
    model = plant.model()
    unit = abs(1.0 / model.static_gain) if math.isfinite(model.static_gain) else 0.3 * plant.Ku
    every = round(SPACING * SAMPLES)
    whole = every * (CHANGES + 1)
    process = LinearPlant(plant.num, plant.den, plant.L + kind.dead_time * plant.Pu, plant.Ts)
    later = LinearPlant(plant.num, plant.den, plant.L + kind.later * plant.Pu, plant.Ts)
    settings = Settings(mv_low=-1e9, mv_high=1e9, pv_low=-1e9, pv_high=1e9, reverse=sign(model) > 0.0)
    gains = found.gains
    parameters = Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf)
    channel = Channel(plant.Ts, settings, parameters, 0.0, int(Mode.AUTOMATIC), 0.0)
    moves = [each * every + every - 1 for each in range(CHANGES)]
    loads = {
        int(at): unit * random.choice((-1.0, 1.0)) * random.uniform(0.1, 0.5)
        for at in random.integers(whole, size=kind.loads)
    }
    noise = coloured(random.standard_normal(whole + 1), kind.pole) * kind.noise
    wander = coloured(random.standard_normal(whole + 1), math.exp(-1.0 / SAMPLES)) * kind.wandering * unit
    rows = []
    clean, sp, load = 0.0, 0.0, 0.0
    for k in range(whole):
        if kind.moves and k in moves:
            size = random.uniform(0.3, 1.0)
            sp += size * (-1.0 if sp + size > 1.0 else 1.0 if sp - size < -1.0 else random.choice((-1.0, 1.0)))
            channel.setpoint = sp
        pv = clean + float(noise[k])
        mv = channel.step(pv)
        rows.append((mv, pv, sp))
        load += loads.get(k, 0.0)
        u = kind.gain * (1.0 + (kind.drift - 1.0) * k / whole) * (mv + load + float(wander[k]))
        clean = process.step(u) + (later.step(kind.share * u) if kind.share else 0.0)
    columns = np.array(rows).T
    return Stretch(0.0, plant.Ts, columns[0], columns[1], columns[2], gains)


def coloured(white: Reals, pole: float) -> Reals:
    """First-order noise of variance 1."""
    return math.sqrt(1.0 - pole**2) * recursive(np.array([1.0, -pole]), white)


def compared(model: AcceptedModel, stretch: Stretch) -> list[ComparedChange]:
    """The changes as the service compares them."""
    found, last = [], 0
    after = round(AFTER * model.period_s / stretch.Ts)
    moves = [(move, False) for move in stretch.moves]
    for move, by_load in sorted(moves + [(at, True) for at in load_changes(stretch, model.period_s)]):
        if move >= last and move + after <= len(stretch.sp):
            last = move + after
            found.append(compare_change(model, stretch, move, last, by_load))
    return found


def watched(given: Draw) -> WatchedRun:
    plant, present, kind, seed = replace(given[0], samples=SAMPLES), *given[1:]
    found = proposal(given[0])
    if found is None:
        return WatchedRun(plant.name, present, kind, seed, None)
    random = np.random.default_rng([seed, len(plant.name), int(1e6 * plant.Pu), list(KINDS).index(kind)])
    stretch = operated(plant, found, KINDS[kind], random)
    identified = found.model
    Pu = found.ultimate.Pu_s if found.ultimate is not None else plant.Pu
    model = AcceptedModel(
        TransferFunction(identified.num, identified.den, identified.dead_time_s), found.gains, Pu, 0.5 * plant.Ts,
        identified.covariance,
    )  # fmt: skip
    begun = time.process_time()
    changes = compared(model, stretch)
    spent = time.process_time() - begun
    said = conclusion_of(changes)
    grows = any(
        growing(replace(stretch, mv=stretch.mv[:k], pv=stretch.pv[:k], sp=stretch.sp[:k]), Pu) is not None
        for k in range(4 * SAMPLES, len(stretch.sp), SAMPLES // 4)
    )
    instead = said.instead
    return WatchedRun(
        plant.name, present, kind, seed, said.state.value, said.confirmed,
        sum(each.state.value == "differs" for each in changes),
        instead.kind.value if instead else None, instead.size if instead else 0.0,
        instead.delay_s / Pu if instead else 0.0, instead.Ms if instead else 0.0, grows,
        bool(np.max(np.abs(stretch.pv)) < 10.0), spent / max(len(changes), 1),
    )  # fmt: skip


def table(ran: list[WatchedRun]) -> Iterator[str]:
    """The rows of the table in Markdown."""
    heads = ("operation", "mismatch", "confirmed", "neither", "one change differs", "said to grow", "what fits instead")
    yield f"| {' | '.join(heads)} |"
    yield f"|{len(heads) * ' --- |'}"
    for kind in KINDS:
        mine = [each for each in ran if each.kind == kind and each.verdict is not None]
        if not mine:
            continue
        count = Counter(each.verdict for each in mine)
        single = sum(each.differs == 1 for each in mine)
        what = Counter(each.instead for each in mine if each.instead).most_common()
        yield (
            f"| {kind} | {count[ModelState.MISMATCH]} of {len(mine)} | {count[ModelState.CONFIRMED]} | "
            f"{count[ModelState.OPEN]} | {single} | {sum(each.grows for each in mine)} | "
            f"{', '.join(f'{name} {number}' for name, number in what) or '-'} |"
        )


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--plants", choices=("batch", "kept-apart"), default="kept-apart")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--kinds", default=";".join(KINDS))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--save", type=Path, help="a line of JSON for every run; what it holds is not run again")
    given = parser.parse_args()
    check_names(parser, "kind", given.kinds.split(";"), KINDS)
    todo: list[Draw] = [
        (plant, "fast", kind, seed)
        for plant in chosen(given.plants, given.every)
        for kind in given.kinds.split(";")
        for seed in range(1, given.seeds + 1)
    ]
    ran = list(run_all(WatchedRun, watched, todo, given.save, given.processes))
    print(*table(ran), sep="\n")
    spent = [each.seconds for each in ran if each.verdict is not None]
    none = len({each.plant for each in ran if each.verdict is None})
    print(f"\nOne change, processor time: {spread(spent, 2)} s (p50 / p90 / max). No proposal for {none} plants.")
    for each in ran:
        if (each.kind in FALSE) == (each.verdict == ModelState.MISMATCH) or (each.grows and each.kind in FALSE):
            what = f"{each.instead} {each.size:.3g} ({each.delay:.2g} Pu), Ms {each.Ms:.2f}" if each.instead else ""
            print(f"{each.kind}, {each.plant}, seed {each.seed}: {each.verdict} {what}{' grows' * each.grows}")


if __name__ == "__main__":
    main()
