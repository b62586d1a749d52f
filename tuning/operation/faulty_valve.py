"""A faulty valve in normal operation: the fault that the record shows, and those that it does not exclude.

The valve is followed through the whole of each stretch, not from the start of each part of the record: where it stands
as a part begins depends on how MV moved before.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.score_tests import STANDARD_DEVIATIONS, ScoreTests
from loopwright.tuning.fast.score_tests.valve_faults import FAULTS, Fault, backlash, stiction
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.models import Reals, TransferFunction
from loopwright.tuning.operation.history import HistoryPart

SMALLEST, LARGEST = 0.005, 0.1
"""Sizes of a fault that are tried, as fractions of the largest deviation of MV."""
RATIOS: dict[Fault, float] = {backlash: 1.05, stiction: 1.01}
"""Ratio of each size to the one before. The times at which a valve that sticks jumps show its stiction sharply."""
BEST, FINER = 8, 10
"""How many of these sizes are tried again with their neighbours, and the number of those on either side."""
TOGETHER = 50
"""Number of sizes for which a valve is followed at once, which bounds the memory."""
SMALL = {backlash: (0.005, 0.01, 0.015), stiction: (0.01, 0.02, 0.03)}
"""Sizes of a fault, as fractions of the largest deviation of MV, that a sound valve may have. They change Ms where MV
moves little. A valve with backlash stands still for twice its size when MV turns."""
STEPS = 10


@dataclass(frozen=True, slots=True, eq=False)
class FaultyValve:
    """A valve with a fault.

    size: the size of the fault, in MV units.
    chi_squared_decrease: by how much chi-squared of the residual would be smaller, by the score test of the fault.
    u, u_earlier: the position of the valve in the record and before each piece, as `ExperimentRecord`.
    """

    fault: Fault
    size: float
    chi_squared_decrease: float
    u: Reals
    u_earlier: tuple[Reals, ...]

    @property
    def clear(self) -> bool:
        """Whether the score test is beyond chance."""
        return self.chi_squared_decrease > STANDARD_DEVIATIONS**2

    @property
    def in_words(self) -> str:
        """The fault with its size."""
        return FAULTS[self.fault][1].format(self.size)


def likeliest_fault(fit: Fit[ExperimentRecord], best: Fitted, parts: Sequence[HistoryPart]) -> FaultyValve | None:
    """The fault whose score test speaks for it most clearly, None where none does.

    parts: those of the record, in its order.
    """
    tests, record = ScoreTests(fit, best), fit.record

    def scored(fault: Fault, sizes: Reals) -> Iterator[tuple[float, Fault, float]]:
        for some, u, u_earlier in _positions(record, parts, fault, sizes):
            before = [each - mv for each, mv in zip(u_earlier, record.u_earlier, strict=True)]
            shares, deviations = tests.scores(u - record.u, before)
            for share, deviation, size in zip(shares.tolist(), deviations.tolist(), some.tolist(), strict=True):
                yield (2.0 * share - 1.0) / deviation**2, fault, size

    found: list[tuple[float, Fault, float]] = []
    for fault, ratio in RATIOS.items():
        count = math.ceil(math.log(LARGEST / SMALLEST, ratio))
        found += scored(fault, np.asarray(record.input_range * SMALLEST * ratio ** np.arange(count)))
    near = RATIOS[stiction] ** (np.arange(-FINER, FINER + 1) / FINER)
    best_ones = heapq.nlargest(BEST, found, key=itemgetter(0))
    for fault in RATIOS:
        found += scored(fault, np.outer([size for _, its, size in best_ones if its is fault], near).ravel())
    largest, fault, size = max(found, key=itemgetter(0))
    ((_, u, u_earlier),) = _positions(record, parts, fault, np.array([size]))
    return FaultyValve(fault, size, largest, u[0], tuple(each[0] for each in u_earlier)) if largest > 0.0 else None


def models_of_small_faults(
    fit: Fit[ExperimentRecord], best: Fitted, parts: Sequence[HistoryPart], likeliest: FaultyValve | None
) -> Iterator[TransferFunction]:
    """The models of the plant where the valve moves a little less than MV and the record does not exclude that.

    A valve that follows or sticks by a few hundredths of MV's largest deviation leaves hardly a trace in a record that
    moves MV little, and makes the plant seem weaker than it is. It is excluded where it raises BIC by MIN_BIC_GAIN, as
    much as it would have to lower BIC to be believed.
    """
    for fault, sizes in SMALL.items():
        theta = best.theta
        inputs: list[tuple[Reals, tuple[Reals, ...]]] = []
        for some, u, before in _positions(fit.record, parts, fault, fit.record.input_range * np.array(sizes)):
            inputs += [(u[i], tuple(each[i] for each in before)) for i in range(len(some))]
        if likeliest is not None and likeliest.fault is fault:
            inputs.append((likeliest.u, likeliest.u_earlier))
        for u, u_earlier in inputs:
            moved = Fit(replace(fit.record, u=u, u_earlier=u_earlier))
            found = moved.search(best.structure, best.hypothesis, [theta], STEPS)
            theta = found.theta
            if found.bic < best.bic + MIN_BIC_GAIN:
                yield moved.model(found)


def _positions(
    record: ExperimentRecord, parts: Sequence[HistoryPart], fault: Fault, sizes: Reals
) -> Iterator[tuple[Reals, Reals, list[Reals]]]:
    """Some of the sizes after others, with the positions of such valves in these parts of the record, shape (sizes, N),
    and before each part; a stretch begins with the valve where MV is."""
    stretches = {id(each.stretch): each.stretch for each in parts}
    lengths = [*map(len, record.u_earlier)]
    for begin in range(0, len(sizes), TOGETHER):
        some = sizes[begin : begin + TOGETHER]
        followed = {at: followed_by(fault, each.mv - each.mv[0], some) for at, each in stretches.items()}
        of = [(each, followed[id(each.stretch)]) for each in parts]
        u = np.concatenate([each.deviations(positions) for each, positions in of], axis=1)
        yield some, u, [each.deviations_before(at, n) for (each, at), n in zip(of, lengths, strict=True)]


def followed_by(fault: Fault, u: Reals, sizes: Reals) -> Reals:
    """The positions of a valve with each of these sizes of stiction or backlash, shape (sizes, N); u: MV, shape
    (N,)."""
    at, found = np.zeros(len(sizes)), np.empty((len(u), len(sizes)))
    for k, value in enumerate(u.tolist()):  # many sizes at once: much faster than one after the other
        if fault is stiction:
            at = np.where(np.abs(value - at) > sizes, value, at)
        else:
            at = np.minimum(np.maximum(at, value - sizes), value + sizes)
        found[k] = at
    return np.ascontiguousarray(found.T)
