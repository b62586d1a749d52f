"""What lies between the plant and the PV that the controller gets: noise, and sensors that hold, send late or end."""

from __future__ import annotations

from benchmarks.trouble.chain import Part, Setting


class Noise(Part):
    """White, normally distributed."""

    def __init__(self, setting: Setting) -> None:
        self._random, self._size = setting.random(1), setting.noise

    def step(self, value: float) -> float:
        return value + self._size * float(self._random.standard_normal())
