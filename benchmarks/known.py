"""How well fast tunes a plant that normal operation has shown: only the step under the new gains, judged on the plant.

    python -m benchmarks.known [--plants batch|kept-apart] [--every N] [--seeds N] [--changes "none;gain x 2"] ...

The histories are those of `benchmarks.operation`. As soon as operation would propose gains, the loop is retuned by fast
with the excitations observe and setpoint, on the same plant or on one that has changed since the last set-point change.
Noise is white, of 1 % of the permitted step. Plant time is counted from the first move of the set-point by the test, in
ultimate periods of the plant before the change; it is compared with that of the pulses on the same plant. Ms 1.6 is
asked for; a result is wrong where Ms on the true plant is off by more than 0.1.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.cases import ASKED, PI
from benchmarks.command import check_names, parser_of
from benchmarks.drawn_runs import Draw, DrawNames, run_all
from benchmarks.operation import KINDS, LOOKS, PRESENT, SAMPLES, SPACING, WRONG, chosen, operation, present_gains
from benchmarks.plants import Plant
from benchmarks.tuning import T95_PERIODS, spread
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import run
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.excitation_choice import fast_by
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.known_plant.procedure import TrialFigures
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FastOptions
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import sign
from loopwright.tuning.operation.known import known_plant
from loopwright.tuning.operation.observation import observe
from loopwright.tuning.plan import Event, Mode, Note, Sample, StageDone

STEP = 1.0
"""The permitted step of the set-point, PV units."""
NOISE = 0.01


@dataclass(frozen=True, slots=True)
class Change:
    """How the plant has changed since operation was observed: its gain by a factor, its dead time by ultimate
    periods."""

    gain: float = 1.0
    later: float = 0.0

    def of(self, plant: Plant) -> Plant:
        num = tuple(self.gain * each for each in plant.num)
        return replace(plant, num=num, L=plant.L + self.later * plant.Pu)


CHANGES = {
    "none": Change(),
    "gain x 1.1": Change(gain=1.1),
    "gain x 1.25": Change(gain=1.25),
    "gain x 1.5": Change(gain=1.5),
    "gain x 2": Change(gain=2.0),
    "gain x 0.5": Change(gain=0.5),
    "dead time 0.05 Pu longer": Change(later=0.05),
    "dead time 0.1 Pu longer": Change(later=0.1),
    "dead time 0.25 Pu longer": Change(later=0.25),
}


@dataclass(frozen=True, slots=True)
class KnownRun:
    """How a retune ended.

    changes: the number of set-point changes that were heard.
    by: "trial", "pulses", or None where nothing was proposed, for a reason.
    outdated: whether the trial spoke against the known plant. why: what the trial said.
    passed: plant time from the first move, Pu.
    Ms: of the gains proposed, on the true plant, None where nothing was proposed or the loop is unstable.
    """

    plant: str
    present: str
    change: str
    seed: int
    changes: int
    by: str | None
    reason: str | None
    outdated: bool
    why: str
    passed: float
    Ms: float | None
    seconds: float

    @property
    def draw(self) -> DrawNames:
        return self.plant, self.present, self.change, self.seed

    @property
    def error(self) -> float:
        return math.inf if self.Ms is None else abs(self.Ms - ASKED)


def observed(plant: Plant, present: str, seed: int) -> tuple[Gains, int, ObservedPlant | NothingKnown]:
    """The gains in effect, and what operation shows after the fewest changes that suffice."""
    random = np.random.default_rng([seed, len(plant.name), int(1e6 * plant.Pu), list(PRESENT).index(present)])
    gains = present_gains(plant, present, random)
    whole = operation(plant, gains, KINDS["quiet"], random, LOOKS[-1])
    known: ObservedPlant | NothingKnown = NothingKnown("")
    for looks in LOOKS:
        until = min((looks + 1) * round(SPACING * SAMPLES), len(whole.sp)) - 2
        part = replace(whole, mv=whole.mv[:until], pv=whole.pv[:until], sp=whole.sp[:until])
        known = known_plant(observe([part], sign(plant.model()) > 0.0, PI), plant.Ts, 0.0)
        if isinstance(known, ObservedPlant):
            # the test begins at rest at another place than where operation ended, in deviation variables
            return gains, looks, replace(known, pv=(-1e9, 1e9), mv=(-1e9, 1e9))
    return gains, LOOKS[-1], known


def retuned(
    plant: Plant, gains: Gains, known: ObservedPlant | NothingKnown, change: str, seed: int
) -> tuple[Plant, list[Sample], list[TrialFigures], list[str], Gains | None, str | None]:
    """The plant as it is now, the samples, trials and notes, and the gains proposed or the reason against them."""
    now = CHANGES[change].of(plant)
    reverse = sign(plant.model()) > 0.0
    process = LinearPlant(now.num, now.den, now.L, now.Ts, noise_std=NOISE * STEP, seed=1000 + seed)
    settings = Settings(mv_low=-1e9, mv_high=1e9, pv_low=-1e9, pv_high=1e9, reverse=reverse)
    channel = Channel(plant.Ts, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
    facts = Facts(plant.Ts, T95_PERIODS * plant.Pu, -1e9, 1e9, STEP, gains, reverse)
    options = FastOptions(Ms=ASKED, propose_anyway=True)
    trials: list[TrialFigures] = []
    notes: list[str] = []
    taken: list[Sample] = []

    def hear(event: Event) -> None:
        if isinstance(event, StageDone) and isinstance(event.result, TrialFigures):
            trials.append(event.result)
        elif isinstance(event, Note):
            notes.append(event.text)

    both = (Excitation.OBSERVE, Excitation.SETPOINT)
    plan = fast_by(both, facts, options, known)
    limits = RunLimits(-1e3, 1e3, -1e9, 1e9, max_time_s=500 * facts.T95_s)
    ended = run(plan, RehearsedLoop(process, channel, plant.Ts), limits=limits, on_event=hear, on_samples=taken.extend)
    reason = None if ended.ended is None else ended.ended.reason.value
    return now, taken, trials, notes, None if ended.value is None else ended.value.gains, reason


def measured(plant: Plant, present: str, change: str, seed: int) -> KnownRun:
    plant = replace(plant, samples=SAMPLES)
    gains, changes, known = observed(plant, present, seed)
    begun = time.process_time()
    now, taken, trials, notes, proposed, reason = retuned(plant, gains, known, change, seed)
    first = next((i for i in range(1, len(taken)) if taken[i].sp != taken[i - 1].sp), len(taken))
    failed = not trials or any("failed" in note for note in notes)
    by = None if proposed is None else "pulses" if failed else "trial"
    Ms = None
    if proposed is not None:
        true = margins(now.model(), proposed)
        Ms = true.Ms if true.stable else None
    return KnownRun(
        plant.name, present, change, seed, changes, by, reason, any(each.outdated for each in trials),
        "; ".join(notes)[:400], (len(taken) - first) * plant.Ts / plant.Pu, Ms, time.process_time() - begun,
    )  # fmt: skip


def _measured(given: Draw) -> KnownRun:
    return measured(*given)


def table(ran: list[KnownRun]) -> Iterator[str]:
    """The rows of the table in Markdown."""
    yield (
        "| plant since | present gains | by the step alone | then by pulses | refused | time of the step alone, Pu: "
        "p50 / p90 / max | time with pulses | error of Ms: p50 / p90 / max | wrong |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for change, present in product(CHANGES, PRESENT):
        mine = [each for each in ran if (each.change, each.present) == (change, present)]
        if not mine:
            continue
        alone, pulsed = ([each for each in mine if each.by == how] for how in ("trial", "pulses"))
        good = alone + pulsed
        why = Counter(each.reason for each in mine if each.by is None).most_common()
        yield (
            f"| {change} | {present} | {len(alone)} of {len(mine)} | {len(pulsed)} | "
            f"{', '.join(f'{a} {b}' for a, b in why) or '-'} | {spread([each.passed for each in alone], 2)} | "
            f"{spread([each.passed for each in pulsed], 2)} | {spread([each.error for each in good], 3)} | "
            f"{sum(each.error > WRONG for each in good)} |"
        )


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--plants", choices=("batch", "kept-apart"), default="kept-apart")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--changes", default=";".join(CHANGES))
    parser.add_argument("--present", default=";".join(PRESENT))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--save", type=Path, help="a line of JSON for every run; what it holds is not run again")
    given = parser.parse_args()
    check_names(parser, "change", given.changes.split(";"), CHANGES)
    check_names(parser, "present", given.present.split(";"), PRESENT)
    todo = [
        (plant, present, change, seed)
        for change in given.changes.split(";") for present in given.present.split(";")
        for plant in chosen(given.plants, given.every) for seed in range(1, given.seeds + 1)
    ]  # fmt: skip
    ran = list(run_all(KnownRun, _measured, todo, given.save, given.processes))
    print(*table(ran), sep="\n")


if __name__ == "__main__":
    main()
