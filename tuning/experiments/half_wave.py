"""When a half wave of a relay ends because PV goes the wrong way, and whether PV has moved beyond its noise at all."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint
from loopwright.tuning.reasons import Reason, Refused

AVERAGED = 3
"""Number of samples whose mean tells where PV is."""
BAND_NOISES = 5.0
"""The band around rest, in noises, where the relay's hysteresis is narrower."""
BAND_STEPS = 0.02
"""The narrowest band around rest, in permitted set-point steps: PV without noise creeps on one side of its rest during
a dead time."""
MOVED_NOISES = 5.0
"""The range of PV's averages, in their noises, above which PV has moved."""
TURNED_NOISES, TURNED_PART = 4.0, 0.1
"""PV has turned where it has come back from its farthest point by so many noises and this part of the way."""
INVERSE_T95 = 0.25
"""The longest inverse response, in T95: that of (1 - b s) / (T s + 1)^n turns after at most 0.21 T95 for n = 2, 0.3 for
n = 3, with a zero as slow as can be; those of the 50 models after 0.02."""
DEEP_STEPS, DEEP_T95 = 1.0, 0.05
"""From so many permitted set-point steps on PV has gone the wrong way where it has gone on for a dead time and this
part of T95, and does not slow down, as an inverse response does."""
FAR_STEPS = 3.0
"""From here on, in permitted steps, without that part of T95: it may be stated far too long."""
SLOWED = 0.8
"""Speed of PV in the second half of the time since it left its band, over that in the first half, below which it slows
down."""
GOES_ON_PART = 0.03
"""Part of the way by which PV has to go further, else it has come to rest: a load that came before the answer to MV."""
ANSWERED_T95 = 1.5
"""The answer to MV has begun by then, also where T95 is stated too short: a PV that is on the wrong side still, and has
not turned, goes the wrong way."""
MIN_SAMPLES = 6
LATER_DELAYS, LATER_HALVES = 2.0, 3.0
"""A later half wave begins on the wrong side. There PV may go on for the longer of so many times the delay of its first
answer, with an inverse response, and so many times the longest half wave."""


def has_moved(pv: Sequence[float], noise: float, smallest: float) -> bool:
    """Whether PV has moved beyond its noise.

    pv: samples, PV units. noise: its standard deviation. smallest: the smallest move that counts, PV units. Averages
    more and more samples are looked at: of a small, slow answer each sample is within the noise.
    """
    x = np.asarray(pv, dtype=float)
    window = 1
    sums = np.concatenate([[0.0], np.cumsum(x - x[0])]) if len(x) else np.zeros(1)
    while 2 * window <= len(x):
        means = (sums[window:] - sums[:-window]) / window
        if float(np.ptp(means)) > max((MOVED_NOISES + 2.0) * noise / math.sqrt(window), smallest):
            return True
        window *= 2
    return False


class HalfWaves:
    """Follows PV through the half waves of a relay.

    facts, point: what is known of the loop, and the operating point at rest.
    noise: of PV, PV units. hysteresis: of the relay, PV units.
    """

    def __init__(self, facts: Facts, point: OperatingPoint, noise: float, hysteresis: float) -> None:
        self._facts, self._rest, self._noise = facts, point.pv, noise
        self._band = max(hysteresis, BAND_NOISES * noise / math.sqrt(AVERAGED), BAND_STEPS * facts.sp_deviation)
        self._last: list[float] = []
        self._samples = 0
        self._delay = 0
        """The number of samples until PV first left its band; 0 where it has not."""
        self._longest = 0
        self._switched_at = 0
        self._away: list[float] = []
        """How far PV is on the wrong side, since it left its band there, PV units."""
        self._farthest = 0.0

    def switched(self) -> None:
        """Notes that the relay has switched."""
        self._longest = max(self._longest, self._samples - self._switched_at)
        self._switched_at = self._samples
        self._away.clear()
        self._farthest = 0.0

    def goes_wrong(self, pv: float, up: bool) -> bool:
        """Takes the next sample: whether PV goes the wrong way for longer than any inverse response.

        up: whether MV drives PV up, if the controller's action is right.
        """
        self._samples += 1
        self._last = [*self._last[-AVERAGED + 1 :], pv]
        if len(self._last) < AVERAGED:
            return False
        deviation = sum(self._last) / AVERAGED - self._rest
        if not self._delay and abs(deviation) > self._band:
            self._delay = self._samples
        wrong = -deviation if up else deviation
        if wrong <= self._band or wrong < self._farthest - self._turned():
            self._away.clear()
            self._farthest = wrong if wrong > self._band else 0.0
            return False
        self._farthest = max(self._farthest, wrong)
        self._away.append(wrong)
        return self._too_long(len(self._away))

    def wrong_sign(self) -> Refused:
        """The refusal of a first half wave in which PV goes the wrong way."""
        Ts = self._facts.sample_time_s
        return Refused(
            Reason.WRONG_SIGN,
            f"PV went the wrong way: {len(self._away) * Ts:.3g} s after it left its band it is {self._farthest:.4g} "
            f"away, and has not turned; the relay began {self._samples * Ts:.4g} s ago",
        )

    def _turned(self) -> float:
        return max(TURNED_NOISES * self._noise / math.sqrt(AVERAGED), TURNED_PART * self._farthest)

    def _too_long(self, away: int) -> bool:
        facts = self._facts
        inverse = INVERSE_T95 * facts.T95_s / facts.sample_time_s
        if self._switched_at:
            longest = max(LATER_DELAYS * self._delay + inverse, LATER_HALVES * self._longest)
            return away > longest and self._goes_on(away)
        if away < max(self._delay, MIN_SAMPLES):
            return False
        if self._samples > ANSWERED_T95 * facts.T95_s / facts.sample_time_s:
            return True
        if away > inverse:
            return self._goes_on(away)
        step = facts.sp_deviation
        deep = self._farthest > DEEP_STEPS * step and away > DEEP_T95 * facts.T95_s / facts.sample_time_s
        return (deep or self._farthest > FAR_STEPS * step) and not self._slows_down(away)

    def _goes_on(self, away: int) -> bool:
        """Whether PV has gone further in the last quarter of the time than its noise alone makes it seem."""
        quarter = max(away // 4, 1)
        last, before = (sum(part) / quarter for part in (self._away[-quarter:], self._away[-2 * quarter : -quarter]))
        return last - before > self._smallest()

    def _slows_down(self, away: int) -> bool:
        half = away // 2
        first, second = self._away[half] - self._away[0], self._away[-1] - self._away[half]
        return second < max(SLOWED * first, self._smallest())

    def _smallest(self) -> float:
        return max(2.0 * self._noise, GOES_ON_PART * self._farthest)
