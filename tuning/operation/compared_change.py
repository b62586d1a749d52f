"""One set-point change, or load, of operation compared with what the accepted model says.

The model is driven with the MV recorded; what is not known of it, a level, a trend of PV and a start that was not at
rest are fitted beside. Alternatives to the model are named: another gain, a longer dead time, a second path that acts
later. Each has one parameter more, so that its size and standard deviation follow by a projection, as in a score test.
Source: the Lagrange multiplier test, C. R. Rao, Proc. Cambridge Phil. Soc. 44, 1948; what is known of the model
beforehand enters as further rows of the least squares, the mixed estimation of H. Theil, A. S. Goldberger, Int. Econ.
Rev. 2, 1961.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopwright.tuning.fast.design.uncertainty import durbin_watson_ratio
from loopwright.tuning.fast.evaluation.evaluation import NEGLIGIBLE_RESIDUAL
from loopwright.tuning.fast.record import noise_of
from loopwright.tuning.identification.output_error import averaged
from loopwright.tuning.models import Reals, TransferFunction
from loopwright.tuning.operation.accepted_model import AcceptedModel, answers_to_step, driven
from loopwright.tuning.operation.change_findings import ChangeState, ComparedChange, DifferenceKind, OtherPlant
from loopwright.tuning.operation.history import Stretch

BEFORE, AFTER = 1.0, 10.0
"""Ultimate periods before and after its first move in which a change is compared: a second path that acts eight of
them later still shows."""
MV_BEFORE = 10.0
"""Ultimate periods before that from which MV is taken, where it is known: what it did then may act later."""
ROWS_PER_PERIOD = 40
"""Averages of the samples in an ultimate period."""
PATHS = tuple(0.125 * n for n in range(4, 69))
"""Delays of a second path that are looked for, in ultimate periods; the best of them are then refined."""
BASINS, REFINED = 3, (0.0625, 0.03125, 0.015625)
"""Number of the best ones that are, and the steps by which they are refined, in ultimate periods."""
SEEN_AFTER = 1.5
"""Ultimate periods of a change in which a second path must have acted before its share is known."""
LATER = 0.02
"""By how much the dead time is made longer for its sensitivity, in ultimate periods."""
MAX_RESIDUAL = 1.5
"""Largest residual of a change, in standard deviations of the noise, that the model explains."""
MIN_AT_REST = 10
"""Averages before the change from which the noise at rest is estimated."""
EXPLAINED, NOISE_KNOWN = 0.75, 1.2
"""Smallest part of what the model leaves beyond the noise that an alternative explains, and the factor to which the
noise is known: a load that wanders is explained by none."""
NEARLY_ALL = 0.2
"""Largest residual with an alternative, as a part of that without it, which it explains in any case."""
NEARLY_BEST = 1.12
"""Largest residual of an alternative that a change shows, as a ratio to that of the one that explains it best."""
CLEAR = 4.0
"""Size of an alternative, in its standard deviations, from which it is shown by a change."""
MATTERS = 0.2
"""Change of Ms from which an alternative matters."""
WELL_KNOWN = 0.08
"""Largest standard deviation of the gain, and of the share of a second path, as a fraction of the gain, with which a
change can confirm the model."""
UNSEEN = 1e-9
"""Singular value, of columns of unit length, below which a direction does not show."""
UNKNOWN = 1e9
"""Standard deviation of what a change does not show."""
DEAD_TIME_STEPS = 4
"""Steps in which the further dead time is found."""
LOAD_SPACING = 0.25
"""Distance of the times at which a step of the load is looked for, in ultimate periods."""


def compare_change(
    model: AcceptedModel, stretch: Stretch, move: int, end: int, by_load: bool = False
) -> ComparedChange:
    """Compares a change of a stretch with the model.

    move, end: the samples at which the change begins, and until which it is looked at.
    by_load: whether a load has moved PV, and not the set-point. A step of it is then part of what is fitted; where
    that does not do, the load was not a step, which tells nothing of the plant.
    """
    return _Comparison(model, stretch, move, end, by_load).compared()


class _Comparison:
    """The least squares of one change; PV is in standard deviations of its noise."""

    def __init__(self, model: AcceptedModel, stretch: Stretch, move: int, end: int, by_load: bool) -> None:
        self._model, self._Ts = model, stretch.Ts
        per_period = model.period_s / stretch.Ts
        self._block = max(1, round(per_period / ROWS_PER_PERIOD))
        first = max(move - round(BEFORE * per_period), 0)
        self._skip = first - max(first - round(MV_BEFORE * per_period), 0)
        mv = stretch.mv[first - self._skip : end]
        self._u = mv - float(np.median(mv[: self._skip + move - first + 1]))
        pv = averaged(stretch.pv[first:end] - stretch.pv[first], self._block)
        self._rows = len(pv)
        sp = stretch.sp[max(move - 1, 0) : end]
        self._size = float(np.max(np.abs(sp - sp[0])))
        rest = averaged(stretch.pv[first:move], self._block)
        fast = float(np.sqrt(np.mean(np.diff(pv, 2) ** 2) / 6.0))  # what is left of PV without its slow changes
        noise = max(noise_of(rest), fast) if len(rest) >= MIN_AT_REST else fast
        self._noise = math.hypot(noise, NEGLIGIBLE_RESIDUAL / MAX_RESIDUAL * float(np.ptp(pv))) or 1.0
        self._length_s = (end - move) * stretch.Ts
        nominal = self._answer(model.plant)
        self._nominal = nominal
        unknown = [(self._answer(plant) - nominal) / distance for plant, distance in model.neighbours()]
        t = np.linspace(-1.0, 1.0, self._rows)
        starts = averaged(answers_to_step(model.plant, end - first, stretch.Ts), self._block)
        self._states = starts
        self._free = np.column_stack((np.ones(self._rows), t, starts))
        self._known = np.column_stack(unknown) if unknown else np.zeros((self._rows, 0))
        self._left = pv / self._noise - nominal
        self._by_load = by_load
        if by_load:
            self._free = np.column_stack((self._free, self._load()))

    def compared(self) -> ComparedChange:
        base = _Solved.of(self._free, self._known, self._left)
        alternatives = _nearly_best(self._alternatives(base))
        gain = alternatives[0]
        paths = [each for each in alternatives if each.kind is DifferenceKind.SECOND_PATH]
        known = gain.deviation < WELL_KNOWN and all(each.deviation < WELL_KNOWN for each in paths)
        residual = base.residual
        if any(each.clear for each in alternatives):
            state = ChangeState.DISTURBED if self._by_load else ChangeState.DIFFERS
        elif residual > MAX_RESIDUAL:
            state = ChangeState.DISTURBED
        else:
            state = ChangeState.CONFIRMED if known and paths else ChangeState.NOT_ENOUGH
        load = self._by_load
        if residual > MAX_RESIDUAL and not load:
            with_load = np.column_stack((self._free, self._load()))
            load = _Solved.of(with_load, self._known, self._left).residual <= MAX_RESIDUAL
        size = 0.0 if self._by_load else self._size
        kept = tuple(each for each in alternatives if each.clear or each.kind is not DifferenceKind.SECOND_PATH)
        return ComparedChange(state, size, residual, load, kept)

    def _alternatives(self, base: _Solved) -> list[OtherPlant]:
        model, period = self._model, self._model.period_s
        shown = [self._shown(base, DifferenceKind.GAIN, 0.0, *base.further(self._nominal))]
        shown.append(self._shown(base, DifferenceKind.DEAD_TIME, 0.0, *self._later(base)))
        for delay in PATHS:
            delay_s = delay * period
            if delay_s + model.plant.L > self._length_s - SEEN_AFTER * period:
                break
            shown.append(self._path(base, delay_s))
        paths = shown[2:]
        lowest = [
            each
            for n, each in enumerate(paths)
            if all(each.residual <= other.residual for other in paths[max(n - 1, 0) : n + 2])
        ]
        for best in sorted(lowest, key=lambda each: each.residual)[:BASINS]:
            for step in REFINED:
                around = [self._path(base, best.delay_s + side * step * period) for side in (-1.0, 1.0)]
                best = min(best, *around, key=lambda each: each.residual)
            shown.append(best)
        return shown

    def _path(self, base: _Solved, delay_s: float) -> OtherPlant:
        found = base.further(self._answer(self._model.plant, delay_s))
        return self._shown(base, DifferenceKind.SECOND_PATH, delay_s, *found)

    def _later(self, base: _Solved) -> tuple[float, float, float, float]:
        """The further dead time, s, as `further` has it. PV is not linear in it: it is found by a few steps."""
        plant, step = self._model.plant, LATER * self._model.period_s
        total, deviation, residual, left = 0.0, UNKNOWN, base.residual, base.squares
        for _ in range(DEAD_TIME_STEPS):
            now = self._answer(plant, total)
            column = (self._answer(plant, total + step) - now) / step
            solved = _Solved.of(self._free, self._known, self._left + self._nominal - now)
            size, deviation, residual, left = solved.further(column)
            if deviation >= UNKNOWN:
                break
            longest = 0.25 * self._model.period_s
            total = max(total + min(max(size, -longest), longest), -plant.L)
        return total, deviation, residual, left

    def _shown(
        self,
        base: _Solved,
        kind: DifferenceKind,
        delay_s: float,
        size: float,
        deviation: float,
        residual: float,
        left: float,
    ) -> OtherPlant:
        Ms = self._model.Ms()
        if kind is DifferenceKind.GAIN:
            found = self._model.Ms(gain=max(1.0 + size, 0.0))
        elif kind is DifferenceKind.DEAD_TIME:
            found = self._model.Ms(later_s=size)
        else:
            found = self._model.Ms(share=size, path_s=delay_s)
        beyond_noise = base.squares - NOISE_KNOWN**2 * self._rows
        enough = base.squares - left >= EXPLAINED * beyond_noise
        fits = enough and residual <= max(MAX_RESIDUAL, NEARLY_ALL * base.residual)
        clear = fits and abs(size) > CLEAR * deviation and abs(found - Ms) > MATTERS
        return OtherPlant(kind, delay_s, size, deviation, residual, found, clear)

    def _load(self) -> Reals:
        """What one step of the load makes of the states at the time at which it explains most, shape (rows, order)."""
        spacing = max(1, round(LOAD_SPACING * self._model.period_s / self._Ts / self._block))
        best, found = math.inf, self._states
        for at in range(0, self._rows - 2 * self._states.shape[1], spacing):
            load = np.zeros_like(self._states)
            load[at:] = self._states[: self._rows - at]
            residual = _Solved.of(np.column_stack((self._free, load)), self._known, self._left).residual
            if residual < best:
                best, found = residual, load
        return found

    def _answer(self, plant: TransferFunction, further_s: float = 0.0) -> Reals:
        answer = driven(plant, self._u, self._Ts, further_s)[self._skip :]
        return np.asarray(averaged(answer, self._block) / self._noise)


def _nearly_best(alternatives: Sequence[OtherPlant]) -> list[OtherPlant]:
    """The alternatives, of which those that explain clearly less than the best one are no longer called clear."""
    best = min((each.residual for each in alternatives if each.clear), default=0.0)
    return [replace(each, clear=each.clear and each.residual <= NEARLY_BEST * best) for each in alternatives]


class _Solved:
    """A least squares solution: what is free, what is known beforehand to a standard deviation, and what is left.

    rows: the number of rows of PV; what is known beforehand follows after them.
    """

    def __init__(self, basis: Reals, left: Reals, rows: int) -> None:
        self._basis, self._rows = basis, rows
        self._left = left - basis @ (basis.T @ left)
        self.residual = float(np.sqrt(np.mean(self._left[:rows] ** 2)))
        self.squares = float(self._left @ self._left)

    @classmethod
    def of(cls, free: Reals, known: Reals, left: Reals) -> _Solved:
        """free, known: columns, shape (rows, any). left: PV less what the model says, shape (rows,)."""
        rows, further = len(left), known.shape[1]
        columns = np.zeros((rows + further, free.shape[1] + further))
        columns[:rows] = np.column_stack((free, known))
        columns[rows:, free.shape[1] :] = np.eye(further)
        lengths = np.linalg.norm(columns, axis=0)
        basis, singular, _ = np.linalg.svd(columns[:, lengths > 0.0] / lengths[lengths > 0.0], full_matrices=False)
        return cls(basis[:, singular > UNSEEN * singular[0]], np.append(left, np.zeros(further)), rows)

    def further(self, column: Reals) -> tuple[float, float, float, float]:
        """The coefficient of one column more, its standard deviation, the rms of what is then left of PV, and the sum
        of squares of all that is left."""
        whole = np.append(column, np.zeros(len(self._left) - self._rows))
        apart = whole - self._basis @ (self._basis.T @ whole)
        power = float(apart @ apart)
        if power <= UNSEEN * float(column @ column):
            return 0.0, UNKNOWN, self.residual, self.squares
        size = float(apart @ self._left) / power
        whole = self._left - size * apart
        left = whole[: self._rows]
        residual = float(np.sqrt(np.mean(left**2)))
        variance = max(residual, 1.0) ** 2 * durbin_watson_ratio(left)
        return size, min(math.sqrt(variance / power), UNKNOWN), residual, float(whole @ whole)
