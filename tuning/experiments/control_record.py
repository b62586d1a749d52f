"""The parts of a record in which a controller's law alone gave MV: in automatic, under known gains, with no limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.experiments.primitives import Facts, Trace
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals
from loopwright.tuning.plan import Mode

Bools = NDArray[np.bool_]
MIN_SAMPLES = 12
"""Smallest number of samples in a row that tell something: the law's start in each row is not known."""
HAIR = 1e-6
"""Distance from a limit at which MV is at it, as a fraction of the range of MV: a REAL32 on the bus."""
SAME_RATE = 1e-4
"""Relative difference from its fastest move at which MV may be limited in its rate."""
REAL32 = 2.0**-23
"""Distance of two neighbouring numbers of a REAL32, relative."""
RATE_STEPS = 8.0
"""The smallest such move, in steps of a coarse MV, whose fastest moves come again and again by themselves."""
EVEN = 1e-3
"""How far coarse values may be from even steps, in steps."""


@dataclass(frozen=True, slots=True, eq=False)
class ControlPiece:
    """Samples in a row for which the law gave MV.

    gains: the gains that the controller is said to have.
    sp, pv, mv: set-point, PV and the MV that answers this PV, absolute, shape (N,).
    """

    gains: Gains
    sp: Reals
    pv: Reals
    mv: Reals


@dataclass(frozen=True, slots=True, eq=False)
class ControlRecord:
    """What a record shows of its controller.

    Ts: the sample time, s. reverse: the action, see `Facts`.
    pieces: the parts in which the law alone gave MV.
    """

    Ts: float
    reverse: bool
    pieces: tuple[ControlPiece, ...]

    @property
    def samples(self) -> int:
        """The number of samples of all pieces."""
        return sum(len(each.mv) for each in self.pieces)


def control_record(facts: Facts, trace: Trace, gains: Sequence[tuple[int, int, Gains]]) -> ControlRecord:
    """What a trace shows of its controller.

    gains: which gains were in effect, and from which sample to which (exclusive).
    """
    Ts = facts.sample_time_s
    t, sp, pv, mv = (np.asarray(column, dtype=float) for column in (trace.t, trace.sp, trace.pv, trace.mv))
    known = np.isfinite(sp) & np.isfinite(pv) & np.isfinite(mv)
    known[trace.filled] = False
    follows = np.append(False, known[1:] & known[:-1] & (np.abs(np.diff(t) / Ts - 1.0) < 0.5))
    good = known & (np.asarray(trace.mode) == Mode.AUTOMATIC)
    good &= ~at_limit(mv, good, follows, facts.mv_low, facts.mv_high)
    pieces = []
    for first, end, each in gains:
        for part in _rows(good[first:end], follows[first:end]):
            at = slice(first + part.start, first + part.stop)
            pieces.append(ControlPiece(each, sp[at], pv[at], mv[at]))
    return ControlRecord(Ts, facts.reverse, tuple(pieces))


def rows_without_limit(mv: Reals) -> list[slice]:
    """The rows of samples of normal operation that no limit of MV holds, where no limit is known. mv: shape (N,)."""
    good = np.ones(len(mv), dtype=bool)
    follows = np.arange(len(mv)) > 0
    return _rows(~at_limit(mv, good, follows, -np.inf, np.inf), follows)


def _rows(good: Bools, follows: Bools) -> list[slice]:
    """The rows of good samples without a gap that are long enough. The first one after a gap is left out: how far MV
    has moved to it is not known."""
    breaks = np.flatnonzero(~good | ~follows)
    edges = pairwise([-1, *breaks.tolist(), len(good)])
    return [slice(begin + 1, end) for begin, end in edges if end - begin > MIN_SAMPLES]


def at_limit(mv: Reals, good: Bools, follows: Bools, low: float, high: float) -> Bools:
    """Whether MV may be held by a limit: by one of these two, by one in the device that shows in a value that MV has at
    its extreme more than once, or by one of its rate: where it moves at its fastest.

    mv: MV, shape (N,). good: whether the law gives MV. follows: whether a sample is the next after the one before.
    """
    held = np.zeros(len(mv), dtype=bool)
    if not good.any():
        return held
    hair = HAIR * (high - low) if np.isfinite(high - low) else 0.0
    held |= (mv <= low + hair) | (mv >= high - hair)
    for extreme in (mv[good].min(), mv[good].max()):
        same = good & (mv == extreme)
        if np.count_nonzero(same) > 1:
            held |= same
    # the first move of the law after a relay or a manual output is its own too
    moves = np.where(good[1:] & follows[1:], np.abs(np.diff(mv)), 0.0)
    fastest = float(moves.max(initial=0.0))
    rounding = REAL32 * float(np.abs(mv[good]).max())
    if fastest > max(RATE_STEPS * _steps(mv[good]), RATE_STEPS * rounding):
        held[1:] |= moves >= fastest - SAME_RATE * fastest - 2.0 * rounding
    return held


def _steps(mv: Reals) -> float:
    """The steps in which MV is recorded; 0 where it is not in even ones. mv: shape (N,)."""
    moves = np.diff(np.unique(mv))
    if not len(moves):
        return 0.0
    counted = moves / moves.min()
    return float(moves.min()) if np.all(np.abs(counted - np.round(counted)) < EVEN) else 0.0
