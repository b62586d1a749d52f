"""What PV does at rest, before a test moves it, or in operation before it is looked at.

How long it stays exactly equal, how often it is renewed, its noise and its quantum tell from what on equal values, and
another noise, are false.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from loopwright.tuning.experiments.primitives import Array
from loopwright.tuning.reasons import FalsePv, Reason

MIN_RENEWALS = 30
"""Number of values, each renewed, that the rest must have for its noise to be known."""
MIN_REVERSALS, MIN_LEVELS, MAX_RUN_PART = 8, 3, 0.25
"""Noise moves PV at rest where it turns round at least so often, has so many values, and is never equal for longer than
this part of the rest. Of two values alone nothing is known of the noise between them."""
RUN_OF_REST, RUN_MORE = 2, 10
"""PV is equal for too long after so many times the longest run at rest and so many samples more."""
RARE, RARE_SMALL = 1e-8, 3e-7
"""Probability, by its noise alone, of what a true PV is taken for false for, in one look: of a run of equal values, and
of a variance that small over one of WINDOWS, which only a PV that stands still can have."""
LONGEST_BY_CHANCE = 120
"""Longest run, in renewals, that is waited for where rounding and noise permit it. Beyond that noise says nothing."""
WINDOWS = (8, 10, 12, 14, 16, 18, 20, 23, 26, 30, 35, 40)
"""Numbers of renewals over which the noise is looked at."""
QUIETER_THAN_REST = 0.5
"""Part of the smallest variance at rest over as many samples, below which that of a false PV is."""
COARSE = 1.0
"""Quantum in noises above which PV may be equal by chance for so long that its variance says nothing."""
LOUD_WINDOW = 15
LONGEST_REST = 20_000
"""Largest number of samples at rest that are looked at."""


@dataclass(frozen=True, slots=True)
class PvAtRest:
    """What PV does at rest.

    samples: their number.  value, last: the mean and the last of them, PV units; nan where there is none.
    longest_run: the largest number of samples in a row that were exactly equal.
    renewal: the number of samples from one new value to the next.
    noise: the standard deviation of PV around a mean that stands still, PV units; the larger of that by differences and
    that over LOUD_WINDOW values.  smallest_noise: the smaller of both.
    loud_variance: the variance beside which PV is too loud: that noise squared, and more as it is less well known.
    quantum: the smallest distance of two values, PV units.
    largest_move: the largest move from one sample to the next, PV units.
    run_limit: the number of equal samples in a row from which PV is false; None where noise does not move PV.
    smallest_variances: for each of WINDOWS, the variance below which PV is false; 0 where that is not known.
    """

    samples: int
    value: float
    last: float
    longest_run: int
    renewal: int
    noise: float
    smallest_noise: float
    loud_variance: float
    quantum: float
    largest_move: float
    run_limit: int | None
    smallest_variances: tuple[float, ...]

    @classmethod
    def of(cls, pv: Sequence[float]) -> PvAtRest:
        """pv: consecutive samples at rest, PV units; the last LONGEST_REST are looked at."""
        x = np.asarray(pv[-LONGEST_REST:], dtype=float)
        n = len(x)
        if n < 2:
            value = float(x[0]) if n else math.nan
            return cls(n, value, value, n, 1, 0.0, 0.0, 0.0, 0.0, 0.0, None, (0.0,) * len(WINDOWS))
        edges = np.flatnonzero(np.diff(x)) + 1
        runs = np.diff([0, *edges, n])
        longest = int(runs.max())
        renewal = int(np.quantile(runs[1:-1], 0.1, method="lower")) if len(runs) > 2 else 1
        levels = np.unique(x)
        quantum = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
        moves = np.diff(x[edges]) if len(edges) > 1 else np.zeros(0)
        reversals = int(np.count_nonzero(moves[1:] * moves[:-1] < 0.0))
        values = x[renewal - 1 :: renewal]
        by_differences = 0.5 * float(np.mean(np.diff(values) ** 2)) if len(values) > 1 else 0.0
        variances = {w: _variances(values, w) for w in (*WINDOWS, LOUD_WINDOW) if w <= len(values)}
        over = float(np.mean(variances[LOUD_WINDOW])) if LOUD_WINDOW in variances else by_differences
        largest = float(np.abs(np.diff(x)).max())
        limit: int | None = None
        smallest = [0.0] * len(WINDOWS)
        moved = reversals >= MIN_REVERSALS and len(levels) >= MIN_LEVELS and longest <= MAX_RUN_PART * n
        if moved and len(values) >= MIN_RENEWALS:
            chance = _longest_by_chance(quantum, by_differences)
            if chance <= LONGEST_BY_CHANCE:
                limit = max(RUN_OF_REST * longest + RUN_MORE, math.ceil(chance * renewal))
            small = min(by_differences, over)
            if quantum <= COARSE * math.sqrt(small):
                for at, w in enumerate(WINDOWS):
                    if w in variances:
                        by_noise = small * float(fdtri(w - 1, len(values) * 2 // 3, RARE_SMALL))
                        smallest[at] = min(by_noise, QUIETER_THAN_REST * float(variances[w].min()))
        noise, smallest_noise = (math.sqrt(each(by_differences, over)) for each in (max, min))
        loud = noise**2 * (1.0 + 2.0 / math.sqrt(max(len(values), 1)))
        loud += 0.25 * quantum**2 if quantum > 0.5 * noise else 0.0  # in the middle between two values PV is louder
        return cls(
            samples=n,
            value=float(np.mean(x)),
            last=float(x[-1]),
            longest_run=longest,
            renewal=renewal,
            noise=noise,
            smallest_noise=smallest_noise,
            loud_variance=loud,
            quantum=quantum,
            largest_move=largest,
            run_limit=limit,
            smallest_variances=tuple(smallest),
        )

    @property
    def lively(self) -> bool:
        """Whether noise moves PV at rest, so that equal values tell."""
        return self.run_limit is not None


def check_end_of_rest(pv: Sequence[float]) -> None:
    """Raises FalsePv, PV_FROZEN, where PV has come to stand still at the end of its rest. pv: the samples, PV units."""
    run = next((n for n, value in enumerate(reversed(pv)) if value != pv[-1]), len(pv))
    before = PvAtRest.of(pv[: len(pv) - run])
    if before.run_limit is not None and run > before.run_limit:
        text = f"where it never stood still for more than {before.longest_run}"
        raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv[-1]:.6g} for the last {run} samples at rest, {text}")


def _variances(values: Array, window: int) -> Array:
    variances: Array = np.lib.stride_tricks.sliding_window_view(values, window).var(axis=1, ddof=1)
    return variances


def _longest_by_chance(quantum: float, variance: float) -> float:
    """The run of equal values that noise of this variance (after rounding), rounded to this quantum, leaves by chance
    with the probability RARE where the mean of PV stands in the middle of a quantum."""
    if quantum <= 0.0:
        return 0.0
    noise = math.sqrt(max(variance - quantum**2 / 12.0, 0.0))
    if noise == 0.0:
        return math.inf
    stays = math.erf(quantum / (2.0 * math.sqrt(2.0) * noise))
    return math.log(RARE) / math.log(stays) if stays < 1.0 else math.inf
