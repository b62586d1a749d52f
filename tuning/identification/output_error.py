"""Output-error fits of model structures to a whole record, with load disturbances at free times and a drift if
needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations_with_replacement
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.analysis.zero_order_hold import Pulses, pulses
from loopwright.tuning.identification.projection import REDUNDANT, Projection
from loopwright.tuning.identification.regressors import OwnColumns, PieceRows, Regressors
from loopwright.tuning.identification.structures import Structure
from loopwright.tuning.identification.variable_projection import LinearFit, SearchBounds, descend, solve
from loopwright.tuning.models import Reals, TransferFunction

FLOOR = 2e-4
"""Residual floor as a fraction of the range of PV; it prevents overfitting noise-free data."""
LOG_LOW, LOG_HIGH = -8.5, 9.5
"""Bounds of the logarithm of a rate in 1/period, and of the logarithm of a product of two rates in 1/period^2."""
DEAD_TIMES = (0.01, 0.06, 0.14, 0.23, 0.32, 0.41, 0.49)
LAGS = (0.02, 0.08, 0.25, 0.8, 4.0, 40.0)
COMPLEX = ((3.0, 0.5), (6.0, 0.5), (10.0, 0.3))
MAX_STEPS = 25
FIRST_STEPS, LONG_SEARCHES = 5, 2
"""Steps made from every start of many, and the number of searches that are then carried to the end."""
RELATIVE_DECREASE = 1e-6
LOG_STEP = 1e-4
MAX_LOG_STEP = 1.5
GRID_TOGETHER = 24
"""Points of the grid of starts that are evaluated at once where a record has many pieces, which bounds the memory."""


class RecordToFit(Protocol):
    """A record with the scales that the fit needs.

    Ts: the sample time, s.
    u, y: MV and PV as deviations from rest, shape (N,).
    u_earlier: MV as it was before each piece, as a deviation from the same rest, MV units, one array a piece; without
    them MV was 0.
    input_range, output_range: the scales of MV and PV, MV units and PV units.
    period: the time scale, in samples: about the period of an oscillation at the limit of stability.
    max_dead_time: the longest dead time, in samples.
    block: the number of samples that are averaged into one.
    pieces: the number of samples of each piece of the record, N together. Each of several pieces has a level of its own
    and begins in a state of its own.
    """

    @property
    def Ts(self) -> float: ...
    @property
    def u(self) -> Reals: ...
    @property
    def y(self) -> Reals: ...
    @property
    def u_earlier(self) -> Sequence[Reals]: ...
    @property
    def input_range(self) -> float: ...
    @property
    def output_range(self) -> float: ...
    @property
    def period(self) -> float: ...
    @property
    def max_dead_time(self) -> float: ...
    @property
    def block(self) -> int: ...
    @property
    def pieces(self) -> Sequence[int]: ...


S = TypeVar("S", bound=RecordToFit)


@dataclass(frozen=True, slots=True)
class DisturbanceHypothesis:
    """A disturbance hypothesis: what else than MV moved PV.

    load_disturbances: the number of step-shaped load disturbances, at times that are searched.
    drift: PV drifts at a steady rate.
    not_at_rest_initially: the plant was not at rest, or under a load, when the record began.
    """

    load_disturbances: int = 0
    drift: bool = False
    not_at_rest_initially: bool = False


UNDISTURBED = DisturbanceHypothesis()
NOT_AT_REST_INITIALLY = DisturbanceHypothesis(not_at_rest_initially=True)


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A structure fitted to a record under a disturbance hypothesis.

    theta: the searched parameters of the structure, then the times of the load disturbances, in samples.
    columns: the regressors at theta, averaged, shape (rows, columns).
    linear: the coefficients of the regressors and the residual, with MV in units of its range and PV in units of its.
    bic: the Bayesian information criterion.
    """

    structure: Structure
    hypothesis: DisturbanceHypothesis
    theta: Reals
    columns: Reals
    linear: LinearFit
    bic: float

    @property
    def rms(self) -> float:
        """The rms of the residual, as a fraction of the range of PV."""
        return math.sqrt(self.linear.rss / len(self.linear.residual))

    @property
    def parameters(self) -> int:
        """The number of fitted parameters."""
        return len(self.theta) + int(self.columns.shape[1])


