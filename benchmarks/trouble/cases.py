"""A kind of trouble at one level, as a case of the benchmark, and the ways in which parts make a plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.plants import SAMPLES_PER_PERIOD, Plant
from benchmarks.trouble.chain import Build, Part, Parts, Setting
from benchmarks.trouble.processes import linear
from benchmarks.trouble.sensors import Noise

NOISE = 0.01
FINE = 10
"""Substeps where a part moves within a sample."""
Made = Callable[[Setting], Part]


@dataclass(frozen=True, slots=True)
class Trouble:
    """A kind of trouble at one level.

    build: the parts of its plant.  of: the plant that it makes of one of the three.  later: it acts later than the
    record: what the test shows is not all of it.  noise: of the span.
    substeps: of the parts before the sensor, in a sample.  samples: in Pu.
    amplitude: of the relay's higher side, percent; half of it is the permitted step of the set-point.
    """

    kind: str
    level: str
    build: Build
    of: Callable[[Plant], Plant] = lambda plant: plant
    later: bool = False
    noise: float = NOISE
    substeps: int = 1
    samples: int = SAMPLES_PER_PERIOD
    amplitude: float = 10.0

    @property
    def name(self) -> str:
        return f"{self.kind}: {self.level}"


def build(
    before: Made | None = None,
    process: Made = linear,
    after: Made | None = None,
    noise: Made = Noise,
    sensor: Made | None = None,
) -> Build:
    """The parts of a plant in their order, those left out without trouble.

    before, after: between MV and the process, and between this and the noise.  sensor: after the noise.
    """

    def parts(setting: Setting) -> Parts:
        fine = [made(setting) for made in (before, process, after) if made]
        return Parts(fine, [made(setting) for made in (noise, sensor) if made])

    return parts
