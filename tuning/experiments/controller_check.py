"""The controller check: the law that the device is said to have, run on the recorded set-point and PV, gives the MV.

Where more than rounding is left between both (see `control_comparison`), the laws of `control_law` are tried one by
one; of a law with a size the size is fitted (least squares) with its standard deviation, the variance widened for what
is left that is not white.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from loopwright.tuning.experiments.control_comparison import LawComparison, LawOf, Left
from loopwright.tuning.experiments.control_law import AlternativeLaw, ControlLaw, LawDifference, alternatives
from loopwright.tuning.experiments.control_record import ControlPiece, ControlRecord
from loopwright.tuning.gains import Gains

EXACT = 5.0
"""What may be left between MV and the computed one as rounding of REAL32 values, in their rounding errors."""
SHIFTS = (0, 1, -1)
"""Samples by which the recorded MV may be later than the PV that it answers: values that are not of one instant."""
EXPLAINED = 0.5
"""An alternative explains the record where it leaves this part of the difference at most."""
AS_GOOD = 1.5
"""An alternative without a size is named rather than one with, where it leaves so many times as much at most."""
LAWS_TRIED_ON = 4000
"""Number of samples on which alternatives are tried at most: the latest ones."""
STEP_OF_SIZE = 1e-4
CLEAR = 5.0
"""Standard deviations by which a size has to differ from the law as said."""


@dataclass(frozen=True, slots=True)
class OtherLaw:
    """The law that fits in place of the one that the device is said to have.

    kind: in what it differs.
    size, deviation: its size and the standard deviation of that: a factor, a filter's time constant (s) or a weight;
    None for a form, which has none.
    left: the rms of what it leaves, in the rms of MV's motion.
    """

    kind: LawDifference
    size: float | None
    deviation: float | None
    left: float


@dataclass(frozen=True, slots=True)
class ControllerCheck:
    """How far the recorded MV is from the one that the said law gives.

    samples: the number of samples compared.
    away: the rms of the difference, in the rms of MV's motion; 0 where MV did not move.
    usually_away: the same without the samples that are the furthest away, see `control_comparison`.
    rounded: the same of the steps in which MV and PV are recorded.
    roundings: the rms of the difference in roundings of REAL32 values.
    other: the law that fits instead, None where none does or none is needed.
    gain_error, integral_error, filter_error_s: the smallest factors (less 1) and the shortest filter of PV, s, that
    would show in the record, as one standard deviation; infinite where nothing would.
    """

    samples: int
    away: float
    usually_away: float
    rounded: float
    roundings: float
    other: OtherLaw | None
    gain_error: float
    integral_error: float
    filter_error_s: float

    @property
    def exact(self) -> bool:
        """Whether the difference is no more than rounding."""
        return self.roundings <= EXACT


def check_controller(record: ControlRecord) -> ControllerCheck:
    """Compares the recorded MV with what the said law makes of set-point and PV, and finds what fits instead."""
    if not record.pieces:
        return ControllerCheck(0, 0.0, 0.0, 0.0, 0.0, None, math.inf, math.inf, math.inf)
    whole = LawComparison(record.pieces, record.Ts, record.reverse)
    left = whole.left(ControlLaw)
    rounding = whole.rounding
    if left.rms <= EXACT * rounding:
        return _checked(whole, left, None, max(left.rms, rounding))
    part = LawComparison(_latest(record.pieces), record.Ts, record.reverse)
    shift = min(SHIFTS, key=lambda each: (part.left(ControlLaw, each).rms, abs(each)))
    before = part.left(ControlLaw, shift)
    other, rest = _other(part, before, shift)
    return _checked(part, before, other, max(rest, rounding))


def _checked(compared: LawComparison, left: Left, other: OtherLaw | None, error: float) -> ControllerCheck:
    said = compared.pieces[-1].gains
    motion = compared.motion
    gain = compared.response(lambda g: ControlLaw(_times(g, Kp=1.0 + STEP_OF_SIZE)), STEP_OF_SIZE)
    integral = compared.response(lambda g: ControlLaw(_times(g, Ti=1.0 + STEP_OF_SIZE)), STEP_OF_SIZE)
    short = compared.Ts
    filtered = compared.response(lambda g: ControlLaw(g, short), short)
    return ControllerCheck(
        samples=compared.samples,
        away=left.rms / motion if motion > 0.0 else 0.0,
        usually_away=left.usual / motion if motion > 0.0 else 0.0,
        rounded=compared.quantum / motion if motion > 0.0 else 0.0,
        roundings=left.rms / compared.rounding,
        other=other,
        gain_error=error / gain if gain > 0.0 else math.inf,
        integral_error=(error / integral if integral > 0.0 else math.inf) if said.Ti > 0.0 else 0.0,
        filter_error_s=error / filtered if filtered > 0.0 else math.inf,
    )


def _times(gains: Gains, Kp: float = 1.0, Ti: float = 1.0) -> Gains:
    return Gains(Kp * gains.Kp, Ti * gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)


def _other(compared: LawComparison, before: Left, shift: int) -> tuple[OtherLaw | None, float]:
    """The law that fits better than the said one, None where none does well enough; and what the best leaves, MV
    units. shift: that which suits the said law best."""
    said = compared.pieces[-1].gains
    moved = any(np.any(each.sp != each.sp[0]) for each in compared.pieces)
    found = [
        one
        for each in alternatives(said, compared.Ts)
        if moved or not each.by_setpoint
        if (one := _tried(compared, each, {0, shift})) is not None
    ]
    smallest = max(min((one.left.rms for one in found), default=math.inf), compared.rounding)
    best = next(
        (one for one in found if one.size is None and one.left.rms <= AS_GOOD * smallest),
        min(found, key=lambda one: one.left.rms, default=None),
    )
    if best is None or best.left.rms > EXPLAINED * before.rms:
        return None, before.rms
    if best.size is not None and abs(best.size - best.law.neutral) <= CLEAR * best.deviation:
        return None, best.left.rms
    left = best.left.rms / compared.motion if compared.motion > 0.0 else 0.0
    deviation = None if best.size is None else best.deviation
    return OtherLaw(best.law.kind, best.size, deviation, left), best.left.rms


@dataclass(frozen=True, slots=True)
class _Tried:
    """One alternative with the size that fits best, and what it leaves."""

    law: AlternativeLaw
    size: float | None
    deviation: float
    left: Left


def _tried(compared: LawComparison, each: AlternativeLaw, shifts: set[int]) -> _Tried | None:
    """An alternative as it fits best, None where it is no law for these gains."""
    found = []
    for shift in shifts:
        size = _fitted(compared, each, shift) if each.sizes else None
        left = compared.left(_law(each, size), shift)
        if math.isfinite(left.rms):
            deviation = 0.0 if size is None else _deviation(compared, each, size, left, shift)
            found.append(_Tried(each, size, deviation, left))
    return min(found, key=lambda one: one.left.rms, default=None)


def _law(each: AlternativeLaw, size: float | None) -> LawOf:
    return lambda gains: each.law(gains, each.neutral if size is None else size)


def _fitted(compared: LawComparison, each: AlternativeLaw, shift: int) -> float:
    """The size of an alternative that leaves the minimum."""
    sizes = each.sizes
    rms = [compared.left(_law(each, size), shift).rms for size in sizes]
    at = int(np.argmin(rms))
    low, high = sizes[max(at - 1, 0)], sizes[min(at + 1, len(sizes) - 1)]
    if not math.isfinite(rms[at]) or low == high:
        return sizes[at]
    found = minimize_scalar(
        lambda size: compared.left(_law(each, float(size)), shift).rms ** 2,
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-6 * (high - low)},
    )
    return float(found.x) if found.fun <= rms[at] ** 2 else sizes[at]


def _deviation(compared: LawComparison, each: AlternativeLaw, size: float, left: Left, shift: int) -> float:
    """The standard deviation of a fitted size."""
    h = STEP_OF_SIZE * max(abs(size), compared.Ts if each.kind is LawDifference.PV_FILTER else 0.1)
    above, below = (compared.differences(_law(each, size + s * h), shift) for s in (1.0, -1.0))
    if above is None or below is None:
        return math.inf
    slope = sum(float((a - b) @ (a - b)) / (4.0 * h * h) for a, b in zip(above, below, strict=True))
    return max(left.rms, compared.rounding) * math.sqrt(left.ratio / slope) if slope > 0.0 else math.inf


def _latest(pieces: Sequence[ControlPiece]) -> list[ControlPiece]:
    """The latest pieces, of so many samples together that trying laws on them takes no long time."""
    kept: list[ControlPiece] = []
    samples = 0
    for each in reversed(pieces):
        if samples >= LAWS_TRIED_ON:
            break
        more = min(len(each.mv), LAWS_TRIED_ON - samples)
        if more < len(each.mv) and kept:
            break
        at = slice(len(each.mv) - more, None)
        kept.insert(0, ControlPiece(each.gains, each.sp[at], each.pv[at], each.mv[at]))
        samples += more
    return kept
