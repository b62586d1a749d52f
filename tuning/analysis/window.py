"""An MV that is switched on and off in a window: on for the part of each window that MV says (time-proportioned)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.models import Reals

WINDOWS_S = (0.5, 1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 24, 25, 30, 40, 45, 50, 60, 80, 90, 100, 120, 150, 180, 200, 240,
             300, 400, 450, 480, 500, 600, 720, 900, 1200, 1800)  # fmt: skip
"""Lengths of a window that people set. One that they do not shows in PV at rest."""
SHORTEST = 1.4
"""Samples of the shortest window that is looked for."""
PHASES, LINES, NEAR, FINER = 16, 3, 12, 8
"""How many beginnings of a window are tried; peaks of PV's spectrum that may be a window; lengths near one that are
tried; points of the spectrum in its resolution."""
PEAK = 8.0
"""Power of a peak of the spectrum, in medians."""
SPANS = ((0.0, 1.0), (0.0, 100.0))
"""What MV of a time-proportioned output is between: off all the time, on all the time."""
OSCILLATES, SHOWS = 0.6, 0.3
"""Parts of the variance of PV at rest that one period has to make: for PV to be at no rest, and for a swing to show in
it (white noise reaches 0.15 in 120 samples)."""
MIN_WINDOWS = 4.0
"""Windows that the rest must hold to tell the length of one."""
CLEARER, CLEARER_THAN_OTHERS = 30.0, 12.0
"""By how much chi-squared of a window has to be below that of a sine of the same length, and below that of a window
that is on for another part of it."""
OTHER_PARTS, NOT_NEAR, PARTS_NEAR = np.linspace(0.08, 0.92, 15), 0.09, 3
"""Parts of a window that are tried in place of that which MV says, how far they are from it, and with how many lengths
on either side of the best one. A load that goes on and off by itself has a part of its own."""


def switched(mv: Reals, length: float, begin: float, latched: bool) -> Reals | None:
    """What is on and off, as its mean over each sample, MV units, shape (N,). None where MV is not within a span.

    mv: absolute, MV units, shape (N,). length, begin: of the window, and where one begins, samples.
    latched: each window takes MV at its beginning; otherwise as it is.
    """
    low, high = _range(mv)
    if not low < high:
        return None
    n = np.arange(float(len(mv)))
    first = np.floor((n - begin) / length) * length + begin  # where the window begins that the sample begins in
    duty = (mv - low) / (high - low)
    on = duty if not latched else duty[np.clip(np.floor(first).astype(int), 0, len(mv) - 1)]
    further = duty if not latched else duty[np.clip(np.floor(first + length).astype(int), 0, len(mv) - 1)]
    found = np.zeros(len(mv))
    for k in range(math.ceil(1.0 / length) + 1):  # windows that the sample has a part of
        starts = first + k * length
        ends = starts + (on if k == 0 else further) * length
        found += np.clip(np.minimum(ends, n + 1.0) - np.maximum(starts, n), 0.0, 1.0)
    return np.asarray(low + (high - low) * found)


def _range(mv: Reals) -> tuple[float, float]:
    """What MV is when it is off, and on, all the time; not numbers where MV is beyond."""
    return next(((a, b) for a, b in SPANS if a <= mv.min() and mv.max() <= b), (math.nan, math.nan))


def lengths(rest: Reals, Ts: float, longest: float) -> list[float]:
    """The lengths of windows that are worth a try, in samples: those that people set, and those that PV at rest swings
    with. rest: PV, shape (N,). Ts: s. longest: samples."""
    power, per_sample = _spectrum(rest)
    peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:])) + 1
    peaks = peaks[np.argsort(-power[peaks])][:LINES]
    found = [each / Ts for each in WINDOWS_S]
    for peak in peaks[power[peaks] > PEAK * np.median(power)]:
        length = 1.0 / (float(peak) * per_sample)
        apart = length**2 / len(rest) / NEAR
        found += [length + k * apart for k in range(-NEAR, NEAR + 1)]
    return [each for each in found if SHORTEST <= each <= longest]


@dataclass(frozen=True, slots=True)
class Oscillation:
    """What swings PV at rest: an MV that is switched in a window, or something of one period."""

    by_window: bool
    in_words: str


def oscillation_at_rest(pv: Reals, mv: Reals, Ts: float, part: float = OSCILLATES) -> Oscillation | None:
    """What swings PV while the loop rests, None where nothing does.

    pv, mv: absolute, PV and MV units, shape (N,). Ts: s. part: of the variance that one period has to make.
    """
    trend = np.vander(np.linspace(-1.0, 1.0, len(pv)), 3)
    rest = _left(pv, trend)
    variance = float(rest @ rest)
    power, per_sample = _spectrum(pv)
    length = 1.0 / (max(int(np.argmax(power)), 1) * per_sample)
    if not (variance > 0.0 and SHORTEST <= length <= len(pv) / MIN_WINDOWS):
        return None
    n = np.arange(float(len(pv)))
    near = [length + k * length**2 / len(pv) / NEAR for k in range(-NEAR, NEAR + 1)]

    def by_sine(each: float) -> float:
        of_time = 2.0 * math.pi * n / each
        left = _left(rest, np.column_stack((np.sin(of_time), np.cos(of_time), trend)))
        return float(left @ left)

    of_sine, length = min((by_sine(each), each) for each in near)
    of_window, window = min(_by_windows(rest, mv, near, trend), default=(math.inf, math.nan))
    if min(of_sine, of_window) > (1.0 - part) * variance:
        return None
    by = float(np.quantile(rest, 0.98) - np.quantile(rest, 0.02))
    swings = Oscillation(False, f"PV swings by {by:.2g} at rest, with a period of {length * Ts:.3g} s")
    if not math.isfinite(of_window):
        return swings
    at = near.index(window)
    some = near[max(at - PARTS_NEAR, 0) : at + PARTS_NEAR + 1]
    if (of_sine - of_window) / of_window * len(rest) < CLEARER or not _of_this_part(rest, mv, some, trend, of_window):
        return swings
    text = f"PV swings by {by:.2g} at rest, as by an MV that is switched on and off in a window of {window * Ts:.3g} s"
    return Oscillation(True, text)


def _of_this_part(rest: Reals, mv: Reals, near: list[float], trend: Reals, left: float) -> bool:
    """Whether a wave that is on for another part of a window than MV says leaves clearly more of PV at rest."""
    low, high = _range(mv)
    mean = float(mv.mean())
    part = (mean - low) / (high - low)
    # on and off changed for each other are the same wave
    others = [each for each in OTHER_PARTS if min(abs(each - part), abs(1.0 - each - part)) > NOT_NEAR]
    shifted = (np.clip(mv - mean + low + each * (high - low), low, high) for each in others)
    best, _ = min(each for other in shifted for each in _by_windows(rest, other, near, trend))
    return (best - left) / left * len(rest) > CLEARER_THAN_OTHERS


def _by_windows(rest: Reals, mv: Reals, near: list[float], trend: Reals) -> Iterator[tuple[float, float]]:
    """What is left of PV at rest by each window, as the plant's lag and its next one would answer it."""
    for each in near:
        for k in range(PHASES):
            on = switched(mv, each, each * k / PHASES, latched=True)
            if on is None:
                return
            answered = np.cumsum(on - on.mean())
            left = _left(rest, np.column_stack((answered, on, np.cumsum(answered - answered.mean()), trend)))
            yield float(left @ left), each


def _left(values: Reals, columns: Reals) -> Reals:
    basis = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
    return np.asarray(values - basis @ (basis.T @ values))


def _spectrum(rest: Reals) -> tuple[Reals, float]:
    """The power of PV at rest over frequency, and the frequencies' distance, in 1/samples."""
    left = _left(rest, np.vander(np.linspace(-1.0, 1.0, len(rest)), 3))
    count = FINER * len(rest)
    return np.square(np.abs(np.fft.rfft(left * np.hanning(len(left)), count))), 1.0 / count
