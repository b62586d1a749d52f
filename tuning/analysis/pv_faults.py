"""What a column of PV samples shows of the way from the sensor to the controller, before anything is fitted to it: it
is renewed seldom, sent only where it has changed, rounded, or wrong in single samples.

Nothing is asked of the plant but that PV is noisy or moves: what PV does from one sample to the next tells by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.models import Reals

EQUAL = 1e-9
"""Differences of PV, as a part of its range, below which two samples are equal."""
JUMP = 1.5
"""Change of PV, in rounding steps, that rounding alone does not make of a PV that hardly moves."""
MIN_JUMPS, HELD_BEFORE, REGULAR = 16, 0.9, 0.85
"""Smallest number of jumps that tell how often PV is renewed; the part of them before which PV was held; the part of
the times between them that must be one interval, or several of it."""
BAND = 0.6
"""Smallest change, as a part of the usual one, of a PV that is sent only where it has changed."""
MIN_ON_CHANGE, HELD_ON_CHANGE = 8, 0.4
ON_GRID = 0.05
"""How far the distance of two levels may be from a whole number of rounding steps, in steps."""
NEIGHBOURS = 3
"""Samples on either side of one that is compared with them."""
WRONG = 9.0
"""Distance of a wrong sample from its neighbours, in robust standard deviations of that distance over all samples;
white noise reaches 5 in a million samples."""
MOVES = 4.0
"""Distance of a wrong sample from its neighbours, in usual changes of PV from one sample to the next."""
ALONE = 3.0
"""Distance of a wrong sample from the line through its neighbours, in the largest distance of these but one."""
MAX_WRONG = 0.06
"""Largest part of the samples that may be wrong one by one: more of them are no single ones."""


@dataclass(frozen=True, slots=True)
class PvFaults:
    """What the samples of PV show.

    samples: the number of samples.
    renewed: the interval at which PV is renewed, in samples; None where that is every sample.
    on_change: the change of PV from which on it is sent, PV units; None where it is sent always.
    rounded: the step to which PV is rounded, PV units; 0 where none shows.
    wrong: the places of single wrong samples. wrong_by: how far the farthest of them is off, PV units.
    """

    samples: int
    renewed: float | None
    on_change: float | None
    rounded: float
    wrong: tuple[int, ...]
    wrong_by: float

    def of_renewal(self, Ts: float) -> str | None:
        """That PV is renewed seldom or sent only where it has changed, in words; None where it is not. Ts: s."""
        if self.renewed is not None:
            return f"PV is renewed every {self.renewed * Ts:.3g} s ({self.renewed:.3g} samples) only"
        if self.on_change is not None:
            return f"PV is sent only where it has changed by {self.on_change:.2g}, and held in between"
        return None

    @property
    def of_wrong_samples(self) -> str | None:
        """The single wrong samples in words; None where there is none."""
        if not self.wrong:
            return None
        one_in = self.samples / len(self.wrong)
        many = "a single wrong sample" if len(self.wrong) == 1 else f"single wrong samples, 1 in {one_in:.0f}"
        return f"PV has {many}, off by up to {self.wrong_by:.3g}"


def pv_faults(pv: Reals) -> PvFaults:
    """What the samples of PV show of the way from the sensor. pv: evenly spaced, PV units, shape (N,)."""
    wrong, by = wrong_samples(pv)
    kept = np.delete(pv, wrong)
    rounded = rounding_step(kept)
    changes, runs = _changes(kept)
    # whoever renews a rounded PV renews it by more than a step wherever PV moves; a slow PV that is rounded alone stays
    # where it is, and goes on by single steps
    jumps = runs[np.abs(changes) > JUMP * rounded]
    renewed = _interval(jumps)
    on_change = None if renewed is not None else _band(np.abs(changes), runs, rounded)
    return PvFaults(len(pv), renewed, on_change, rounded, tuple(map(int, wrong)), by)


def wrong_samples(pv: Reals) -> tuple[NDArray[np.int64], float]:
    """The places of samples that are wrong one by one, and how far the farthest of them is off, PV units.

    Such a sample is far from those on both sides of it, which are close to each other: no plant answers so. pv: evenly
    spaced, shape (N,).
    """
    none = np.empty(0, dtype=np.int64)
    if len(pv) < 4 * NEIGHBOURS:
        return none, 0.0
    width = 2 * NEIGHBOURS + 1
    padded = np.concatenate((pv[NEIGHBOURS:0:-1], pv, pv[-2 : -NEIGHBOURS - 2 : -1]))
    windows = np.lib.stride_tricks.sliding_window_view(padded, width)
    left, right = (np.median(each, axis=1) for each in (windows[:, :NEIGHBOURS], windows[:, NEIGHBOURS + 1 :]))
    places = np.arange(-NEIGHBOURS, NEIGHBOURS + 1.0)
    line = 0.5 * (left + right)[:, None] + (right - left)[:, None] / (NEIGHBOURS + 1.0) * places
    off = windows - line
    away = off[:, NEIGHBOURS]
    # another wrong sample may be among the neighbours
    spread = np.sort(np.abs(np.delete(off, NEIGHBOURS, axis=1)), axis=1)[:, -2]
    scale = 1.4826 * float(np.median(np.abs(away)))
    moved = np.abs(np.diff(pv))
    # a PV that is sent only where it has changed, or rounded, moves by no less than that
    usual = float(np.median(moved[moved > EQUAL * np.ptp(pv)])) if np.any(moved) else 0.0
    far = max(WRONG * scale, MOVES * usual)
    between = 0.5 * (np.concatenate((pv[:1], pv[:-1])) + np.concatenate((pv[1:], pv[-1:])))
    found = (np.abs(away) > far) & (np.abs(away) > ALONE * spread) & (np.abs(pv - between) > 0.5 * np.abs(away))
    found[0] = found[-1] = False
    at = np.flatnonzero(found)
    alone = at[(np.diff(at, prepend=-9) > 1) & (np.diff(at, append=len(pv) + 9) > 1)]
    if len(alone) > MAX_WRONG * len(pv) or len(alone) < 0.5 * len(at):
        return none, 0.0
    return alone, float(np.max(np.abs(away[alone]), initial=0.0))


def without_wrong_samples(pv: Reals) -> Reals:
    """PV with the single wrong samples as samples that were lost: interpolated. pv: evenly spaced, shape (N,)."""
    wrong, _ = wrong_samples(pv)
    if not len(wrong):
        return pv
    right = np.setdiff1d(np.arange(len(pv)), wrong)
    return np.asarray(np.interp(np.arange(len(pv), dtype=float), right.astype(float), pv[right]))


def rounding_step(pv: Reals) -> float:
    """The step to which PV is rounded, PV units: all of its levels are a whole number of such steps apart. 0 where none
    shows."""
    output_range = float(np.ptp(pv))
    if not output_range > 0.0:
        return 0.0
    levels = np.unique(pv)
    apart = np.diff(levels)
    apart = apart[apart > max(EQUAL * output_range, 4.0 * _float_step(levels))]
    step = float(apart.min(initial=math.inf))
    if not math.isfinite(step) or len(apart) < 2:
        return 0.0
    of_step = apart / step
    return step if bool(np.all(np.abs(of_step - np.round(of_step)) < ON_GRID)) else 0.0


def _float_step(levels: Reals) -> float:
    """The distance of neighbouring REAL32 numbers at these levels: on the bus a number is one of them."""
    return float(np.spacing(np.float32(np.max(np.abs(levels)))))


def _changes(pv: Reals) -> tuple[Reals, NDArray[np.int64]]:
    """The changes of PV, and for how many samples it was held before each of them; the first has no time before it."""
    differences = np.diff(pv)
    at = np.flatnonzero(np.abs(differences) > EQUAL * max(float(np.ptp(pv)), 1e-300))
    return differences[at[1:]], np.diff(at)


def _interval(runs: NDArray[np.int64]) -> float | None:
    """The interval between jumps, in samples, None where it is one sample or none."""
    if len(runs) < MIN_JUMPS or float(np.mean(runs > 1)) < HELD_BEFORE:
        return None
    short = float(np.median(runs[runs <= 1.5 * np.quantile(runs, 0.2)]))
    for _ in range(2):  # a PV that is renewed with what it was shows several intervals
        times = np.maximum(np.round(runs / short), 1.0)
        near = np.abs(runs - times * short) <= np.maximum(1.0, 0.25 * short)
        few = near & (times <= 4.0)
        if float(np.mean(few)) < REGULAR:
            return None
        short = float(np.sum(runs[few]) / np.sum(times[few]))
    # with an interval of two or three samples any time is near to some number of them
    if short < 3.5 and float(np.mean(np.abs(runs[few] - times[few] * short) <= 0.5)) < REGULAR:
        return None
    return short if short > 1.5 else None


def _band(sizes: Reals, runs: NDArray[np.int64], rounded: float) -> float | None:
    """The change from which on PV is sent, None where it is always sent."""
    if len(sizes) < MIN_ON_CHANGE or float(np.mean(runs > 1)) < HELD_ON_CHANGE:
        return None
    smallest, usual = float(np.quantile(sizes, 0.02)), float(np.median(sizes))
    return smallest if smallest > BAND * usual and smallest > JUMP * rounded else None
