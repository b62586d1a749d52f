"""The catalogue of plants, with known facts of each, for the I/O device, rehearsals and benchmarks.

model-1 .. model-50 are the test plants of Stopakevych et al. (Problemele Energeticii Regionale). Where a coefficient
or the dead time is illegible in the print, the entry's `confidence` says so; it is then a fixture, not the paper's
model.
All linear plants work around 50 % and PV 50 with 100 % per unit of model input, so 0..100 % is u = -0.5..+0.5 and a
gain on the bus is 100 times the gain of the model.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files

from loopwright.plantsim.imperfect import ImperfectPlant, Sine
from loopwright.plantsim.plant import LinearPlant, Plant, TwoPaths
from loopwright.plantsim.reactor import MV_NOMINAL, STEADY_STATE, Reactor
from loopwright.plantsim.valves import Valve


@dataclass(frozen=True, slots=True)
class PlantFacts:
    """Known facts of a plant.

    Ku, Pu_s: ultimate gain in model units and ultimate period in s, of the continuous plant under P control; None where
    there is none.
    T95_s: time after which an open-loop step response stays within 5 %, s; None for an integrating plant.
    reverse: the action that its controller needs (False for a plant with negative gain).
    confidence: how well the source is legible.
    """

    description: str
    Ku: float | None
    Pu_s: float | None
    T95_s: float | None
    static_gain: float | None
    reverse: bool = True
    pv_unit: str = ""
    mv_nominal_pct: float = 50.0
    pv_nominal: float = 50.0
    mv_per_unit: float = 100.0
    confidence: str = "exact"

    @property
    def Ku_on_bus(self) -> float | None:
        """Returns Ku in percent of MV per PV unit."""
        return None if self.Ku is None else self.Ku * self.mv_per_unit


@dataclass(frozen=True, slots=True)
class CatalogueModel:
    """A transfer function: coefficients from the highest power down, time in s."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    dead_time_s: float


@dataclass(frozen=True, slots=True)
class LaterPath:
    """A path by which MV acts again: the share of the plant's gain that it has, and how much later it acts, s."""

    share: float
    later_s: float


@dataclass(frozen=True, slots=True)
class Entry:
    """One plant; `model` is None for plants that are not linear.

    second_path: of one on which MV acts twice.  valve: makes its valve, with a seed; None for a straight line.
    sine: on its PV.
    """

    name: str
    facts: PlantFacts
    model: CatalogueModel | None
    second_path: LaterPath | None = None
    valve: Callable[[int], Valve] | None = None
    sine: Sine | None = None

    def build(self, sample_time_s: float, noise_std: float = 0.0, seed: int = 1) -> Plant:
        """Returns the plant, at rest, with this sample time (s), noise (PV units) and seed."""
        if self.model is None:
            return Reactor(sample_time_s, noise_std=noise_std, seed=seed)
        plant = self._linear(self.model, sample_time_s, noise_std, seed)
        if self.valve is None and self.sine is None:
            return plant
        valve = None if self.valve is None else self.valve(seed)
        return ImperfectPlant(plant, self.facts.mv_nominal_pct, sample_time_s, valve, self.sine)

    def _linear(self, model: CatalogueModel, sample_time_s: float, noise_std: float, seed: int) -> Plant:
        num, dead_time_s = model.num, model.dead_time_s
        first = self._path(num, dead_time_s, sample_time_s, self.facts.pv_nominal, noise_std, seed)
        if self.second_path is None:
            return first
        share, later_s = self.second_path.share, self.second_path.later_s
        again = self._path(tuple(share * each for each in num), dead_time_s + later_s, sample_time_s, 0.0, 0.0, seed)
        return TwoPaths(first, again)

    def _path(
        self,
        num: tuple[float, ...],
        dead_time_s: float,
        sample_time_s: float,
        pv_nominal: float,
        noise_std: float,
        seed: int,
    ) -> LinearPlant:
        assert self.model is not None
        low, high = (0.0, 100.0) if self.valve is None else (-math.inf, math.inf)  # MV's are those of the valve
        return LinearPlant(
            num,
            self.model.den,
            dead_time_s,
            sample_time_s,
            mv_nominal=self.facts.mv_nominal_pct,
            pv_nominal=pv_nominal,
            mv_per_unit=self.facts.mv_per_unit,
            noise_std=noise_std,
            seed=seed,
            mv_low=low,
            mv_high=high,
        )


def find(name: str) -> Entry:
    """Returns the entry of this name. Raises KeyError, which lists the names."""
    if name not in CATALOGUE:
        others = ", ".join(other for other in CATALOGUE if not other.startswith("model-"))
        raise KeyError(f"no plant named {name!r}; there are model-1 to model-50, {others}")
    return CATALOGUE[name]


def _printed_models() -> list[Entry]:
    data = json.loads(files("loopwright.plantsim").joinpath("models-50.json").read_text(encoding="utf-8"))
    entries = []
    for row in data["models"]:
        computed = row["computed"]
        facts = PlantFacts(
            description=f"test plant No. {row['id']} of the five-stage procedure",
            Ku=computed["Ku"],
            Pu_s=computed["Pu"],
            T95_s=computed["T95"],
            static_gain=computed["static_gain"],
            confidence=row["confidence"],
        )
        model = CatalogueModel(tuple(row["num"]), tuple(row["den"]), row["delay"])
        entries.append(Entry(f"model-{row['id']}", facts, model))
    return entries


_REACTOR = Entry(
    "reactor",
    PlantFacts(
        description="stirred reactor A + B -> C with inverse response and 10 s sensor delay",
        Ku=1.5294,
        Pu_s=42.53,
        T95_s=31.8,
        static_gain=0.7743,
        pv_unit="mol/m3",
        mv_nominal_pct=MV_NOMINAL,
        pv_nominal=STEADY_STATE[2],
        mv_per_unit=1.0,
        confidence="high",
    ),
    model=None,
)

_NAMED = [
    Entry(
        "fopdt", PlantFacts("first order, dead time 2 s", 8.5024, 7.442, 32.0, 1.0), CatalogueModel((1,), (10, 1), 2.0)
    ),
    Entry(
        "sopdt",
        PlantFacts("second order, dead time 1 s", 7.8757, 11.66, 37.8, 2.0),
        CatalogueModel((2,), (50, 15, 1), 1.0),
    ),
    Entry(
        "five-lags",
        PlantFacts("five equal lags", 2.8854, 8.648, 9.2, 1.0),
        CatalogueModel((1,), (1, 5, 10, 10, 5, 1), 0.0),
    ),
    Entry(
        "inverse-response",
        PlantFacts("right-half-plane zero", 3.1843, 16.19, 24.2, 1.0),
        CatalogueModel((-2, 1), (20, 9, 1), 1.0),
    ),
    Entry(
        "integrating",
        PlantFacts("level-like: integrates, dead time 1 s", 15.708, 4.0, None, None),
        CatalogueModel((0.1,), (1, 0), 1.0),
    ),
    Entry(
        "negative-gain",
        PlantFacts("PV falls as MV rises, dead time 2 s", 4.623, 7.325, 26.0, -1.5, reverse=False),
        CatalogueModel((-1.5,), (8, 1), 2.0),
    ),
]

CATALOGUE: dict[str, Entry] = {entry.name: entry for entry in [*_printed_models(), _REACTOR, *_NAMED]}
