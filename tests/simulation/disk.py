"""The controller's disk: what is synced outlives a power cut, what is not is gone."""

from __future__ import annotations

import math
from collections.abc import Sequence

from loopwright.controller.device import RetainedState
from tests.simulation.scheduler import Simulation

SOON_S = 0.4
AGAIN_S = 5.0


class PowerCut(BaseException):
    """The power fails in the middle of a write: nothing that the program would do afterwards is done."""


class Disk:
    """A `controller.device.RetainedStateStore`. cut_at: the write (counted from 1) in which the power fails."""

    def __init__(self, simulation: Simulation) -> None:
        self.kept: list[RetainedState] | None = None
        self.full = False
        self.full_at = -math.inf
        """When it was last found full."""
        self.writes = 0
        self.cut_at: int | None = None
        self._simulation = simulation
        self._waiting: list[RetainedState] | None = None
        self._power = 0

    def write_now(self, channels: Sequence[RetainedState]) -> None:
        self.writes += 1
        if self.full:
            self.full_at = self._simulation.now
            raise OSError(28, "No space left on device")
        if self.writes == self.cut_at:
            if self._simulation.random.random() < 0.5:
                self.kept = list(channels)
            self._simulation.note("disk", f"the power fails in the middle of a write, {self.kept}")
            raise PowerCut
        self.kept, self._waiting = list(channels), None

    def write_soon(self, channels: Sequence[RetainedState]) -> None:
        later = self._waiting is None
        self._waiting = list(channels)
        if later:
            self._simulation.after(SOON_S * self._simulation.random.random(), self._write, self._power)

    def _write(self, power: int) -> None:
        if power != self._power or self._waiting is None:
            return
        if self.full:
            self.full_at = self._simulation.now
            self._simulation.after(AGAIN_S, self._write, power)
        else:
            self.kept, self._waiting = self._waiting, None

    def power_off(self) -> None:
        """What waits to be written is lost."""
        self._power += 1
        self._waiting = None
