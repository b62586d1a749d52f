"""Recorded MV beside the MV that a control law makes of the recorded set-point and PV.

Each piece of the record has a constant of its own (the integral before it is not known) and a start of filter and
derivative of its own; both are projected out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from loopwright.tuning.experiments.control_law import ControlLaw
from loopwright.tuning.experiments.control_record import REAL32, ControlPiece
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals

FARTHEST = 0.03
"""Part of the samples that may be far from any law: a set-point on record a sample late."""


@dataclass(frozen=True, slots=True)
class Left:
    """What a law leaves.

    rms, usual: of the difference, and without the samples that are the furthest away, MV units.
    ratio: the variance inflation for what is not white.
    """

    rms: float
    usual: float
    ratio: float


LawOf = Callable[[Gains], ControlLaw | None]


class LawComparison:
    """Recorded and computed MV, piece by piece, without the starts of the pieces."""

    def __init__(self, pieces: Sequence[ControlPiece], Ts: float, reverse: bool) -> None:
        self.pieces, self.Ts, self._reverse = pieces, Ts, reverse
        self._starts: dict[tuple[int, tuple[float, ...]], Reals] = {}
        motions = ([each.mv for each in pieces], self._computed(ControlLaw) or [])
        self.motion = max(_rms([each - each.mean() for each in columns]) for columns in motions)
        """The rms of recorded or of computed MV, the larger one, without the levels of the pieces, MV units."""

    @property
    def samples(self) -> int:
        return sum(len(each.mv) for each in self.pieces)

    @property
    def rounding(self) -> float:
        """The rounding error of REAL32 values, MV units: of MV, and of PV and set-point by the gain."""
        return REAL32 * max(
            float(np.abs(each.mv).max())
            + each.gains.Kp * float(np.abs(each.pv).max() + (1.0 + abs(each.gains.b)) * np.abs(each.sp).max())
            for each in self.pieces
        )

    @property
    def quantum(self) -> float:
        """The standard deviation of the rounding errors of coarse values, MV units: of MV, and of PV by the gain."""
        mv, pv = (np.concatenate([getattr(each, name) for each in self.pieces]) for name in ("mv", "pv"))
        Kp = max(each.gains.Kp for each in self.pieces)
        return math.hypot(_resolution(mv), Kp * _resolution(pv)) / math.sqrt(12.0)

    def left(self, law_of: LawOf, shift: int = 0) -> Left:
        """What a law leaves; infinite where there is no such law.

        shift: the number of samples by which the recorded MV is later than the PV that it answers.
        """
        parts = self.differences(law_of, shift)
        if parts is None:
            return Left(math.inf, math.inf, 1.0)
        return Left(_rms(parts), _usual(parts), _inflation(parts))

    def response(self, law_of: LawOf, size: float) -> float:
        """How far MV moves for one unit of an alternative's size: the norm of the response, without the starts.

        size: the size in `law_of`, small.
        """
        parts = self._computed(law_of)
        said = self._computed(ControlLaw)
        if parts is None or said is None:
            return 0.0
        rest = [
            self._without_start(a - b, ControlLaw(piece.gains).poles(self.Ts))
            for a, b, piece in zip(parts, said, self.pieces, strict=True)
        ]
        return math.sqrt(sum(float(each @ each) for each in rest)) / size

    def differences(self, law_of: LawOf, shift: int = 0) -> list[Reals] | None:
        """Recorded less computed MV of each piece; None where there is no such law."""
        computed = self._computed(law_of)
        if computed is None:
            return None
        return [
            self._without_start(
                _shifted(piece.mv, -shift) - _shifted(each, shift), cast(ControlLaw, law_of(piece.gains)).poles(self.Ts)
            )
            for each, piece in zip(computed, self.pieces, strict=True)
        ]

    def _computed(self, law_of: LawOf) -> list[Reals] | None:
        found = []
        for each in self.pieces:
            law = law_of(each.gains)
            if law is None:
                return None
            found.append(law.output(each.sp, each.pv, self.Ts, self._reverse))
        return found

    def _without_start(self, column: Reals, poles: tuple[float, ...]) -> Reals:
        """A column without what the unknown start of its piece may have put there: a constant, and what dies away."""
        if not poles:
            return np.asarray(column - column.mean())
        key = len(column), poles
        if key not in self._starts:
            k = np.arange(len(column))
            with np.errstate(under="ignore"):
                columns = [np.ones(len(column)), *(np.power(pole, k) for pole in poles)]
            self._starts[key], _ = np.linalg.qr(np.stack(columns, axis=1))
        q = self._starts[key]
        return np.asarray(column - q @ (q.T @ column))


def _shifted(column: Reals, by: int) -> Reals:
    """A column of which the last samples are left out (by > 0), or the first ones (by < 0)."""
    return column[: len(column) - by] if by > 0 else column[-by:]


def _rms(parts: Sequence[Reals]) -> float:
    n = sum(map(len, parts))
    return math.sqrt(sum(float(each @ each) for each in parts) / n) if n else 0.0


def _usual(parts: Sequence[Reals]) -> float:
    """The rms without the samples that are the furthest away."""
    squares = np.sort(np.concatenate([np.square(each) for each in parts]))
    return math.sqrt(float(np.mean(squares[: max(math.floor((1.0 - FARTHEST) * len(squares)), 1)])))


def _inflation(parts: Sequence[Reals]) -> float:
    """By how much neighbours that are alike widen a variance: 2/d with the Durbin-Watson statistic d, at least 1."""
    whole = sum(float(each @ each) for each in parts)
    moves = 0.5 * sum(float(np.sum(np.diff(each) ** 2)) for each in parts)
    return max(whole / moves, 1.0) if moves > 0.0 else 1.0


def _resolution(column: Reals) -> float:
    """The steps in which a column is recorded; 0 where hardly a value comes twice."""
    values = np.unique(column)
    if len(values) < 2 or 2 * len(values) > len(column):
        return 0.0
    return float(np.diff(values).min())