def count(fit: Fitted) -> int:
    """The number of parameters that BIC counts: the time of a load disturbance was chosen among many and counts
    twice."""
    return fit.parameters + fit.hypothesis.load_disturbances


class Fit(Generic[S]):
    """The fits of one record. Time is in samples, MV in units of its range and PV in units of its range.

    Of each of several pieces, the samples at the end that fill no block are left out.
    """

    def __init__(self, record: S) -> None:
        self.record = record
        self.block = record.block
        self._kept, self.pieces = _whole_blocks(record.pieces, self.block)
        self.rows = [slice(piece.start // self.block, piece.stop // self.block) for piece in self.pieces]
        self._of_pieces = PieceRows([rows.stop - rows.start for rows in self.rows])
        self.u = record.u[self._kept] / record.input_range
        self._driving = self.lines(record.u, record.u_earlier)
        self.y = averaged(record.y[self._kept] / record.output_range, self.block)
        self.samples = len(self.y)
        self.period = record.period
        self._step = np.ones(len(self.u))
        self._longest = max(piece.stop - piece.start for piece in self.pieces)
        self._ramp = np.concatenate(
            [averaged(np.linspace(-1.0, 1.0, piece.stop - piece.start), self.block) for piece in self.pieces]
        )
        self._rate = math.log(1.0 / self.period)
        self._grids: dict[tuple[Structure, int, float | None, tuple[float, ...], bool], list[Reals]] = {}

    # what is fitted

    @property
    def starts_are_free(self) -> bool:
        """Whether every piece begins in a state of its own, under every disturbance hypothesis."""
        return len(self.pieces) > 1

    def lines(self, u: Reals, earlier: Sequence[Reals]) -> Reals:
        """Inputs in units of MV's range, one line for each piece, with zeros before it; shape (..., pieces, samples).

        u: MV units, shape (..., N). earlier: what they were before each piece, shape (..., samples) each.
        """
        whole, scale = u[..., self._kept], self.record.input_range
        before = earlier or [u[..., :0]] * len(self.pieces)
        longest = max(piece.stop - piece.start + e.shape[-1] for piece, e in zip(self.pieces, before, strict=True))
        found = np.zeros((*u.shape[:-1], len(self.pieces), longest))
        for i, (piece, e) in enumerate(zip(self.pieces, before, strict=True)):
            begin = longest - (piece.stop - piece.start)
            found[..., i, begin - e.shape[-1] : begin] = e / scale
            found[..., i, begin:] = whole[..., piece] / scale
        return found

    def answers(self, structure: Structure, theta: Reals, lines: Reals) -> Reals:
        """What the plant makes of several inputs, shape (inputs, rows, columns of the plant's input); lines as `lines`
        gives them."""
        plant = pulses(structure.monic(theta[None, : structure.searched]), theta[[structure.lags]], structure.order)
        found = [self._of_last_samples(plant.drive(lines, structure.zeros + 1)[0])]
        if structure.feed_through:
            found.append(self._of_last_samples(_delayed(lines, int(plant.delay[0]))[..., None]))
        return np.concatenate(found, axis=2)

    def first_load(self, structure: Structure, hypothesis: DisturbanceHypothesis) -> int:
        """The first linear coefficient of the load disturbances; each of them has as many as the structure's order."""
        return structure.inputs + len(self.pieces) * (1 + hypothesis.drift)

    def regressors(self, structure: Structure, hypothesis: DisturbanceHypothesis, thetas: Reals) -> Regressors:
        """The regressors of all linear parameters for each theta, which has a time for each load disturbance of the
        hypothesis."""
        many, order = len(thetas), structure.order
        loads, free = hypothesis.load_disturbances, self._start_is_free(hypothesis)
        driven, stepped = self._plants(structure, hypothesis, thetas)
        given = [self._of_last_samples(driven.drive(self._driving, structure.zeros + 1))]
        if structure.feed_through:
            given.append(self._fed_through(driven))
        moved = np.empty((0, 0, order))
        if loads or free:
            # a start ends with its piece
            steps = self._step if loads else self._step[: self._longest]
            moved = averaged(stepped.drive(steps), self.block, 1)
        loaded = [moved[k * many : (k + 1) * many] for k in range(loads)]
        started = moved[loads * many :]
        if self.starts_are_free:
            for k, load in enumerate(loaded):
                self._end_with_piece(load, thetas[:, structure.lags + 1 + k])
            own = self._own(hypothesis, started)
            return Regressors(np.concatenate((*given, *loaded), axis=2), own, self.places(structure, hypothesis))
        first = self.first_load(structure, hypothesis)
        out = np.empty((many, self.samples, first + order * (loads + free)))
        at = 0
        for columns in given:
            out[:, :, at : at + columns.shape[2]] = columns
            at += columns.shape[2]
        out[:, :, at] = 1.0
        if hypothesis.drift:
            out[:, :, at + 1] = self._ramp
        for k, columns in enumerate((*loaded, started)[: loads + free]):
            out[:, :, first + order * k : first + order * (k + 1)] = columns
        return Regressors(out)

    def sums(self, structure: Structure, hypothesis: DisturbanceHypothesis, thetas: Reals, linear: Reals) -> Reals:
        """The sums of the regressors for each theta with these linear coefficients, shape (thetas, columns), as shape
        (thetas, rows): one response of each plant is evaluated instead of all its states."""
        many, order, loads = len(thetas), structure.order, hypothesis.load_disturbances
        driven, stepped = self._plants(structure, hypothesis, thetas)
        of_states = linear[:, : structure.zeros + 1, None]
        found = self._of_last_samples(driven.summed(of_states).drive(self._driving))[..., 0]
        if structure.feed_through:
            found += linear[:, structure.zeros + 1, None] * self._fed_through(driven)[..., 0]
        level = structure.inputs + self._of_pieces.piece
        found += linear[:, level]
        if hypothesis.drift:
            found += linear[:, level + len(self.pieces)] * self._ramp
        further = linear[:, self.first_load(structure, hypothesis) :]
        if loads:
            of_loads = np.swapaxes(further[:, : loads * order].reshape(many, loads, order), 0, 1)
            loaded = stepped.of(slice(loads * many)).summed(of_loads.reshape(-1, order, 1))
            responses = averaged(loaded.drive(self._step), self.block, 1)
            if self.starts_are_free:
                self._end_with_piece(responses, thetas[:, structure.lags + 1 :].T.ravel())
            found += responses.reshape(loads, many, self.samples).sum(axis=0)
        if self._start_is_free(hypothesis):
            of_starts = np.swapaxes(further[:, loads * order :].reshape(many, len(self.pieces), order), 1, 2)
            started = stepped.of(slice(loads * many, None)).summed(of_starts)
            responses = averaged(started.drive(self._step[: self._longest]), self.block, 1)
            for equal in self._of_pieces.equal:
                lines = equal.lines(found[:, :, None])[..., 0]
                lines += np.swapaxes(responses[:, : equal.length, equal.pieces], 1, 2)
        return np.asarray(found)

    def _start_is_free(self, hypothesis: DisturbanceHypothesis) -> bool:
        """Whether each piece begins in a state of its own under this disturbance hypothesis."""
        return hypothesis.not_at_rest_initially or self.starts_are_free

    def _plants(self, structure: Structure, hypothesis: DisturbanceHypothesis, thetas: Reals) -> tuple[Pulses, Pulses]:
        """The pulse transfer functions from MV for each theta, and those from each load disturbance and from the
        start.

        A step at the start of a piece, to every state, represents any initial state and a load disturbance.
        """
        times = thetas[:, structure.lags :].T
        if self._start_is_free(hypothesis):
            times = np.append(times, np.zeros((1, len(thetas))), axis=0)
        monic = structure.monic(thetas)
        # one call serves MV and every load disturbance, as call overhead dominates
        monics = np.tile(monic, (len(times), 1)) if len(times) > 1 else monic
        found = pulses(monics, times.ravel(), structure.order)
        return found.of(slice(len(thetas))), found.of(slice(len(thetas), None))

    def _fed_through(self, driven: Pulses) -> Reals:
        """MV with the dead time of each plant, averaged, shape (plants, rows, 1)."""
        delayed = np.array([_delayed(self._driving, late) for late in driven.delay.tolist()])
        return self._of_last_samples(delayed[..., None])

    def _own(self, hypothesis: DisturbanceHypothesis, started: Reals) -> tuple[Reals, ...]:
        """The level, the slope where PV drifts, and the start of each of several pieces, as `Regressors.own`."""
        found = []
        for equal in self._of_pieces.equal:
            begun = started[:, : equal.length]
            own = np.empty((*begun.shape[:2], 1 + hypothesis.drift + begun.shape[2]))
            own[:, :, 0] = 1.0
            if hypothesis.drift:
                own[:, :, 1] = self._ramp[equal.rows.start : equal.rows.start + equal.length]
            own[:, :, 1 + hypothesis.drift :] = begun
            found.append(own)
        return tuple(found)

    def places(self, structure: Structure, hypothesis: DisturbanceHypothesis) -> OwnColumns:
        """Which of the regressors belong to one of several pieces: its level, its slope where PV drifts, and its
        start."""
        pieces, order = len(self.pieces), structure.order
        loads = self.first_load(structure, hypothesis) + np.arange(order * hypothesis.load_disturbances)
        starts = self.first_load(structure, hypothesis) + len(loads) + np.arange(order * pieces).reshape(pieces, order)
        levels = structure.inputs + np.arange(pieces)[:, None] + pieces * np.arange(1 + hypothesis.drift)
        common = np.concatenate((np.arange(structure.inputs), loads))
        return OwnColumns(self._of_pieces, common, np.concatenate((levels, starts), axis=1))

    def _of_last_samples(self, lines: Reals) -> Reals:
        """The averages of the last samples of each piece's line, as many as the piece has, in the rows of the record.

        lines: shape (plants, pieces, samples, signals). Returned: shape (plants, rows, signals).
        """
        last = averaged(lines[:, :, lines.shape[2] - self._longest :], self.block, 2)
        return self._of_pieces.of_ends(last)

    def _end_with_piece(self, responses: Reals, times: Reals) -> None:
        """Ends the responses to load disturbances, shape (plants, rows, states), with the piece that each begins in."""
        ends = np.array([rows.stop for rows in self.rows])
        begun = np.searchsorted([piece.stop for piece in self.pieces], times, side="right")
        for response, end in zip(responses, ends[np.minimum(begun, len(ends) - 1)], strict=True):
            response[end:] = 0.0

    def fitted(self, structure: Structure, hypothesis: DisturbanceHypothesis, theta: Reals) -> Fitted:
        """The fit at this theta: the linear parameters by least squares."""
        columns = self.regressors(structure, hypothesis, theta[None]).dense()[0]
        linear = solve(columns, self.y)
        # the time of a load disturbance was chosen among many: it counts twice
        parameters = len(theta) + columns.shape[1] + hypothesis.load_disturbances
        penalty = parameters * math.log(self.samples)
        if self.starts_are_free:
            # the start and the slope of each piece are of no interest: they count by what chance makes of them (AIC)
            penalty -= (structure.order + hypothesis.drift) * len(self.pieces) * (math.log(self.samples) - 2.0)
        bic = self.samples * math.log(linear.rss / self.samples + FLOOR**2) + penalty
        return Fitted(structure, hypothesis, theta, columns, linear, bic)

    def search(
        self,
        structure: Structure,
        hypothesis: DisturbanceHypothesis,
        starts: Sequence[Reals],
        max_steps: int = MAX_STEPS,
    ) -> Fitted:
        """The best local minimum from these starts."""
        if len(starts) > LONG_SEARCHES:
            starts = self._descend(structure, hypothesis, starts, FIRST_STEPS)[:LONG_SEARCHES]
        return self.fitted(structure, hypothesis, self._descend(structure, hypothesis, starts, max_steps)[0])

    def descended(
        self, structure: Structure, hypothesis: DisturbanceHypothesis, starts: Sequence[Reals], steps: int
    ) -> list[Fitted]:
        """The fits that are reached from each start in this number of steps, the best first."""
        return [self.fitted(structure, hypothesis, at) for at in self._descend(structure, hypothesis, starts, steps)]

    def _descend(
        self, structure: Structure, hypothesis: DisturbanceHypothesis, starts: Sequence[Reals], max_steps: int
    ) -> list[Reals]:
        low, high = self.bounds(structure, hypothesis)
        times = 1 + hypothesis.load_disturbances
        max_step = np.append(np.full(structure.lags, MAX_LOG_STEP), np.full(times, 0.25 * self.period))
        step = np.append(np.full(structure.lags, LOG_STEP), np.full(times, LOG_STEP * self.period))

        regressors = partial(self.regressors, structure, hypothesis)
        sums = partial(self.sums, structure, hypothesis)
        bounded = SearchBounds(low, high, max_step, step)
        found, rss = descend(regressors, self.y, np.array(starts), bounded, max_steps, RELATIVE_DECREASE, sums)
        return [found[i] for i in np.argsort(rss, kind="stable")]

    def bounds(self, structure: Structure, hypothesis: DisturbanceHypothesis) -> tuple[Reals, Reals]:
        """The lower and the upper bounds of theta."""
        powers = np.array([1.0, 2.0, 1.0][: structure.lags])
        low = np.concatenate((LOG_LOW + powers * self._rate, np.zeros(1 + hypothesis.load_disturbances)))
        high = np.concatenate((LOG_HIGH + powers * self._rate, [self.record.max_dead_time]))
        return low, np.append(high, np.full(hypothesis.load_disturbances, len(self.u) - 2.0 * self.block))

    # where to begin

    def denominators(self, structure: Structure) -> list[Reals]:
        """The logarithms of the rates on the grid of starts."""
        unit = self.period
        if structure.lags == 0:
            return [np.empty(0)]
        if structure.lags == 1:
            return [np.log([1.0 / (T * unit)]) for T in LAGS]
        if structure.lags == 3:
            return [
                np.log([1.0 / T1 + 1.0 / T2, 1.0 / (T1 * T2), 1.0 / T3])
                for T3, T2, T1 in combinations_with_replacement(np.multiply(LAGS, unit), 3)
            ]
        pairs = [(T1 * unit, T2 * unit) for i, T1 in enumerate(LAGS) for T2 in LAGS[: i + 1]]
        real = [np.log([1.0 / T1 + 1.0 / T2, 1.0 / (T1 * T2)]) for T1, T2 in pairs]
        return real + [np.log([2.0 * zeta * w / unit, (w / unit) ** 2]) for w, zeta in COMPLEX]

    def grid(
        self,
        structure: Structure,
        keep: int,
        load_at: float | None = None,
        dead_times: Sequence[float] = DEAD_TIMES,
        drift: bool = False,
    ) -> list[Reals]:
        """The `keep` best distinct theta of a grid, best first. Several disturbance hypotheses begin with one grid.

        load_at: each theta has one load disturbance at this sample, None for none.
        dead_times: the dead times of the grid, in periods.
        drift: whether PV drifts; it counts where a record has several pieces, whose slopes move PV more than its model.
        """
        asked = structure, keep, load_at, tuple(dead_times), drift and self.starts_are_free
        if asked not in self._grids:
            self._grids[asked] = self._best_of_grid(*asked)
        return self._grids[asked]

    def _best_of_grid(
        self, structure: Structure, keep: int, load_at: float | None, dead_times: Sequence[float], drift: bool
    ) -> list[Reals]:
        thetas = [
            np.append(logs, max(L, 0.0) * self.period) for logs in self.denominators(structure) for L in dead_times
        ]
        hypothesis = DisturbanceHypothesis(load_disturbances=int(load_at is not None), drift=drift)
        if load_at is not None:
            thetas = [np.append(theta, load_at) for theta in thetas]
        together = GRID_TOGETHER if self.starts_are_free else len(thetas)
        parts = [np.array(thetas[i : i + together]) for i in range(0, len(thetas), together)]
        rss = np.concatenate([self._sums_of_squares_left(structure, hypothesis, part) for part in parts])
        return self.distinct([thetas[i] for i in np.argsort(rss)], structure, keep)

    def _sums_of_squares_left(self, structure: Structure, hypothesis: DisturbanceHypothesis, thetas: Reals) -> Reals:
        regressors = self.regressors(structure, hypothesis, thetas)
        if regressors.places is not None:
            return Projection.of(regressors, self.y).rss
        return sums_of_squares_left(regressors.common, self.y)

    def distinct(self, ranked: Sequence[Reals], structure: Structure, keep: int) -> list[Reals]:
        """The first `keep` of the ranked theta that are not close to an earlier one."""
        kept: list[Reals] = []
        for theta in ranked:
            if all(self._differ(theta, other, structure.lags) for other in kept):
                kept.append(theta)
                if len(kept) == keep:
                    break
        return kept

    def _differ(self, a: Reals, b: Reals, lags: int) -> bool:
        apart = np.abs(a - b)
        return bool(np.any(apart[:lags] > 1.0) or np.any(apart[lags:] > 0.05 * self.period))

    # what it means

    def static_gain(self, fit: Fitted) -> float:
        """The static gain, in ranges of PV per range of MV; the slope per sample where the plant integrates."""
        structure, c = fit.structure, fit.linear.coefficients
        gain = float(c[0] / structure.slowest(fit.theta))
        if structure.feed_through:
            gain += float(c[structure.zeros + 1])
        return gain

    def model(self, fit: Fitted) -> TransferFunction:
        """The fitted model in s and the units of the record."""
        return self.transfer(fit.structure, fit.theta, fit.linear.coefficients)

    def transfer(self, structure: Structure, theta: Reals, coefficients: Reals) -> TransferFunction:
        """The model of these parameters in s and the units of the record. Only the coefficients of the plant's input
        are used."""
        record = self.record
        Ts, unit = record.Ts, record.output_range / record.input_range
        order = structure.order
        monic = structure.monic(theta[: structure.searched])
        den = np.append(1.0, monic) * Ts ** -np.arange(order + 1.0)
        b = coefficients[: structure.zeros + 1]
        num = np.zeros(order + 1)
        # the i-th state is s^i/den with s counted in samples
        for i, value in enumerate(b):
            num[order - i] = unit * value * Ts ** (i - order)
        if structure.feed_through:
            num += unit * coefficients[structure.zeros + 1] * den
        return TransferFunction(tuple(num), tuple(den), max(float(theta[structure.lags]), 0.0) * Ts)


def sums_of_squares_left(columns: Reals, y: Reals) -> Reals:
    """The residual sums of squares of y by each set of columns, shape (sets,).

    columns: shape (sets, N, columns).
    y: shape (N,).
    """
    lengths = np.sqrt(np.einsum("bij,bij->bj", columns, columns))
    lengths[lengths == 0.0] = 1.0
    turned = np.swapaxes(columns / lengths[:, None, :], 1, 2)
    gram = turned @ np.swapaxes(turned, 1, 2) + REDUNDANT * np.eye(columns.shape[2])
    along = turned @ y
    weights = np.linalg.solve(gram, along[:, :, None])[:, :, 0]
    return np.asarray(y @ y - np.einsum("bi,bi->b", weights, along))


def _whole_blocks(lengths: Sequence[int], block: int) -> tuple[slice | NDArray[np.int64], tuple[slice, ...]]:
    """The samples of the pieces that fill whole blocks, and the place of each piece among these samples.

    A record of one piece keeps all samples; `averaged` leaves out those that fill no block.
    """
    if len(lengths) == 1:
        return slice(None), (slice(0, lengths[0]),)
    ends = np.cumsum(lengths)
    whole = [length // block * block for length in lengths]
    kept = [np.arange(end - length, end - length + w) for end, length, w in zip(ends, lengths, whole, strict=True)]
    stops = np.cumsum(whole)
    return np.concatenate(kept), tuple(slice(int(stop - w), int(stop)) for stop, w in zip(stops, whole, strict=True))


def _delayed(lines: Reals, late: int) -> Reals:
    """Inputs, shape (..., samples), a sample and the whole samples of a dead time later."""
    found = np.zeros(lines.shape)
    found[..., late + 1 :] = lines[..., : max(lines.shape[-1] - late - 1, 0)]
    return found


def averaged(columns: Reals, block: int, axis: int = 0) -> Reals:
    """The means of `block` rows each along the axis; rows that fill no block at the end are dropped."""
    if block == 1:
        return columns
    before, rows, after = columns.shape[:axis], columns.shape[axis] // block, columns.shape[axis + 1 :]
    kept = columns[(slice(None),) * axis + (slice(rows * block),)]
    return np.asarray(kept.reshape(*before, rows, block, *after).mean(axis=axis + 1))
