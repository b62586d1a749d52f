"""The record of a test of a loop, checked before an identification uses it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Reason, Refused

MIN_SAMPLES = 20
MIN_AFTER_THE_FIRST_MOVE = 10
UNEVEN = 0.2
"""Largest accepted deviation of an interval between samples, as a fraction of the sample time."""
GAP = 1.5
"""Interval between samples, in sample times, above which it is called a gap."""


@dataclass(frozen=True, slots=True)
class RecordedTest:
    """A checked record of a test.

    Ts: the sample time, s.
    u: MV, held from each sample to the next, MV units, shape (N,).
    y: PV at each sample, PV units, shape (N,).
    u_before: MV before the record.
    first_move: the first sample at which MV differs from u_before.
    """

    Ts: float
    u: Reals
    y: Reals
    u_before: float
    first_move: int


def recorded_test(t: ArrayLike, u: ArrayLike, y: ArrayLike, u_before: float | None = None) -> RecordedTest:
    """Checks the columns of a record and puts them together.

    t: the times of the samples, s, evenly spaced.
    u, y: MV and PV, as many values as t.
    u_before: MV before the record, by default the first value of u.
    Raises Refused: BAD_INPUT, naming the sample that cannot be used; NO_RESPONSE for a constant PV.
    """
    time, mv, pv = (column(name, values) for name, values in (("t", t), ("u", u), ("y", y)))
    if not len(time) == len(mv) == len(pv):
        raise _bad(f"t, u and y must be equally long; they have {len(time)}, {len(mv)} and {len(pv)} samples")
    if len(time) < MIN_SAMPLES:
        raise _bad(f"too few samples: {len(time)}; at least {MIN_SAMPLES} are needed")
    Ts = sample_time(time)
    before = float(mv[0]) if u_before is None else float(u_before)
    if not np.isfinite(before):
        raise _bad(f"u_before must be a finite number, not {before}")
    moved = np.flatnonzero(mv != before)
    if not len(moved):
        raise _bad(
            f"the input is constant at {before:g}: nothing can be learnt from it; MV must move at least "
            "once (if it moved when the record began, say from where: u_before, --mv-before)"
        )
    first = int(moved[0])
    if len(time) - first - 1 < MIN_AFTER_THE_FIRST_MOVE:
        raise _bad(
            f"only {len(time) - first - 1} samples follow the first move of the input (sample {first}); "
            f"at least {MIN_AFTER_THE_FIRST_MOVE} are needed"
        )
    if float(np.ptp(pv)) == 0.0:
        raise Refused(Reason.NO_RESPONSE, f"PV is constant at {pv[0]:g} while MV moves")
    return RecordedTest(Ts, mv, pv, before, first)


def column(name: str, values: ArrayLike) -> Reals:
    """One column of a record, shape (N,). Raises Refused, BAD_INPUT, naming the sample that cannot be used."""
    try:
        column = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise _bad(f"{name} must be a series of numbers") from None
    if column.ndim != 1:
        raise _bad(f"{name} must be one series of numbers, not {column.ndim}-dimensional")
    wrong = np.flatnonzero(~np.isfinite(column))
    if len(wrong):
        at = int(wrong[0])
        raise _bad(f"{name} must be finite everywhere; sample {at} is {column[at]} ({len(wrong)} in all)")
    return column


def sample_time(t: Reals) -> float:
    """The sample time of evenly spaced times, s. Raises Refused, BAD_INPUT, naming the sample that is not."""
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0.0)
    if len(back):
        at = int(back[0]) + 1
        raise _bad(f"t must increase; sample {at} has {t[at]:g} s after {t[at - 1]:g} s")
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > GAP * usual)
    if len(gaps):
        at = int(gaps[0]) + 1
        raise _bad(
            f"gap in t: {steps[at - 1]:g} s before sample {at} where {usual:g} s is usual ({len(gaps)} in all); "
            "use a part without gaps"
        )
    uneven = np.flatnonzero(np.abs(steps - usual) > UNEVEN * usual)
    if len(uneven):
        at = int(uneven[0]) + 1
        raise _bad(
            f"t must be evenly spaced within {100 * UNEVEN:.0f} %; sample {at} comes {steps[at - 1]:g} s after the "
            f"last where {usual:g} s is usual"
        )
    return float((t[-1] - t[0]) / (len(t) - 1))


def _bad(text: str) -> Refused:
    return Refused(Reason.BAD_INPUT, text)
