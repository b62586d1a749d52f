"""What has moved PV in the whole record of a test that does not go on: MV, a load disturbance, or a drift.

The last moments of such a record mislead: a load that takes back what MV had moved looks like a plant that does not
answer. The record is fitted with a first-order plant, or an integrating one, without and with one load disturbance or
one drift, on a grid of lags, dead times and times, and with these alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BLOCKS, MIN_BLOCKS = 400, 10
"""Largest and smallest number of averages that are fitted."""
LAGS, DEAD_TIMES, TIMES = 12, 12, 40
"""Number of lags, dead times, and times at which a disturbance comes, that are tried first."""
FINER = 11
"""Number of each that are tried around the best ones."""
SHORTEST_LAG, LONGEST_LAG, LONGEST_DEAD_TIME = 0.01, 1.5, 0.6
"""The lags and dead times that are tried, in T95."""
CLEAR = 1.5
"""Ratio of the sums of squares that two explanations leave, above which the better one is right."""
NEGLIGIBLE, NEGLIGIBLE_OF_ONE_MOVE = 0.005, 0.03
"""Residual that counts as none, as a fraction of PV's largest move; the second value holds where MV has moved once, and
a plant of more than one lag could be taken for one with a load."""
MATERIAL = 0.2
"""Smallest part of PV's largest move that a disturbance beside MV has to have."""
LARGEST_LOAD = 3.0
"""Largest load whose size in MV is said, in largest moves of MV: a larger one hides the gain of the plant."""
MOVE = 0.1
"""Smallest move of MV that counts, as a fraction of its range."""
SINGULAR = 1e-9
MIN_ANSWER_NOISES = 5.0
"""Smallest move of PV that counts as an answer, in standard deviations of the noise."""


@dataclass(frozen=True, slots=True)
class WhatMoved:
    """What has moved PV.

    gain: that of the plant, PV units per MV unit, by MV's moves; of an integrating one per s as well; 0 where PV has
    not answered MV.
    integrating: whether PV goes on moving as long as MV is away from rest.
    load: a load disturbance, PV units that it moves PV by in the end. drift: PV units per s. Both are 0 where there is
    none; at most one of them is not.
    since_s: when the load disturbance or the drift came, s since the beginning of the record.
    moved: by how much PV has been away at most, PV units, with its sign.
    load_in_mv: the move of MV that would move PV as the load does; 0 where the record does not tell.
    """

    gain: float
    integrating: bool
    load: float
    drift: float
    since_s: float
    moved: float
    load_in_mv: float = 0.0

    @property
    def answered(self) -> bool:
        """Whether PV has answered MV."""
        return self.gain != 0.0

    @property
    def in_words(self) -> str:
        """The answer of PV, and what else has moved it, as a sentence without its end."""
        if not self.answered:
            answer, by_itself = "PV does not answer MV", "; what moves it is"
            if self.load:
                answer = "whether PV answers MV the record does not tell"
        else:
            unit = " per s" if self.integrating else ""
            answer = f"PV has answered MV (it went {self.moved:+.3g} away; its gain is about {self.gain:.2g}{unit})"
            by_itself = ", and is moved by"
        if self.drift:
            return f"{answer}{by_itself} a drift of {self.drift:+.3g} per s since {self.since_s:.3g} s"
        if self.load:
            of_MV = f", as much as {self.load_in_mv:+.3g} of MV would" if self.load_in_mv else ""
            size = f"a load disturbance that moves it by {self.load:+.3g}{of_MV}"
            return f"{answer}{by_itself} {size}, since {self.since_s:.3g} s"
        return answer


