"""Whether MV of a record was moved by a controller, and by which gains, as far as SP, PV and MV tell.

Of a loop in automatic, MV is not free of the noise and the loads in PV. A fit from MV to PV is then biased unless it
explains PV to the noise (L. Ljung, System Identification, 1999, ch. 13), so that it matters who moved MV. A hand, a
relay or a sequence leaves MV at rest between few values; a controller moves it with every sample of PV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopwright.tuning.experiments.control_record import Bools
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals
from loopwright.tuning.operation.history import MAX_MOVED

FEWEST = 20
"""Smallest number of samples that are looked at."""
MIN_VALUES, MAX_RESTING = 0.1, 0.5
"""Smallest number of different values of MV per sample, and largest part of the samples at which MV keeps its value,
where MV is moved at every sample; else it is a staircase."""
MAX_LEFT = 0.1
"""Largest residual of MV's moves, predicted from their past, SP and PV, as a fraction of the residual of a prediction
from their past alone."""
MIN_LEFT_BY_OWN_PAST = 1e-3
"""Smallest residual of a prediction from MV's own past, as a fraction of the rms of MV's moves; a ramp or a sine leaves
less, and nothing is decided."""
TRIMMED, PASSES = 0.03, 3
"""Part of the samples that are left out as the furthest from the prediction (a set-point that was moved and is not in
the record, a limit, a change of mode), and the number of times that this is done."""
MIN_STAIRS = 6
"""Smallest number of different values of a staircase that a controller is looked for in."""
MANY_VALUES = 10
"""Smallest number of different values of MV that may be a controller's without a sign of one; a relay or steps by hand
have fewer."""
MAX_LEFT_OF_STAIRS, MAX_LEFT_BY_INTEGRAL = 0.22, 0.3
"""Largest residual of a staircase, computed from SP, PV and the integral of their difference, as a fraction of its
standard deviation, and of the residual without the integral; a plant that follows a hand slowly needs no integral."""
MIN_PART = 0.99
"""Smallest part of the variance of MV's moves that gains explain which are named."""
CLEARLY_LESS = 0.5
"""Sum of squares, relative to that without a derivative, below which there is one."""
NO_WEIGHT = 0.005
"""Set-point weight below which there is none."""
EXACT = 1e-6
"""Part of the variance of MV's moves below which nothing is left for a derivative."""
ROUNDING = 1e-9
"""Distance from the prediction, as a fraction of the largest value, within which no sample is left out."""
ENDS_OF_RANGE = (0.0, 100.0)
"""Values of MV in % that are limits although MV was there once."""


@dataclass(frozen=True, slots=True)
class RecordedControl:
    """A controller that moved MV, or may have moved it.

    certain: MV follows PV, or is moved at every sample while SP is moved by steps; else the only sign is that MV has
    many values.
    setpoint_moves: the number of samples at which the set-point moved; None: the record has no set-point.
    gains: the gains that MV follows by, ISA form, Kp positive; None: not found, or there is a derivative, whose filter
    would have to be known.
    part: the part of the variance of MV's moves that they explain; 0 without them.
    weight_minimum: the least that the set-point weight is, where MV was at a limit whenever the set-point moved, so
    that the record does not tell it; the gains have then the larger one of this and 1.
    """

    certain: bool
    setpoint_moves: int | None
    gains: Gains | None
    part: float
    weight_minimum: float | None = None


def recorded_control(Ts: float, mv: Reals, pv: Reals, sp: Reals | None) -> RecordedControl | None:
    """The controller that moved MV; None where MV has as few values as under a hand, a relay or a sequence.

    Ts: the sample time, s. mv, pv, sp: MV, PV and set-point at each sample, in their units, shape (N,).
    """
    if len(mv) < FEWEST or np.ptp(mv) == 0.0 or np.ptp(pv) == 0.0:
        return None
    if sp is not None and _tracks(sp, pv):
        sp = None  # in manual the set-point may be made to follow PV
    moves = None if sp is None else int(np.count_nonzero(np.diff(sp)))
    law = _FoundLaw(None) if _is_staircase(mv) else _gains(Ts, mv, pv, sp)
    if _is_staircase(mv):
        certain = _climbs_as_controlled(mv, pv, sp)
    else:
        by_an_operator = moves is not None and 0 < moves <= MAX_MOVED * len(mv)
        certain = by_an_operator or law.gains is not None or _follows(mv, pv, sp)
    if not certain and len(np.unique(mv)) < MANY_VALUES:
        return None
    return RecordedControl(certain, moves, law.gains, law.part, law.weight_minimum)


def at_limit(mv: Reals) -> Bools:
    """Whether MV is at a limit at each sample: at its largest or smallest value, which it has more than once or which
    is an end of the range in %. A controller asks for as much there, or for more."""
    found = np.zeros(len(mv), dtype=bool)
    for extreme in (float(np.min(mv)), float(np.max(mv))):
        there = mv == extreme
        if np.count_nonzero(there) > 1 or extreme in ENDS_OF_RANGE:
            found |= there
    return found


def _tracks(sp: Reals, pv: Reals) -> bool:
    """Whether the set-point is that of PV at most samples, now or a sample before."""
    moved = np.diff(sp) != 0.0
    if np.mean(moved) <= MAX_MOVED:
        return False
    near = 0.02 * np.ptp(pv)
    return bool(min(np.median(np.abs(sp - pv)), np.median(np.abs(sp[1:] - pv[:-1]))) <= near)


