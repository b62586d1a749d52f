"""The kinds of trouble by name, each with its levels; `docs/trouble.md` says what each is.

A kind acts within the record when what it does shows while the test runs, and later when a part of it comes only
afterwards: a longer look alone tells that one.
Kinds whose trouble is the controller's, not the plant's, are not here: nothing between MV and PV can be them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

from benchmarks.plants import SAMPLES_PER_PERIOD, Plant, plant_of
from benchmarks.trouble.chain import Build, Part, Parts, Setting
from benchmarks.trouble.processes import DriftingGain, Recirculation, SecondPath, linear
from benchmarks.trouble.sensors import Noise
from loopwright.tuning.models import TransferFunction

NOISE = 0.01


@cache
def trouble_plants() -> tuple[Plant, ...]:
    """The plants in trouble: gain 1, times in seconds."""
    return (
        plant_of("lag, dead time 0.3", TransferFunction((1.0,), (1.0, 1.0), 0.3)),
        plant_of("lag, dead time 1", TransferFunction((1.0,), (1.0, 1.0), 1.0)),
        plant_of("two lags, dead time 0.2", TransferFunction((1.0,), (1.0, 2.0, 1.0), 0.2)),
    )


@dataclass(frozen=True, slots=True)
class Trouble:
    """A kind of trouble at one level.

    build: the parts of its plant.  later: it acts later than the record.  noise: of the span.
    substeps: of the parts before the sensor, in a sample.  samples: in Pu.
    amplitude: of the relay, and the permitted step of the set-point, percent.
    """

    kind: str
    level: str
    build: Build
    later: bool = False
    noise: float = NOISE
    substeps: int = 1
    samples: int = SAMPLES_PER_PERIOD
    amplitude: float = 5.0

    @property
    def name(self) -> str:
        return f"{self.kind}: {self.level}"


Made = Callable[[Setting], Part]


def plain(setting: Setting) -> Parts:
    """The plant without trouble."""
    return Parts([linear(setting)], [Noise(setting)])


def instead(process: Made) -> Build:
    """In place of the linear plant."""
    return lambda setting: Parts([process(setting)], [Noise(setting)])


def before(part: Made) -> Build:
    """Between MV and the linear plant."""
    return lambda setting: Parts([part(setting), linear(setting)], [Noise(setting)])


PATHS = (
    (0.3, 0.5), (0.3, 1), (0.3, 2), (0.3, 4), (0.3, 8), (0.6, 2), (0.6, 4), (-0.3, 1), (-0.3, 2), (-0.3, 4),
)  # fmt: skip
LATER = 4
"""Pu from which on a second path acts later than the record."""


def _second_path(share: float, later: float) -> Trouble:
    build = instead(lambda setting: SecondPath(setting, share, later))
    return Trouble("second path", f"{share:g} of the effect {later:g} Pu later", build, later >= LATER)


def _recirculation(share: float) -> Trouble:
    build = instead(lambda setting: Recirculation(setting, share, LATER))
    return Trouble("recirculation", f"{share:g} comes back {LATER} Pu later", build, later=True, substeps=4)


def _drift(end: float, noise: float = NOISE) -> Trouble:
    level = f"to {end:g}" if noise == NOISE else f"to {end:g}, {100.0 * noise:g} % noise"
    return Trouble("gain drifts over 8 Pu", level, before(lambda s: DriftingGain(s, end, 8.0)), noise=noise)


def _all() -> Iterator[Trouble]:
    yield Trouble("none", "linear", plain)
    yield from (_second_path(*each) for each in PATHS)
    yield from map(_recirculation, (0.3, 0.6, 0.8, -0.5))
    yield from map(_drift, (0.7, 0.9, 1.1, 1.3))


TROUBLES = {each.name: each for each in _all()}
