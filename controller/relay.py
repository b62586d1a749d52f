"""The relay of the experiment: it switches between two outputs around a working output, by the control error."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import astuple, dataclass

MAX_AVERAGED = 100
"""Largest number of samples whose mean switches the relay."""


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """The settings of a relay: MV = working_output + amplitude or working_output - amplitude_low.

    amplitude, amplitude_low, working_output: in MV units; an amplitude_low of 0 means that it equals amplitude.
    hysteresis: in PV units; the relay switches up at e >= hysteresis and down at e <= -hysteresis (below 0 for 0).
    average: number of samples whose mean error switches the relay.
    pv_low, pv_high, max_samples: the relay ends when PV leaves these limits (PV units) or after so many samples.
    Raises ValueError.
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
    """A running relay. It begins on the high side unless the error would switch it; after another relay it begins on
    that relay's side.

    high: whether MV is the upper output.  errors: the errors whose mean switches the relay.
    """

    def __init__(self, settings: RelaySettings, error: float, before: Relay | None = None) -> None:
        self.settings = settings
        self.samples_left = settings.max_samples
        self.high = error > -settings.hysteresis or error >= 0
        self.errors = deque([error], settings.average)
        if before is not None:
            self.high, self.errors = before.high, deque(before.errors, settings.average)

    def output(self, error: float) -> float:
        """Returns the MV for this error (sign by the controller's action), before the limits."""
        settings, errors = self.settings, self.errors
        errors.append(error)
        mean = sum(errors) / len(errors)
        if mean >= settings.hysteresis:
            self.high = True
        elif mean <= -settings.hysteresis:
            self.high = False
        swing = settings.amplitude if self.high else -(settings.amplitude_low or settings.amplitude)
        return settings.working_output + swing
