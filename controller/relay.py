"""The relay of the experiment: two outputs around a working output, switched by the error."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import astuple, dataclass

MAX_AVERAGED = 100


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """MV = working_output + amplitude or - amplitude_low (0: the same); MV units, hysteresis in PV units.

    average: the mean error of so many samples switches the relay, up at e >= hysteresis and down at e <= -hysteresis
    (below 0 without hysteresis).  It ends by itself when PV leaves pv_low..pv_high or after max_samples.
    """

    amplitude: float
    hysteresis: float
    working_output: float
    max_samples: int
    pv_low: float
    pv_high: float
    amplitude_low: float = 0.0
    average: int = 1

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in astuple(self)):
            raise ValueError("values must be finite")
        if self.amplitude <= 0 or self.hysteresis < 0 or self.max_samples <= 0 or self.pv_low >= self.pv_high:
            raise ValueError("a relay needs amplitude > 0, hysteresis >= 0, max_samples > 0 and pv_low < pv_high")
        if self.amplitude_low < 0 or not 1 <= self.average <= MAX_AVERAGED:
            raise ValueError(f"a relay's low amplitude must be >= 0, its average 1 .. {MAX_AVERAGED} samples")


class Relay:
    """A running relay. It begins high unless that would switch it, after another relay on the side that one was on.

    high: whether MV is the upper output.  errors: those whose mean switches it.
    """

    def __init__(self, settings: RelaySettings, error: float, before: Relay | None = None) -> None:
        self.settings = settings
        self.samples_left = settings.max_samples
        self.high = error > -settings.hysteresis or error >= 0
        self.errors = deque([error], settings.average)
        if before is not None:
            self.high, self.errors = before.high, deque(before.errors, settings.average)

    def output(self, error: float) -> float:
        """MV for this error (action-signed), before the limits."""
        settings, errors = self.settings, self.errors
        errors.append(error)
        mean = sum(errors) / len(errors)
        if mean >= settings.hysteresis:
            self.high = True
        elif mean <= -settings.hysteresis:
            self.high = False
        swing = settings.amplitude if self.high else -(settings.amplitude_low or settings.amplitude)
        return settings.working_output + swing
