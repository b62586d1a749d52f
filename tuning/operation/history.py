"""The history of a loop in automatic, and the set-point changes in it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Reason, Refused

MAX_MOVED = 0.2
"""Largest fraction of the samples at which the set-point of an operator moves."""
MIN_MOVES_OF_ANOTHER = 50
"""Smallest number of moves of the set-point that can be another controller's."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A stretch of normal operation: in automatic, under the same gains, without a gap, evenly sampled.

    t_s: the time of the first sample, s. Ts: the sample time, s.
    mv, pv, sp: MV, PV and set-point at each sample, in their units, shape (N,).
    gains: the gains in effect.
    held_s: the time for which the controller holds MV, s, where it is another one than the sample time: of means of
    many samples. None where it is not.
    """

    t_s: float
    Ts: float
    mv: Reals
    pv: Reals
    sp: Reals
    gains: Gains
    held_s: float | None = None

    @property
    def moves(self) -> tuple[int, ...]:
        """The samples at which the set-point is another one than before."""
        return tuple(int(k) + 1 for k in np.flatnonzero(np.diff(self.sp)))


@dataclass(frozen=True, slots=True, eq=False)
class SetpointChange:
    """One set-point change with what followed.

    stretch: the stretch that it belongs to.
    first, move, end: the samples from which, at which and until which the change is looked at.
    """

    stretch: Stretch
    first: int
    move: int
    end: int

    @property
    def t_s(self) -> float:
        """The time of the change, s."""
        return self.stretch.t_s + self.move * self.stretch.Ts

    @property
    def samples(self) -> slice:
        """The samples of the change within its stretch."""
        return slice(self.first, self.end)

    @property
    def size(self) -> float:
        """The largest deviation of the set-point from before the change, PV units."""
        sp = self.stretch.sp
        return float(np.max(np.abs(sp[self.move : self.end] - sp[self.move - 1])))


@dataclass(frozen=True, slots=True, eq=False)
class HistoryPart:
    """A part of a stretch, as deviations from a value at rest.

    stretch: the stretch that it belongs to.
    samples: the samples of the part within the stretch.
    before: those of them before anything moves.
    """

    stretch: Stretch
    samples: slice
    before: slice

    def deviations(self, columns: Reals) -> Reals:
        """This part of a column of the stretch, or of several, shape (..., N), less its value before anything moves."""
        return np.asarray(columns[..., self.samples] - self._rest(columns))

    def deviations_before(self, columns: Reals, length: int) -> Reals:
        """The deviations of the samples before this part, so many at most."""
        first = self.samples.start
        return np.asarray(columns[..., max(first - length, 0) : first] - self._rest(columns))

    def _rest(self, columns: Reals) -> Reals:
        """The value before anything moves, one of those of the column: the deviations keep their resolution."""
        rest = np.sort(columns[..., self.before], axis=-1)
        return np.asarray(rest[..., rest.shape[-1] // 2, None])


def require_operator(stretches: list[Stretch]) -> None:
    """Raises Refused, SETPOINT_IS_DRIVEN, where the set-point moves at so many samples that it is not an operator's."""
    moves, samples = sum(len(each.moves) for each in stretches), sum(len(each.sp) for each in stretches)
    if moves > MAX_MOVED * samples and moves >= MIN_MOVES_OF_ANOTHER:
        text = f"the set-point moves at {moves} of {samples} samples, so another controller drives it"
        raise Refused(Reason.SETPOINT_IS_DRIVEN, f"{text}; what such a loop does tells little of its plant by itself")


def setpoint_changes(stretch: Stretch, before: int, after: int, smallest: float) -> list[SetpointChange]:
    """The set-point changes of a stretch that can be looked at whole.

    before, after: the numbers of samples of a change before and after its first move. Moves within `after` samples
    belong to the same change.
    smallest: the size of the smallest change that is looked at, PV units.
    """
    found: list[SetpointChange] = []
    last = -1
    for move in stretch.moves:
        if last >= 0 and move < last:
            continue
        first, end = max(move - before, last, 0), move + after
        if move - first < before // 2 or end > len(stretch.sp):
            continue
        change = SetpointChange(stretch, first, move, end)
        if change.size >= smallest:
            found.append(change)
            last = end
    return found


def parts_at_rest(stretch: Stretch, length: int, after: int) -> list[slice]:
    """The parts of this length in which the set-point rests, and had rested for `after` samples before."""
    edges = [-after, *stretch.moves, len(stretch.sp)]
    found = []
    for begin, end in pairwise(edges):
        first = max(begin + after, 0)
        found += [slice(at, at + length) for at in range(first, end - length + 1, length)]
    return found
