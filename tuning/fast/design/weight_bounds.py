"""The set-point weights b with which a loop of given Kp, Ti and Td keeps what is asked for after a set-point step.

With x = 1 - b every response to a set-point step is linear in x: the error e_1 + x*Kp*y_load, and the change of MV

    u_x = u_1 - x*Kp*(1 + u_load)

since the set-point acts through b*Kp as a load disturbance at the plant's input would, and MV has that part beside what
the feedback adds. So "the error stays within the band from the time T on", "MV moves by at most so much" and "PV
overshoots by at most so much" are each kept on one interval of x, and together on one interval too. From the bounds of
one time each, gathered from the end of the response backwards, the shortest settling time that any b has follows
without a search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from loopwright.tuning.analysis.comparison import BAND
from loopwright.tuning.analysis.recursion import recursive
from loopwright.tuning.fast.design.iae import NEGLIGIBLE, LoopResponses
from loopwright.tuning.models import Reals

INNER_BAND = 0.98 * BAND
"""The settling band of the design, as a fraction of the step: PV that only just stays within the band of the comparison
in the simulation of the design might leave it in the exact response."""


@dataclass(frozen=True, slots=True)
class Missed:
    """By how much a requirement is not kept, as a fraction of what is asked for; 0 where it is kept. The movement of MV
    comes first: the settling time is sought among the weights that keep it.

    mv_peak, settling: for the largest change of MV and for the settling time.
    """

    mv_peak: float = 0.0
    settling: float = 0.0

    @property
    def order(self) -> tuple[float, float]:
        """What orders gains from those that keep everything to those that miss it most."""
        return self.mv_peak, self.settling


KEPT = Missed()


@dataclass(frozen=True, slots=True)
class DesignBounds:
    """The bounds of a design on its gains and on the answer to a set-point step; None is no bound.

    Ms: the largest permitted maximum sensitivity.
    overshoot: the largest permitted overshoot, a fraction of the step.
    settling_s: the largest permitted settling time, s.
    mv_peak: the largest permitted change of MV, MV units per PV unit.
    """

    Ms: float
    overshoot: float | None = None
    settling_s: float | None = None
    mv_peak: float | None = None


def weights(
    responses: LoopResponses, limits: tuple[float, float], bounds: DesignBounds
) -> Iterator[tuple[float, Missed]]:
    """The set-point weight with the least IAE after a set-point step of those that keep the bounds. Where there is
    none, the one that misses them least, and then the one with the least IAE, each with by how much it misses them.
    There is none at all where no weight keeps the overshoot.

    limits: the smallest and the largest b.
    """
    room = responses.overshoot_room(*limits, bounds.overshoot)
    if room is None:
        return
    low, high = room
    if bounds.mv_peak is not None:
        u, by = movement(responses)
        lower, upper = _within(u, -by, bounds.mv_peak)
        if max(low, lower) > min(high, upper):
            best = 1.0 - responses.weight_within(low, high)
            for x in (_smallest_peak(u, by, low, high), best):
                yield 1.0 - x, Missed(mv_peak=float(np.abs(u - x * by).max()) / bounds.mv_peak - 1.0)
            return
        low, high = max(low, lower), min(high, upper)
    if bounds.settling_s is None:
        yield responses.weight_within(low, high), KEPT
        return
    from_low, to_high = _from_each_time_on(responses, low, high)
    asked = math.ceil(bounds.settling_s / responses.h - 1e-9)  # the first time that has to be within the band
    if asked >= len(from_low):  # the response has died away before
        yield responses.weight_within(low, high), KEPT
        return
    if from_low[asked] <= to_high[asked]:
        yield responses.weight_within(float(from_low[asked]), float(to_high[asked])), KEPT
        return
    best = 1.0 - responses.weight_within(low, high)
    if (fastest := _first(from_low <= to_high)) < len(from_low):
        quick = responses.weight_within(float(from_low[fastest]), float(to_high[fastest]))
        yield quick, Missed(settling=fastest * responses.h / bounds.settling_s - 1.0)
    settled = _first((from_low <= best) & (best <= to_high))
    yield 1.0 - best, Missed(settling=settled * responses.h / bounds.settling_s - 1.0)


def _first(true: NDArray[np.bool_]) -> int:
    """The first index that is true; the length where there is none: the response has not settled at its end."""
    return int(np.argmax(true)) if true.any() else len(true)


def movement(responses: LoopResponses) -> tuple[Reals, Reals]:
    """The change of MV after a unit set-point step with b = 1, and by how much it is less for each unit that b is below
    one: MV units per PV unit, both of shape (N,)."""
    r = responses
    # a derivative acts on PV alone, which is one less the error after a set-point step
    u = _controlled(r, r.error, 1.0 - r.error)
    return u, r.Kp * (1.0 + _controlled(r, -r.load, r.load))


def _controlled(r: LoopResponses, error: Reals, y: Reals) -> Reals:
    """MV for this error and PV."""
    u = r.Kp * error
    u[1:] += r.Kp * 0.5 * r.h / r.Ti * np.cumsum(error[1:] + error[:-1])
    if r.Td > 0.0:
        # PV is straight between two steps: the staircase of the simulation would have its jumps here
        steps = r.Td / r.N / r.h
        decay = math.exp(-1.0 / steps)
        now = 1.0 - steps * (1.0 - decay)
        moved = now * y
        moved[1:] += (1.0 - decay - now) * y[:-1]
        u -= r.Kp * r.N * (y - recursive(np.array([1.0, -decay]), moved))
    return u


def _within(a: Reals, by: Reals, maximum: float) -> tuple[float, float]:
    """The ends of the interval of x where |a + x*by| <= maximum at every time; the first end lies above the second
    where there is none."""
    lower, upper = _ends(a, by, maximum)
    return float(lower.max(initial=-math.inf)), float(upper.min(initial=math.inf))


def _from_each_time_on(r: LoopResponses, low: float, high: float) -> tuple[Reals, Reals]:
    """For each time: the ends of the interval of x from low to high for which the error is within the band from then
    on; the first end lies above the second where there is none."""
    lower, upper = _ends(r.error, r.Kp * r.load, INNER_BAND)
    return (
        np.maximum(np.maximum.accumulate(lower[::-1])[::-1], low),
        np.minimum(np.minimum.accumulate(upper[::-1])[::-1], high),
    )


def _ends(a: Reals, by: Reals, maximum: float) -> tuple[Reals, Reals]:
    """The ends of the interval of x where |a + x*by| <= maximum, for each time."""
    moved = np.abs(by) > NEGLIGIBLE
    slope = np.where(moved, by, 1.0)
    one, other = (-maximum - a) / slope, (maximum - a) / slope
    fixed = np.where(np.abs(a) <= maximum, -math.inf, math.inf)  # x moves nothing at this time
    return np.where(moved, np.minimum(one, other), fixed), np.where(moved, np.maximum(one, other), -fixed)


def _smallest_peak(u: Reals, by: Reals, low: float, high: float) -> float:
    """The x from low to high with the least largest |u - x*by|, which is convex in x."""

    def peak(x: float) -> float:
        return float(np.abs(u - x * by).max())

    found = minimize_scalar(peak, bounds=(low, high), method="bounded", options={"xatol": 1e-4})
    return min((low, high, float(found.x)), key=peak)
