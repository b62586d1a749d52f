"""Settling times and movements of MV asked for on the true plants: what is kept, at which Ms, and whether what a
refusal names is kept when it is asked for.

    python -m benchmarks.requirements [--every N] [--derivative]

Both are asked for in multiples of what the best gains for Ms 1.6 have; a movement of MV at least a tenth above 1/K.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.command import parser_of
from benchmarks.plants import Plant, plants
from loopwright.tuning.analysis.comparison import LoopPerformance, loop_performance
from loopwright.tuning.fast.design import DesignSpec, GainDesign
from loopwright.tuning.fast.requirements import required
from loopwright.tuning.reasons import Refused

PARTS = (("settling_s", (0.3, 0.9, 1.5, 3.0)), ("mv_peak", (0.8, 0.5)))
HEAD = (
    "| asked for | kept | Ms: p10 / p50 / p90 | past what was asked for, at most | IAE, load | refused | "
    "kept when what the refusal names is asked for |\n| --- | --- | --- | --- | --- | --- | --- |"
)


@dataclass(frozen=True, slots=True)
class Kept:
    """Gains that keep a requirement: Ms, the ratio to what was asked for, and the load's IAE beside the best gains."""

    Ms: float
    ratio: float
    load: float


def performance(plant: Plant, spec: DesignSpec) -> LoopPerformance:
    return loop_performance(plant.model(), required(GainDesign(plant.model(), spec, plant.Pu)).gains)


def asking(spec: DesignSpec, name: str, value: float) -> DesignSpec:
    return replace(spec, settling_s=value) if name == "settling_s" else replace(spec, mv_peak=value)


def reached(found: LoopPerformance, name: str) -> float:
    assert found.setpoint is not None
    value = getattr(found.setpoint, name)
    return math.inf if value is None else float(value)


def asked_of(plant: Plant, spec: DesignSpec, name: str, part: float) -> tuple[Kept | None, bool | None]:
    """What comes of a requirement; of a refusal, whether what it names is kept, None where it names nothing."""
    plain = performance(plant, spec)
    model = plant.model()
    maximum = part * reached(plain, name)
    if name == "mv_peak" and math.isfinite(model.static_gain):
        maximum = max(maximum, 1.1 / abs(model.static_gain))
    wanted = asking(spec, name, maximum)
    try:
        found = performance(plant, wanted)
    except Refused as refused:
        named = re.search(r"at least ([\d.e+-]+)", refused.detail)
        if named is None:
            return None, None
        try:
            again = performance(plant, asking(spec, name, float(named[1])))
        except Refused:
            return None, False
        return None, reached(again, name) <= float(named[1]) * (1.0 + 2e-4)
    assert found.Ms is not None and found.load is not None and plain.load is not None
    assert found.load.IAE is not None and plain.load.IAE is not None
    return Kept(found.Ms, reached(found, name) / maximum, found.load.IAE / plain.load.IAE), None


def table(which: Sequence[Plant], derivative: bool) -> Iterator[str]:
    """The rows of the table in Markdown."""
    yield HEAD
    for name, parts in PARTS:
        for part in parts:
            answers = [asked_of(plant, DesignSpec(1.6, derivative), name, part) for plant in which]
            kept = [each for each, _ in answers if each is not None]
            again = [named for each, named in answers if each is None and named is not None]
            Ms = [each.Ms for each in kept]
            over = 100.0 * max([0.0, *(each.ratio - 1.0 for each in kept)])
            load = [each.load for each in kept]
            yield (
                f"| {name}, {part:g} of that | {len(kept)}/{len(answers)} | {spread(Ms)} | {over:.2f} % "
                f"| {spread(load)} | {len(answers) - len(kept)} | {sum(again)}/{len(again)} |"
            )


def spread(values: Sequence[float]) -> str:
    return " / ".join(f"{each:.2f}" for each in np.percentile(values, (10, 50, 90))) if values else "-"


if __name__ == "__main__":
    parser = parser_of(__doc__)
    parser.add_argument("--every", type=int, default=1, help="every so manieth plant (default: %(default)s)")
    parser.add_argument("--derivative", action="store_true", help="a PID where it is better")
    given = parser.parse_args()
    for row in table(plants()[:: given.every], given.derivative):
        print(row, flush=True)
