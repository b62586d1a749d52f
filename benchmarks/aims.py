"""What the set-point weight is worth on the true plants, for each aim, beside the best PI or PID with b = 1.

    python -m benchmarks.aims [--every N] [--Ms 1.3 1.6 2.0] [--derivative]

Both designs know the plant: nothing is identified. J is half and half, each IAE over its minimum for b = 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.command import parser_of
from benchmarks.plants import Plant, plants
from loopwright.tuning.fast.design.design import Aim, DesignSpec, GainDesign

PLAIN = (1.0, 1.0)
HEAD = (
    "| Ms | aim | J: p10 / p50 / p90 | IAE, set-point | IAE, load | overshoot, % | that of b = 1 | b |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)

COLUMNS = {"J": 3, "setpoint": 2, "load": 2, "overshoot": 1, "overshoot_plain": 1, "b": 2}
"""Of the table, with their decimals."""


@dataclass(frozen=True, slots=True)
class Worth:
    """Gains beside the best ones with b = 1: ratios of J and of both IAE; both overshoots, percent; b."""

    J: float
    setpoint: float
    load: float
    overshoot: float
    overshoot_plain: float
    b: float


def worth(plant: Plant, spec: DesignSpec) -> Worth:
    """The gains of a specification on the true plant."""
    plain = GainDesign(plant.model(), DesignSpec(spec.Ms, spec.derivative, weights=PLAIN), plant.Pu)
    design = GainDesign(plant.model(), spec, plant.Pu)
    before, after = plain.best(), design.best()
    least = before.minimum
    J = [0.5 * each.cost.setpoint / least.setpoint + 0.5 * each.cost.load / least.load for each in (before, after)]
    overshoots = []
    for by, gains in ((plain, before.gains), (design, after.gains)):
        found = by.cost.responses(gains.Kp, gains.Ti, gains.Td, spec.N)
        error = found.error + (1.0 - gains.b) * gains.Kp * found.load
        overshoots.append(100.0 * max(0.0, -float(error.min())))
    return Worth(
        J[1] / J[0], after.cost.setpoint / before.cost.setpoint, after.cost.load / before.cost.load, overshoots[1],
        overshoots[0], after.gains.b,
    )  # fmt: skip


def table(which: Sequence[Plant], bounds: Sequence[float], derivative: bool) -> Iterator[str]:
    """The rows of the table in Markdown."""
    yield HEAD
    for Ms in bounds:
        for aim in Aim:
            found = [worth(plant, DesignSpec(Ms, derivative, aim=aim)) for plant in which]
            shown = [spread([getattr(each, of) for each in found], digits) for of, digits in COLUMNS.items()]
            yield f"| {Ms:g} | {aim} | {' | '.join(shown)} |"


def spread(values: Sequence[float], digits: int) -> str:
    return " / ".join(f"{each:.{digits}f}" for each in np.percentile(values, (10, 50, 90)))


if __name__ == "__main__":
    parser = parser_of(__doc__)
    parser.add_argument("--every", type=int, default=1, help="every so manieth plant (default: %(default)s)")
    parser.add_argument("--Ms", type=float, nargs="+", default=[1.3, 1.6, 2.0], help="default: %(default)s")
    parser.add_argument("--derivative", action="store_true", help="a PID where it is better")
    given = parser.parse_args()
    for row in table(plants()[:: given.every], given.Ms, given.derivative):
        print(row, flush=True)