def what_moved(t_s: Array, mv: Array, pv: Array, T95_s: float, noise: float) -> WhatMoved:
    """What has moved PV in this record.

    t_s: plant time, s. mv, pv: deviations from rest at these times, evenly spaced, MV held from each to the next; all
    of shape (N,).
    T95_s: the time in which the plant is said to cover 95 % of a step, s. noise: the standard deviation of PV at rest.
    """
    block = max(1, math.ceil(len(pv) / BLOCKS))
    u, y = (each[: len(pv) // block * block].reshape(-1, block).mean(axis=1) for each in (mv, pv))
    of_mean = noise / math.sqrt(block)
    moved = float(y[np.argmax(np.abs(y))]) if len(y) else 0.0
    if len(y) < MIN_BLOCKS or not np.any(u) or abs(moved) < MIN_ANSWER_NOISES * of_mean:
        return WhatMoved(0.0, False, 0.0, 0.0, 0.0, moved)
    h = block * float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    one_move = np.count_nonzero(np.abs(np.diff(mv, prepend=0.0)) > MOVE * np.ptp(np.append(mv, 0.0))) < 2
    # one move of MV on an integrating plant looks like a drift, and is taken for one
    lags = [*np.geomspace(SHORTEST_LAG, LONGEST_LAG, LAGS) * T95_s, *([] if one_move else [math.inf])]
    last = len(y) - MIN_BLOCKS // 2
    delays = np.linspace(0.0, min(LONGEST_DEAD_TIME * T95_s / h, last), DEAD_TIMES)
    times = np.linspace(0, last, TIMES)
    coarse = [_explanations(u, y, h, [T], delays, times) for T in lags]
    mv_alone, both, neither = (
        _refined(u, y, h, min((each[i] for each in coarse), key=_left), (delays[1], times[1]))[i] for i in range(3)
    )
    smallest = max(of_mean, (NEGLIGIBLE_OF_ONE_MOVE if one_move else NEGLIGIBLE) * abs(moved))
    of_mv, of_both, of_neither = (max(each.left, len(y) * smallest**2) for each in (mv_alone, both, neither))
    beside = abs(both.size) * ((len(y) - both.at) * h if both.drifts else 1.0) > MATERIAL * abs(moved)
    # one move of MV and one disturbance at that time look alike: what MV explains as well is its answer
    hidden = of_neither < CLEAR * of_both and abs(both.answer) < MATERIAL * abs(moved)
    if of_mv > CLEAR * of_neither and hidden:
        found = neither
    else:
        found = both if beside and of_mv > CLEAR * of_both else mv_alone
    drift, load = (found.size, 0.0) if found.drifts else (0.0, found.size)
    in_mv = load / found.gain if found.gain else 0.0
    in_mv = in_mv if abs(in_mv) < LARGEST_LOAD * float(np.abs(mv).max()) else 0.0
    return WhatMoved(found.gain, math.isinf(found.T), load, drift, found.at * h, moved, in_mv)


@dataclass(frozen=True, slots=True)
class _Explanation:
    """left: the sum of squares that it leaves. gain: of the plant; 0 is none. answer: the largest move of PV by MV.
    size: of the disturbance, a load in PV or a drift; 0 is none. T: the lag, s; infinite of an integrating plant.
    delay, at: the dead time and the time of the disturbance, in averages."""

    left: float
    gain: float
    answer: float
    size: float
    drifts: bool
    T: float
    delay: int
    at: int


def _left(explanation: _Explanation) -> float:
    return explanation.left


def _explanations(
    u: Array, y: Array, h: float, lags: Iterable[float], delays: Array, times: Array
) -> tuple[_Explanation, _Explanation, _Explanation]:
    """The best explanations of PV by MV alone, by MV and a disturbance, and by a disturbance alone.

    u, y: MV and PV, averages over h s. lags: s. delays, times: the dead times, and the times of disturbances, that are
    tried, in averages.
    """
    delays, times = (np.unique(np.rint(each).astype(int)) for each in (delays, times))
    passed_s = np.clip(np.arange(len(y)) - times[:, None], 0, None) * h
    by_mv, by_both, by_itself = [], [], []
    for T in lags:
        answers = np.array([_answer(u, T, h, int(each)) for each in delays])
        largest = np.abs(answers).max(axis=1)
        left, i, gain = _alone(y, answers)
        by_mv.append(_Explanation(left, gain, gain * largest[i], 0.0, False, T, int(delays[i]), 0))
        drift = [(passed_s, True)]
        for others, drifts in drift if math.isinf(T) else [*drift, (-np.expm1(-passed_s / T), False)]:
            left, at, size = _alone(y, others)
            by_itself.append(_Explanation(left, 0.0, 0.0, size, drifts, T, 0, int(times[at])))
            left, i, at, gain, size = _together(y, answers, others)
            answer = gain * largest[i]
            by_both.append(_Explanation(left, gain, answer, size, drifts, T, int(delays[i]), int(times[at])))
    return min(by_mv, key=_left), min(by_both, key=_left), min(by_itself, key=_left)


def _refined(
    u: Array, y: Array, h: float, found: _Explanation, spacing: tuple[float, float]
) -> tuple[_Explanation, _Explanation, _Explanation]:
    """The explanations near one of the grid. spacing: of its dead times and times."""
    lags = found.T * (LONGEST_LAG / SHORTEST_LAG) ** (np.linspace(-1.0, 1.0, FINER) / (LAGS - 1))
    delays, times = (
        np.clip(at + np.linspace(-each, each, FINER), 0.0, len(y) - MIN_BLOCKS // 2)
        for at, each in zip((found.delay, found.at), spacing, strict=True)
    )
    return _explanations(u, y, h, lags.tolist(), delays, times)


def _answer(u: Array, T: float, h: float, delay: int) -> Array:
    """The answer of a plant of gain 1 and lag T, s (of 1/s where it is infinite), to MV, so many steps of h s later."""
    share = h if math.isinf(T) else -math.expm1(-h / T)
    kept = 1.0 if math.isinf(T) else 1.0 - share
    from scipy.signal import lfilter  # its import takes 0.4 s

    moved = lfilter([0.0, share], [1.0, -kept], u)
    return np.concatenate((np.zeros(delay), moved[: len(u) - delay]))


def _alone(y: Array, columns: Array) -> tuple[float, int, float]:
    """The smallest sum of squares that one of these columns, shape (columns, N), leaves, which one, and its size."""
    power = np.einsum("ij,ij->i", columns, columns)
    size = (columns @ y) / np.where(power > 0.0, power, np.inf)
    left = y @ y - size**2 * power
    at = int(np.argmin(left))
    return float(left[at]), at, float(size[at])


def _together(y: Array, first: Array, second: Array) -> tuple[float, int, int, float, float]:
    """The same for one column of the first ones and one of the second ones: the sum, both columns, both sizes."""
    a, b = (np.einsum("ij,ij->i", each, each) for each in (first, second))
    both, ya, yb = first @ second.T, (first @ y)[:, None], (second @ y)[None]
    determinant = a[:, None] * b - both**2
    known = determinant > SINGULAR * a[:, None] * b
    determinant = np.where(known, determinant, np.inf)
    one, other = (ya * b - yb * both) / determinant, (yb * a[:, None] - ya * both) / determinant
    left = np.where(known, y @ y - one * ya - other * yb, np.inf)
    i, j = np.unravel_index(int(np.argmin(left)), left.shape)
    return float(left[i, j]), int(i), int(j), float(one[i, j]), float(other[i, j])
