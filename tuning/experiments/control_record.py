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
SAME_RATE, RATE_SEEN = 1e-4, 3
"""MV that moves at its fastest, to this relative difference, at so many samples is limited in its rate."""
REAL32 = 2.0**-23
"""Distance of two neighbouring numbers of a REAL32, relative."""
RATE_QUANTA = 8.0
"""The smallest such move, in smallest moves of MV: coarse values repeat by themselves."""


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


def control_record(
    facts: Facts, trace: Trace, gains: Sequence[tuple[int, int, Gains]]
) -> ControlRecord:
    """What a trace shows of its controller.

    gains: which gains were in effect, and from which sample to which (exclusive).
    """
    Ts = facts.sample_time_s
    t, sp, pv, mv = (np.asarray(column, dtype=float) for column in (trace.t, trace.sp, trace.pv, trace.mv))
    good = np.asarray(trace.mode) == Mode.AUTOMATIC
    good &= np.isfinite(sp) & np.isfinite(pv) & np.isfinite(mv)
    good &= ~at_limit(mv, good, facts.mv_low, facts.mv_high)
    good[trace.filled] = False
    follows = np.append(False, np.abs(np.diff(t) / Ts - 1.0) < 0.5)
    pieces = []
    for first, end, each in gains:
        for part in _rows(good[first:end], follows[first:end]):
            at = slice(first + part.start, first + part.stop)
            pieces.append(ControlPiece(each, sp[at], pv[at], mv[at]))
    return ControlRecord(Ts, facts.reverse, tuple(pieces))


def _rows(good: Bools, follows: Bools) -> list[slice]:
    """The rows of good samples without a gap that are long enough."""
    breaks = np.flatnonzero(~good | ~follows)
    edges = [0, *breaks.tolist(), len(good)]
    rows = []
    for begin, end in pairwise(edges):
        first = begin if begin < len(good) and good[begin] else begin + 1
        if end - first >= MIN_SAMPLES:
            rows.append(slice(first, end))
    return rows


def at_limit(mv: Reals, automatic: Bools, low: float, high: float) -> Bools:
    """Whether MV is held by a limit: by one of these two, by one in the device that shows in a value that MV keeps at
    its extreme, or by one of its rate. mv, automatic: MV, and whether the controller gives it, shape (N,)."""
    held = np.zeros(len(mv), dtype=bool)
    if not automatic.any():
        return held
    hair = HAIR * (high - low) if np.isfinite(high - low) else 0.0
    held |= (mv <= low + hair) | (mv >= high - hair)
    both = automatic[1:] & automatic[:-1]
    for extreme in (mv[automatic].min(), mv[automatic].max()):
        same = mv == extreme
        if np.any(same[1:] & same[:-1] & both):
            held |= same
    moves = np.where(both, np.abs(np.diff(mv)), 0.0)
    fastest, smallest = float(moves.max(initial=0.0)), float(moves[moves > 0.0].min(initial=np.inf))
    rounding = REAL32 * float(np.abs(mv[automatic]).max())
    limited = moves >= fastest - SAME_RATE * fastest - 2.0 * rounding
    if fastest > RATE_QUANTA * max(smallest, rounding) and np.count_nonzero(limited) >= RATE_SEEN:
        held[1:] |= limited
    return held
