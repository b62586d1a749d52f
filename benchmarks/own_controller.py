"""How often the controller check takes our own device for another one: never, and how near it comes to that.

    python -m benchmarks.own_controller [--every N] [--seeds N]

The device's algorithm in memory, with all values rounded to the REAL32 of the bus, on every N-th plant, by relay and by
pulses of the set-point, with noise, coarse PV, lost samples, loads, MV at its limits and ramps of the set-point. Of
each check the rms of the difference between recorded and computed MV is counted in roundings of a REAL32; more than
`EXACT` of them would make the check look for another law.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from unittest.mock import patch

import benchmarks.pulses
import benchmarks.tuning
from benchmarks.cases import CASES, FURTHER, Case
from benchmarks.command import parser_of
from benchmarks.disturbances import Disturbance
from benchmarks.plants import Plant, plants
from loopwright.controller.channel import Channel
from loopwright.protocol.real32 import nearest, shortest
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.tuning.experiments.control_record import ControlRecord
from loopwright.tuning.experiments.controller_check import EXACT, ControllerCheck, check_controller
from loopwright.tuning.plan import Command, Sample
from loopwright.tuning.reasons import Reason

USERS = ("experiments.controller_mismatch", "fast.evaluation.controller_effect")
EXACT_PV = Case("PI no noise", 0.0)
BY_RELAY = (
    EXACT_PV,
    *(CASES[name] for name in ("PI 0.5 %", "PI 2 %", "PI 2 % + load", "PID 1 %")),
    *(FURTHER[name] for name in ("PV in steps of span/50", "2 % of samples lost", "MV ends at 1.05", "not at rest")),
)
BY_PULSES = tuple(
    benchmarks.pulses.EVERY[name]
    for name in ("PI 0.5 %", "PI 2 %", "PI 2 % + load", "PI 1 %, little MV", "PID 1 %", "PI 1 %, a step in 1 Pu")
)
COARSE = Case("PI 0.5 %, PV in steps of a 50th", 0.005, Disturbance(quantum=0.02), limits=3.0)


@dataclass(slots=True)
class Count:
    """runs, mismatches: how many. checks: with something to compare. samples: compared in them. roundings: the most."""

    runs: int = 0
    mismatches: int = 0
    checks: int = 0
    others: int = 0
    samples: int = 0
    roundings: float = 0.0

    def listen(self, record: ControlRecord) -> ControllerCheck:
        found = check_controller(record)
        self.checks += found.samples > 0
        self.others += not found.exact
        self.samples += found.samples
        self.roundings = max(self.roundings, found.roundings)
        return found

    def end(self, reason: str | None) -> None:
        self.runs += 1
        self.mismatches += reason == Reason.CONTROLLER_MISMATCH


STEP, ANSWER = RehearsedLoop.step, Channel.step


def stepped(loop: RehearsedLoop, commands: Sequence[Command]) -> Sample:
    """A step of a loop in memory whose values are those of a bus."""
    sample = STEP(loop, commands)
    return sample._replace(sp=shortest(nearest(sample.sp)), pv=nearest(sample.pv), mv=nearest(sample.mv))


def answered(channel: Channel, pv: float) -> float:
    """The MV of a controller that has PV from a bus."""
    return ANSWER(channel, nearest(pv))


def counted(of: Sequence[Plant], seeds: int) -> Iterator[tuple[str, Count]]:
    """Each case with its count."""
    for case in BY_RELAY:
        yield f"relay, {case.name}", _count(partial(_relay, case), of, seeds)
    for case in (*BY_PULSES, COARSE):
        yield f"pulses, {case.name}", _count(partial(_pulses, case), of, seeds)


def _relay(case: Case, plant: Plant, seed: int) -> str | None:
    return benchmarks.tuning.measure(case, plant, seed).reason


def _pulses(case: Case, plant: Plant, seed: int) -> str | None:
    present = ("sluggish", "typical", "nearly unstable")[seed % 3]
    return benchmarks.pulses.measure(plant, present, case, seed).reason


def _count(measure: Callable[[Plant, int], str | None], of: Sequence[Plant], seeds: int) -> Count:
    count = Count()
    with ExitStack() as patched:
        for user in USERS:
            patched.enter_context(patch(f"loopwright.tuning.{user}.check_controller", count.listen))
        patched.enter_context(patch.object(RehearsedLoop, "step", stepped))
        patched.enter_context(patch.object(Channel, "step", answered))
        for plant in of:
            for seed in range(seeds):
                count.end(measure(plant, seed + 1))
    return count


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--every", type=int, default=4, metavar="N")
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    total = Count()
    print("| case | runs | checks | samples compared | largest difference, roundings | taken for another |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, count in counted(plants()[:: given.every], given.seeds):
        print(_line(name, count), flush=True)
        for field in ("runs", "mismatches", "checks", "others", "samples"):
            setattr(total, field, getattr(total, field) + getattr(count, field))
        total.roundings = max(total.roundings, count.roundings)
    print(_line("all", total))
    print(f"\nAnother law is looked for above {EXACT:g} roundings; {total.others} checks were.")


def _line(name: str, count: Count) -> str:
    return f"| {name} | {count.runs} | {count.checks} | {count.samples} | {count.roundings:.2f} | {count.mismatches} |"


if __name__ == "__main__":
    main()
