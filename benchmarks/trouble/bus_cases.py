"""The plants and the kinds of trouble that are retuned through a bus, as the plant simulator takes them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from benchmarks.plants import Plant, plant_of, plants
from benchmarks.trouble.plants import trouble_plants
from loopwright.tuning.models import TransferFunction

REST = 50.0
"""Where MV (percent) and PV are at rest."""
NAMES = (
    "P1_T=0.3", "P2_T=2", "P4_n=4", "P5_alpha=0.7", "P8_alpha=0.5", "model-5", "model-18", "model-35", "model-45",
)  # fmt: skip
"""Of the batch and of the 50 models: one lag with much dead time, two and four equal lags, four lags far apart, an
inverse response, then dead times of 3 to 30 % of the ultimate period with one, two and five poles and their zeros."""


@cache
def bus_plants() -> tuple[Plant, ...]:
    """The three plants of the rehearsals and nine more, each in the unit of PV that makes its gain 1."""
    known = {plant.name: plant for plant in plants()}
    return (*trouble_plants(), *(_of_gain_1(known[name]) for name in NAMES))


def _of_gain_1(plant: Plant) -> Plant:
    K = plant.num[-1] / plant.den[-1]
    return plant_of(plant.name, TransferFunction(tuple(each / K for each in plant.num), plant.den, plant.L))


@dataclass(frozen=True, slots=True)
class BusCase:
    """A kind of trouble as the plant simulator has it.

    name: of the same kind at the same level in `benchmarks.trouble.kinds.TROUBLES`.
    more: what its plant has besides its transfer function.  drift: from the beginning of the test on the gain moves
    evenly to so many times its size, for so many Pu; 0 for none.
    """

    name: str
    more: Callable[[Plant], dict[str, Any]] = lambda plant: {}
    drift: tuple[float, float] = (1.0, 0.0)

    def model(self, plant: Plant) -> str:
        """The plant in this trouble, in JSON."""
        linear = {"num": plant.num, "den": plant.den, "dead_time_s": plant.L, "mv": REST, "pv": REST}
        return json.dumps(linear | self.more(plant))


BUS_CASES = {
    each.name: each
    for each in (
        BusCase("none: linear"),
        BusCase(
            "second path: 0.3 of the effect 1 Pu later",
            lambda plant: {"second_path": {"share": 0.3, "later_s": plant.Pu}},
        ),
        BusCase("gain drifts over 8 Pu: to 1.3", drift=(1.3, 8.0)),
        BusCase("gain below over above: 2", lambda plant: {"valve": {"gain_below": 2.0}}),
        BusCase("equal percentage valve: R 50", lambda plant: {"valve": {"equal_percentage": 50.0}}),
        BusCase("backlash: 1 % of MV", lambda plant: {"valve": {"backlash_pct": 1.0}}),
        BusCase(
            "sine on PV: 0.15 % at 0.5 ultimate frequencies",
            lambda plant: {"sine": {"amplitude": 0.15, "period_s": 2.0 * plant.Pu}},
        ),
    )
}
