"""Whether columns that a historian has exported show the loop itself.

A historian may store exceptions only, interpolate between them, or log OP and PV at different times. A fit would take
all of this for the plant. The controller's equation tells: OP of each sample follows from SP and PV of the same one.
"""

from __future__ import annotations

import numpy as np

from loopwright.tuning.models import Reals
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.recorded_control import at_limit
from loopwright.tuning.reasons import Reason, Refused

MAX_REPEATED, MAX_STRAIGHT = 0.5, 0.5
"""Largest fraction of the samples at which MV is exactly that of the sample before, and at which MV or PV goes on in a
straight line."""
ROUNDED = 0.1
"""Size of the resolution, in usual moves from sample to sample, below which a straight line shows in spite of it."""
LAGS = range(-3, 4)
"""Samples by which MV may be logged late, or early, that are looked at."""
MIN_FOLLOWED, CLEARLY_BETTER = 0.5, 0.1
"""Smallest part of the variance of MV's moves that the controller's equation explains, and the difference of this part
that tells one lag from another."""
GAIN_RANGE = (0.8, 1.25)
"""Smallest and largest ratio of MV's moves to what the gains given would make of them."""
RAW = "export the raw values of SP, PV and OP of every sample (no compression, no interpolation), all of the same time"


def require_raw(stretch: Stretch) -> None:
    """Raises Refused, BAD_INPUT, where MV or PV repeats its values or goes in straight lines."""
    moves = np.diff(stretch.mv)
    repeated = float(np.mean(moves == 0.0))
    if repeated > MAX_REPEATED:
        text = f"OP repeats its value at {100.0 * repeated:.0f} % of the samples, as where exceptions alone are stored"
        raise Refused(Reason.BAD_INPUT, f"{text}: {RAW}")
    for name, column in (("OP", stretch.mv), ("PV", stretch.pv)):
        straight = _straight(column)
        if straight > MAX_STRAIGHT:
            text = f"{name} goes on in a straight line at {100.0 * straight:.0f} % of the samples, as interpolated"
            raise Refused(Reason.BAD_INPUT, f"{text}: {RAW}")


def action_of(stretch: Stretch) -> bool:
    """Whether the controller acts reversely: MV falls as PV rises.

    Raises Refused, BAD_INPUT: MV does not follow from set-point and PV by the gains of the stretch, or by that of
    another sample.
    """
    followed = {lag: _followed(stretch, lag) for lag in LAGS}
    best = max(followed, key=lambda lag: followed[lag][0])
    part, ratio = followed[best]
    gains = stretch.gains
    named = f"Kp {gains.Kp:g}, Ti {gains.Ti:g} s" + (f", Td {gains.Td:g} s" if gains.Td else "")
    if part < MIN_FOLLOWED:
        text = f"OP does not follow from SP and PV by {named}: these explain {100.0 * part:.0f} % of its moves"
        raise Refused(Reason.BAD_INPUT, f"{text}. Check the gains, that the loop was in automatic, or {RAW}")
    if (furthest := _beyond_weight(stretch, ratio)) > 1.0 / GAIN_RANGE[0]:
        text = f"where SP steps OP moves {furthest:.2g} times as far as b {gains.b:g} asks for, and stops at its limit"
        raise Refused(Reason.BAD_INPUT, f"{text}: give the set-point weight that was in effect")
    if best != 0 and part > followed[0][0] + CLEARLY_BETTER:
        late = "after" if best > 0 else "before"
        text = f"OP is logged {abs(best)} sample(s) {late} the PV that it answers: shift the column, or {RAW}"
        raise Refused(Reason.BAD_INPUT, text)
    low, high = GAIN_RANGE
    if not low <= abs(ratio) <= high:
        text = f"OP moves {abs(ratio):.2g} times as far as {named} would move it"
        raise Refused(Reason.BAD_INPUT, f"{text}: give Kp in units of OP per unit of PV, Ti and Td in s, ISA form")
    return ratio > 0.0


def _straight(column: Reals) -> float:
    """The fraction of the moves that go on as the one before."""
    moves = np.diff(column)
    moved = np.abs(moves) > 0.0
    if np.mean(moved) < 1.0 - MAX_REPEATED:
        return 0.0  # a value that rests is no line
    usual = float(np.median(np.abs(moves[moved])))
    resolution = float(np.min(np.abs(moves[moved])))
    tolerance = 1e-6 * usual + (1.01 * resolution if resolution < ROUNDED * usual else 0.0)
    on = np.abs(np.diff(moves)) <= tolerance
    return float(np.mean(on & moved[1:] & moved[:-1]))


def _followed(stretch: Stretch, lag: int) -> tuple[float, float]:
    """The part of the variance of MV's moves that the controller's equation explains, where MV is logged so many
    samples late, and the ratio of the moves to those of the equation (negative for a direct action)."""
    asked = _asked(stretch)
    moves, limited = np.diff(stretch.mv), at_limit(stretch.mv)
    free = ~(limited[1:] | limited[:-1])  # at a limit MV moves less than was asked for
    first, last = max(lag, 0), min(lag, 0)
    moves, free = moves[first : len(moves) + last], free[first : len(free) + last]
    moves, asked = moves[free], asked[first - lag : len(asked) - lag + last][free]
    power = float(asked @ asked)
    if power == 0.0 or not np.any(moves):
        return 0.0, 0.0
    ratio = float(moves @ asked) / power
    return ratio * float(moves @ asked) / float(moves @ moves), ratio


def _asked(stretch: Stretch) -> Reals:
    """The moves of MV that the controller's equation asks for, of a reverse action, MV units, shape (N - 1,)."""
    gains, Ts = stretch.gains, stretch.Ts
    error = stretch.sp - stretch.pv
    asked = gains.Kp * (np.diff(gains.b * stretch.sp - stretch.pv) + (Ts / gains.Ti if gains.Ti else 0.0) * error[:-1])
    if gains.Td:
        slope = np.diff(stretch.pv, prepend=stretch.pv[0]) / Ts
        asked = asked - gains.Kp * gains.Td * np.diff(slope)
    return np.asarray(asked)


def _beyond_weight(stretch: Stretch, ratio: float) -> float:
    """How many times as far as asked for MV moves at most where the set-point steps and MV reaches a limit."""
    limited, moves, asked = at_limit(stretch.mv), np.diff(stretch.mv), ratio * _asked(stretch)
    rows = np.flatnonzero(limited[1:] & ~limited[:-1] & (np.diff(stretch.sp) != 0.0))
    same_way = np.maximum(asked[rows] * np.sign(moves[rows]), 1e-9 * np.abs(moves[rows]))
    return float(np.max(np.abs(moves[rows]) / same_way, initial=0.0))
