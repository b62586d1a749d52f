"""A user's own plant, as JSON: a transfer function in PV units per percent of MV, and what else a plant can have."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from functools import partial

from loopwright.plantsim.catalogue import CatalogueModel, Entry, LaterPath, PlantFacts
from loopwright.plantsim.imperfect import Sine
from loopwright.plantsim.valves import Backlash, EqualPercentage, Stiction, TwoGains, Valve
from loopwright.protocol.real32 import fits

MORE = ("second_path", "valve", "sine")
"""Names of what a plant can have besides its transfer function and its operating point."""
_VALVES: dict[str, tuple[Callable[[float, int], Valve], float, str]] = {
    "backlash_pct": (lambda size, seed: Backlash(size, random.Random(seed).uniform(-1.0, 1.0)), 0.0, "above 0 %"),
    "stiction_pct": (lambda size, seed: Stiction(size), 0.0, "above 0 %"),
    "equal_percentage": (lambda size, seed: EqualPercentage(size), 1.0, "a rangeability, above 1"),
    "gain_below": (lambda size, seed: TwoGains(size), 0.0, "above 0"),
}
"""By name: how it is made, what its number must exceed, and that in words."""


def own_plant(text: str) -> Entry:
    """Returns the entry of a plant that is in no catalogue, in PV units per percent of MV.

    text: the JSON object {"num": [0.8], "den": [120, 1], "dead_time_s": 15, "mv": 40, "pv": 65}: coefficients from the
    highest power down, and MV (percent) and PV where the plant starts, 50 where they are left out. Besides, with

    - "second_path": {"share": 0.4, "later_s": 180}, MV acts again so much later, with this part of the gain;
    - "valve": {"backlash_pct": 1}, a valve follows half of so many percent of MV behind; {"stiction_pct": 1}, it sticks
      until MV is off by so many percent; {"equal_percentage": 50}, its characteristic is an equal-percentage one of
      this rangeability, with a gain of 1 where it starts; {"gain_below": 2}, the gain below rest is so many times that
      above;
    - "sine": {"amplitude": 0.2, "period_s": 30}, so much is added to PV, in PV units.

    Raises ValueError.
    """
    data = json.loads(text)
    known = {"num", "den", "dead_time_s", "mv", "pv", *MORE}
    if not isinstance(data, dict) or not {"num", "den"} <= data.keys() <= known:
        optional = "dead_time_s, mv, pv, second_path, valve and sine"
        raise ValueError(f"a plant is a JSON object with num, den and perhaps {optional}, not {text}")
    numbers = {name: float(data.get(name, other)) for name, other in (("dead_time_s", 0.0), ("mv", 50.0), ("pv", 50.0))}
    if not 0.0 <= numbers["mv"] <= 100.0:
        raise ValueError(f"mv is {numbers['mv']:g}: MV is in percent, 0 to 100")
    if not fits(numbers["pv"]):
        raise ValueError(f"pv is {numbers['pv']:g}: PV is finite, and within the range of a REAL32")
    num, den = (tuple(float(each) for each in data[name]) for name in ("num", "den"))
    if not num or not any(den):
        raise ValueError(f"num and den need coefficients, den one that is not 0, not {text}")
    gain = num[-1] / den[-1] if den[-1] else None
    facts = PlantFacts(
        description="a user's own plant",
        Ku=None,
        Pu_s=None,
        T95_s=None,
        static_gain=gain,
        reverse=num[-1] > 0.0,
        mv_nominal_pct=numbers["mv"],
        pv_nominal=numbers["pv"],
        mv_per_unit=1.0,
    )
    return Entry(
        "own",
        facts,
        CatalogueModel(num, den, numbers["dead_time_s"]),
        _second_path(data.get("second_path")),
        _valve(data.get("valve")),
        _sine(data.get("sine")),
    )


def _second_path(data: object) -> LaterPath | None:
    """Raises ValueError."""
    if data is None:
        return None
    if not isinstance(data, dict) or data.keys() != {"share", "later_s"}:
        raise ValueError(f"second_path is a JSON object with share and later_s, not {data}")
    path = LaterPath(float(data["share"]), float(data["later_s"]))
    if not path.later_s >= 0.0:
        raise ValueError(f"later_s is {path.later_s:g} s: a second path acts later than the first one")
    return path


def _valve(data: object) -> Callable[[int], Valve] | None:
    """Raises ValueError."""
    if data is None:
        return None
    if not isinstance(data, dict) or len(data) != 1 or not data.keys() <= _VALVES.keys():
        raise ValueError(f"valve is a JSON object with one of {', '.join(_VALVES)}, not {data}")
    [(name, value)] = data.items()
    make, least, range_text = _VALVES[name]
    size = float(value)
    if not (least < size and math.isfinite(size)):
        raise ValueError(f"{name} of the valve is {size:g}: it must be {range_text}")
    return partial(make, size)


def _sine(data: object) -> Sine | None:
    """Raises ValueError."""
    if data is None:
        return None
    if not isinstance(data, dict) or data.keys() != {"amplitude", "period_s"}:
        raise ValueError(f"sine is a JSON object with amplitude and period_s, not {data}")
    sine = Sine(float(data["amplitude"]), float(data["period_s"]))
    if not (math.isfinite(sine.amplitude) and math.isfinite(sine.period_s) and sine.period_s > 0.0):
        raise ValueError(f"the period of the sine is {sine.period_s:g} s, its amplitude {sine.amplitude:g}: both are "
                         "finite, and the period is above 0")  # fmt: skip
    return sine