def _is_staircase(mv: Reals) -> bool:
    return len(np.unique(mv)) < MIN_VALUES * len(mv) or bool(np.mean(np.diff(mv) == 0.0) > MAX_RESTING)


def _follows(mv: Reals, pv: Reals, sp: Reals | None) -> bool:
    """Whether MV's moves follow from PV (and SP), and not from their own past."""
    moves = np.diff(mv) / np.max(np.abs(np.diff(mv)))
    own = np.column_stack((np.ones(len(moves) - 2), moves[1:-1], moves[:-2]))
    columns = [own]
    for column in (pv, sp):
        if column is not None and np.ptp(column) > 0.0:
            scaled = (column - column.mean()) / np.ptp(column)
            columns.append(np.column_stack((scaled[3:], scaled[2:-1], scaled[1:-2])))
    alone = _left(own, moves[2:])
    if alone <= MIN_LEFT_BY_OWN_PAST * float(np.sqrt(np.mean(moves[2:] ** 2))):
        return False
    return _left(np.column_stack(columns), moves[2:]) < MAX_LEFT * alone


def _left(columns: Reals, wanted: Reals) -> float:
    """The rms of what is left of a column, without the samples that are the furthest away."""
    found, kept = _fitted(columns, wanted)
    return float(np.sqrt(np.mean((wanted - columns @ found)[kept] ** 2)))


def _fitted(columns: Reals, wanted: Reals) -> tuple[Reals, Bools]:
    """The coefficients, and the samples that they were fitted to."""
    kept = np.ones(len(wanted), dtype=bool)
    stays = len(wanted) - int(TRIMMED * len(wanted))
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    for _ in range(PASSES):
        distance = np.abs(wanted - columns @ found)
        kept = distance <= max(np.partition(distance, stays - 1)[stays - 1], ROUNDING * np.max(np.abs(wanted)))
        found = np.linalg.lstsq(columns[kept], wanted[kept], rcond=None)[0]
    return np.asarray(found, dtype=np.float64), kept


def _climbs_as_controlled(mv: Reals, pv: Reals, sp: Reals | None) -> bool:
    """Whether a staircase is the output of a controller that is stored by exception, or coarsely."""
    if len(np.unique(mv)) < MIN_STAIRS:
        return False
    error = (-pv if sp is None else sp - pv) - float(np.mean(pv))
    plain = [np.ones(len(mv)), np.linspace(-1.0, 1.0, len(mv)), pv - pv.mean()]
    if sp is not None and np.ptp(sp) > 0.0:
        plain.append(sp - sp.mean())
    integral = np.cumsum(error - error.mean())
    wanted = (mv - mv.mean()) / mv.std()
    without = _left(np.column_stack(plain), wanted)
    left = _left(np.column_stack((*plain, integral / max(float(np.ptp(integral)), 1e-300))), wanted)
    return left <= MAX_LEFT_OF_STAIRS and left <= MAX_LEFT_BY_INTEGRAL * without


class _FoundLaw(NamedTuple):
    """The gains that MV's moves follow by, the part of their variance that these explain, and `weight_minimum`."""

    gains: Gains | None
    part: float = 0.0
    weight_minimum: float | None = None


def _gains(Ts: float, mv: Reals, pv: Reals, sp: Reals | None) -> _FoundLaw:
    """The gains that MV's moves follow by. Moves to a limit or from it are left out: they are what was left of what the
    controller asked for, and tell only the least that the set-point weight is."""
    if sp is None:
        return _FoundLaw(None)
    moves, error, limited = np.diff(mv)[1:], (sp - pv)[1:-1], at_limit(mv)
    free = ~(limited[2:] | limited[1:-1])
    if np.count_nonzero(free) < FEWEST:
        return _FoundLaw(None)
    columns, stepped = [-np.diff(pv)[1:], Ts * error], np.diff(sp)[1:]
    moved = bool(np.any(stepped[free]))
    if moved:
        columns.append(stepped)
    found, part = _law([column[free] for column in columns], moves[free])
    _, with_derivative = _law([column[free] for column in (*columns, -np.diff(pv, 2))], moves[free])
    derivative = 1.0 - part > EXACT and 1.0 - with_derivative < CLEARLY_LESS * (1.0 - part)
    Kp, Ki = float(found[0]), float(found[1])
    if part < MIN_PART or derivative or Kp * Ki <= 0.0:
        return _FoundLaw(None)
    minimum = None
    if moved:
        b = float(found[2] / Kp)
    elif np.any(stepped):
        steps = np.flatnonzero(stepped)
        asked = moves[steps] - np.column_stack(columns)[steps] @ found
        minimum = max(float(np.max(asked / (Kp * stepped[steps]))), 0.0)
        b = max(1.0, minimum)
    else:
        b = 1.0
    return _FoundLaw(Gains(abs(Kp), Kp / Ki, b=0.0 if abs(b) < NO_WEIGHT else b), part, minimum)


def _law(columns: list[Reals], moves: Reals) -> tuple[Reals, float]:
    """The coefficients, and the part of the variance of the moves that they explain."""
    regressors = np.column_stack(columns)
    found, kept = _fitted(regressors, moves)
    power = float(moves[kept] @ moves[kept])
    left = (moves - regressors @ found)[kept]
    return found, 0.0 if power == 0.0 or not math.isfinite(power) else 1.0 - float(left @ left) / power
