"""Whether a loop cycles by itself because its valve sticks, by a record of it in automatic without a test.

The valve stays where it is while the integral of the controller moves MV, and jumps when MV is off by its stiction
(M. A. A. S. Choudhury, N. F. Thornhill, S. L. Shah, Control Engineering Practice 13, 2005, with S = J): PV of a flow is
then square and MV triangular, and the level of a vessel saws. Positions of valves that stick by so much are
followed, and PV is fitted with what a first-order plant, or an integrating one, makes of each, beside what it makes of
MV itself, and of MV and a load that goes to and fro, or up and down, as often as such a valve jumps: that looks alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROWS, MIN_ROWS = 400, 40
"""Largest number of averages that are fitted, and smallest number of samples."""
SIZES, SMALLEST, LARGEST = 60, 0.35, 1.0
"""Sizes of stiction that are tried, as parts of MV's range."""
BEGINNINGS = tuple(np.linspace(-0.96, 0.96, 17).tolist())
"""How far from MV the valve may stand at the beginning, in its stiction."""
LAGS, DEAD_TIMES, LONGEST_LAG, LONGEST_DEAD_TIME = 8, 14, 0.5, 0.25
"""Lags and dead times that are tried, and the longest ones as parts of the record."""
CLEAR, CLEAR_OF_LOADS = 2.0, 1.2
"""Ratios of the sums of squares left by a sound valve, and by one under such a load, to that of one that sticks, from
which on it sticks, and up to which a load is not the better explanation: it has one more size, and a dead time of its
own."""
SINGULAR = 1e-6
MIN_LEVELS = 20
"""Smallest number of values that PV has: rounding alone makes a square of PV and a triangle of MV."""
MAX_RESIDUAL_NOISES, MAX_RESIDUAL = 1.35, 0.04
"""Largest residual, in standard deviations of the noise and of PV, of a valve that sticks: a load that goes to and fro
leaves more."""
REFINED, NEAR = 3, 11
"""How often the sizes, lags and dead times are tried again around the best ones, and how many."""
SHORTEST_LAG = 0.3
HALF_CYCLES, MAX_STRETCHES, CROSSED = 9, 4, 0.2
"""Length of a stretch, the largest number of stretches, and the move of MV to its other side that counts, as a part of
its range."""
MIN_TURNS = 3
"""Smallest number of times that the jumps change their direction."""
MIN_MOVE_NOISES = 3.0
"""Smallest move of PV, in standard deviations of the noise, that is looked at."""


@dataclass(frozen=True, slots=True)
class Sticking:
    """A valve that sticks.

    size: MV units. jumps, turns: how often it has jumped, and how often into the other direction than before.
    period_s: of the cycle, s. mv, pv: their ranges, in their units.
    """

    size: float
    jumps: int
    turns: int
    period_s: float
    mv: float
    pv: float

    @property
    def in_words(self) -> str:
        """The cycle and its cause, as a sentence without its end."""
        return (
            f"the loop cycles by itself, every {self.period_s:.3g} s, MV by {self.mv:.3g} and PV by {self.pv:.3g} from "
            f"peak to peak: a valve that sticks until MV is off by about {self.size:.2g} explains it"
        )


