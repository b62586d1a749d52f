"""The phases of pulses of the manual output, as whoever looks at the controller sees them."""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    UP = "up"
    """MV is away from the manual output found."""
    BACK = "back"
    """MV has just come back, and PV is on its way."""
    REST = "rest"
    """PV is left to itself before the next pulse."""


class PulseWatch:
    """Tells the phase from what is seen of the loop. rested: samples after a pulse from which on PV is at rest."""

    def __init__(self, rested: float) -> None:
        self.pulses = 0
        self._rested = rested
        self._was_away = False
        self._turned = 0.0

    def see(self, away: bool, sample: float) -> Phase | None:
        """The present phase; None before the first pulse.

        away: whether the manual output is another one than that found. sample: the number of the sample.
        """
        if away is not self._was_away:
            self.pulses += away
            self._was_away, self._turned = away, sample
        if not self.pulses:
            return None
        if away:
            return Phase.UP
        return Phase.REST if sample - self._turned >= self._rested else Phase.BACK