def find_sticking(Ts: float, mv: Array, pv: Array) -> Sticking | None:
    """The stiction that explains the cycle of a loop in automatic; None where the record shows none.

    A long record is looked at in stretches of a few cycles: a small error of the size adds up over many. Half of them
    have to show it.

    Ts: the sample time, s. mv, pv: shape (N,).
    """
    if len(pv) < MIN_ROWS:
        return None
    noise = float(np.std(np.diff(pv))) / math.sqrt(2.0)
    off = mv - mv.mean()
    crossed = np.flatnonzero(np.diff(np.sign(off[np.abs(off) > CROSSED * np.ptp(mv)])))
    stretches = min(max(len(crossed) // HALF_CYCLES, 1), MAX_STRETCHES)
    length = HALF_CYCLES * len(mv) // max(len(crossed), HALF_CYCLES)
    parts = [slice(int(at), int(at) + length) for at in np.linspace(0, len(mv) - length, stretches)]
    found = [each for part in parts if (each := _in_one(Ts, mv[part], pv[part], noise)) is not None]
    found.sort(key=lambda each: each.size)
    return found[len(found) // 2] if len(found) >= 0.5 * stretches else None


def _in_one(Ts: float, mv: Array, pv: Array, noise: float) -> Sticking | None:
    """The same for a stretch of a few cycles."""
    block = math.ceil(len(pv) / ROWS)
    rows = len(pv) // max(block, 1)
    if rows < MIN_ROWS or not np.ptp(mv) > 0.0 or len(np.unique(pv)) < MIN_LEVELS:
        return None
    y = _averaged(pv - pv.mean(), block, rows)
    if np.ptp(y) < 2.0 * MIN_MOVE_NOISES * noise / math.sqrt(block):
        return None
    lags, delays = _lags(rows), _delays(rows)
    sizes = np.ptp(mv) * np.geomspace(SMALLEST, LARGEST, SIZES)
    best = None
    for _ in range(REFINED):
        all_sizes = np.repeat(sizes, len(BEGINNINGS))
        positions = _followed(mv, all_sizes, mv[0] + np.tile(BEGINNINGS, len(sizes)) * all_sizes)
        turns = np.array([_turns(each) for each in positions])
        positions, all_sizes = positions[turns >= MIN_TURNS], all_sizes[turns >= MIN_TURNS]
        if not len(all_sizes):
            return None
        found = _left_by(np.stack([_averaged(each, block, rows) for each in positions]), y, lags, delays)
        best = (found, float(all_sizes[found.at]), positions[found.at])
        near = np.linspace(-1.0, 1.0, NEAR)
        sizes = best[1] * (LARGEST / SMALLEST) ** (near / (SIZES - 1))
        lags = found.lag * (LONGEST_LAG * rows / SHORTEST_LAG) ** (near / (LAGS - 1))
        delays = np.clip(found.delay + np.linspace(-1.0, 1.0, NEAR) * max(0.4 * found.delay, 2.0), 0.0, rows / 2)
    assert best is not None
    found, size, position = best
    sound = _left_by(_averaged(mv, block, rows)[None], y, _lags(rows), _delays(rows)).left
    explained = max((MAX_RESIDUAL_NOISES * noise) ** 2 / block, MAX_RESIDUAL**2 * float(np.var(y)))
    if sound < CLEAR * found.left or found.left > rows * explained:
        return None
    if found.left > CLEAR_OF_LOADS * _left_by_loads(mv, position, y, block):
        return None
    jumps, turned = np.flatnonzero(np.diff(position)), _turns(position)
    period_s = 2.0 * Ts * (jumps[-1] - jumps[0]) / max(turned - 1, 1)
    return Sticking(size, len(jumps), turned, period_s, float(np.ptp(mv)), float(np.ptp(y)))


def _lags(rows: int) -> Array:
    return np.append(np.geomspace(SHORTEST_LAG, LONGEST_LAG * rows, LAGS), math.inf)


def _delays(rows: int) -> Array:
    return np.geomspace(1.0, LONGEST_DEAD_TIME * rows, DEAD_TIMES) - 1.0


def _averaged(values: Array, block: int, rows: int) -> Array:
    return np.asarray(values[: rows * block].reshape(rows, block).mean(axis=1))


def _followed(mv: Array, sizes: Array, begun: Array) -> Array:
    """The positions of valves that stick by these sizes and begin there, shape (sizes, N)."""
    at, found = begun, np.empty((len(mv), len(sizes)))
    for k, value in enumerate(mv.tolist()):
        at = np.where(np.abs(value - at) > sizes, value, at)
        found[k] = at
    return np.ascontiguousarray(found.T)


def _turns(position: Array) -> int:
    """How often the jumps of a valve change their direction."""
    jumps = np.diff(position)
    return int(np.count_nonzero(np.diff(np.sign(jumps[jumps != 0.0]))))


@dataclass(frozen=True, slots=True)
class _Fitted:
    """left: the sum of squares. at: the input. lag, delay: in rows; an infinite lag is that of an integrating plant."""

    left: float
    at: int
    lag: float
    delay: float


def _left_by_loads(mv: Array, position: Array, y: Array, block: int) -> float:
    """The least that a sound valve leaves of PV under a load that jumps to and fro, at the plant's input or in PV
    itself, or goes up and down, as often as this valve turns.

    mv, position: shape (N,). y: PV, averages over `block` samples, shape (rows,).
    """
    rows = len(y)
    jumps = np.sign(np.diff(position, prepend=position[0]))
    at = np.flatnonzero(jumps)
    to_and_fro = np.where(np.arange(len(mv)) < at[0], -jumps[at[0]], jumps[at[np.cumsum(jumps != 0.0).clip(1) - 1]])
    u, square = _averaged(mv - mv[0], block, rows), _averaged(to_and_fro, block, rows)
    loads = (square, np.cumsum(square - square.mean()))
    delays = np.unique(np.rint(_delays(rows)).astype(int)).tolist()
    smallest = math.inf
    for T in _lags(rows).tolist():
        free, of_mv = _free(rows, T), _late(_driven(u, T), delays)
        wanted = y - free @ (free.T @ y)
        of_mv -= (of_mv @ free) @ free.T
        for load in (*(_driven(each - each[0], T) for each in loads), square):
            of_load = _late(load, delays)
            of_load -= (of_load @ free) @ free.T
            smallest = min(smallest, _left_by_both(of_mv, of_load, wanted))
    return smallest


def _left_by_both(first: Array, second: Array, y: Array) -> float:
    """The least that one of the first and one of the second columns, shape (columns, rows), leave of y together."""
    a, b = (np.einsum("ij,ij->i", each, each) for each in (first, second))
    both, ya, yb = first @ second.T, (first @ y)[:, None], (second @ y)[None]
    determinant = a[:, None] * b - both**2
    known = determinant > SINGULAR * a[:, None] * b
    determinant = np.where(known, determinant, math.inf)
    explained = (ya**2 * b - 2.0 * ya * yb * both + yb**2 * a[:, None]) / determinant
    return float(y @ y - np.where(known, explained, 0.0).max())


def _driven(inputs: Array, T: float) -> Array:
    """What a plant of gain 1 and this lag, in rows, makes of inputs, shape (..., rows)."""
    share = 1.0 if math.isinf(T) else -math.expm1(-1.0 / T)
    from scipy.signal import lfilter  # its import takes 0.4 s

    return np.asarray(lfilter([share], [1.0, -1.0 if math.isinf(T) else share - 1.0], inputs))


def _late(values: Array, delays: list[int]) -> Array:
    """These values, shape (rows,), later by each of these numbers of rows, shape (delays, rows)."""
    return np.stack([np.concatenate((np.full(each, values[0]), values[: len(values) - each])) for each in delays])


def _free(rows: int, T: float) -> Array:
    """What such a plant does by itself, orthonormal, shape (rows, 2)."""
    n = np.arange(rows)
    start = n / rows if math.isinf(T) else np.exp(-n / T)
    return np.asarray(np.linalg.qr(np.stack((np.ones(rows), start), axis=1))[0])


def _left_by(inputs: Array, y: Array, lags: Array, delays: Array) -> _Fitted:
    """The plant driven by one of these inputs that leaves the least of PV.

    inputs: shape (inputs, rows). y: shape (rows,). lags, delays: that are tried, in rows.
    """
    rows = len(y)
    delays = np.unique(np.rint(delays).astype(int))
    best = _Fitted(math.inf, 0, math.inf, 0.0)
    for T in lags.tolist():
        moved, free = _driven(inputs - inputs[:, :1], T), _free(rows, T)
        wanted = y - free @ (free.T @ y)
        for delay in delays.tolist():
            late = np.concatenate((np.zeros((len(inputs), delay)), moved[:, : rows - delay]), axis=1)
            late -= (late @ free) @ free.T
            power = np.einsum("ij,ij->i", late, late)
            explained = (late @ wanted) ** 2 / np.where(power > 0.0, power, math.inf)
            at = int(np.argmax(explained))
            left = float(wanted @ wanted - explained[at])
            best = min(best, _Fitted(left, at, T, delay), key=lambda each: each.left)
    return best
