"""Which models a record of normal operation leaves possible, and how far Ms may be off by them.

No step under the gains follows before they are proposed: what may be wrong adds up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.uncertainty import filter_ratio, peak, uncertainty_of_Ms
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.robustness import KnownMs, known_Ms
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.operation.faulty_valve import FaultyValve, models_of_small_faults
from loopwright.tuning.operation.history import HistoryPart

OTHER_BIC = 20.0
"""Difference of BIC within which Ms on another structure counts. Two parameters more cost more than RIVAL_BIC where
they explain nothing: a structure too simple for the plant then has no rival, and Ms on the richer ones says so."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """How far the Ms of gains may be off, by cause.

    standard_error: by two standard deviations of the model.
    on_others: the largest difference on a model of another structure.
    left_out: the largest difference on a model that was fitted without one of the set-point changes.
    on_valve: the largest difference on a model with a valve that moves a little less than MV.
    """

    standard_error: float
    on_others: float
    left_out: float
    on_valve: float

    @property
    def whole(self) -> float:
        """The root of the sum of the squares."""
        return math.hypot(self.standard_error, self.on_others, self.left_out, self.on_valve)


@dataclass(frozen=True, slots=True, eq=False)
class PlausibleModels:
    """The model of an evaluation, and the others that the record leaves possible, by cause as in `Doubt`."""

    evaluation: Evaluation
    others: tuple[TransferFunction, ...]
    left_out: tuple[TransferFunction, ...]
    valve: tuple[TransferFunction, ...] = ()

    def with_valve(self, parts: Sequence[HistoryPart], likeliest: FaultyValve | None) -> PlausibleModels:
        """These with the models of a valve that moves a little less than MV.

        parts: those of the record. likeliest: the fault that the record speaks for most.
        """
        found = models_of_small_faults(self.evaluation.fit, self.evaluation.chosen.best, parts, likeliest)
        return replace(self, valve=tuple(found))

    def doubt(self, gains: Gains) -> Doubt | None:
        """How far Ms of these gains may be off; None where the loop is not stable on the model."""
        Ms = known_Ms(self.evaluation, gains).Ms
        return None if Ms is None else self._doubt(gains, Ms)

    def known_Ms(self, gains: Gains) -> KnownMs:
        """Ms of these gains on the model, with everything that may be wrong of it."""
        Ms = known_Ms(self.evaluation, gains).Ms
        return KnownMs(Ms, None if Ms is None else self._doubt(gains, Ms).whole)

    def _doubt(self, gains: Gains, Ms: float) -> Doubt:
        fit, w, delay = self.evaluation.fit, frequencies(self.evaluation.period), self.evaluation.design_delay

        def difference(models: Sequence[TransferFunction]) -> float:
            return max((abs(peak(model, gains, w, delay) - Ms) for model in models), default=0.0)

        error = uncertainty_of_Ms(fit, self.evaluation.chosen.best, gains, w, filter_ratio(gains), delay)
        return Doubt(error, *map(difference, (self.others, self.left_out, self.valve)))


def plausible_models(evaluation: Evaluation) -> PlausibleModels:
    """The models of other structures, and those without one of the changes; further fits."""
    fit, best = evaluation.fit, evaluation.chosen.best
    others = [each for each in evaluation.chosen.fits if each.bic < best.bic + OTHER_BIC]
    others += evaluation.chosen.rivals
    left_out = (_model_without(fit, best, piece) for piece in range(1, len(fit.pieces)))
    return PlausibleModels(evaluation, tuple(map(fit.model, others)), tuple(left_out))


def _model_without(fit: Fit[ExperimentRecord], found: Fitted, piece: int) -> TransferFunction:
    """The model of the same structure, fitted without one piece of the record."""
    record, structure = fit.record, found.structure
    end = int(np.sum(record.lengths[: piece + 1]))
    left = np.delete(np.arange(len(record.u)), slice(end - record.lengths[piece], end))
    lengths = record.lengths[:piece] + record.lengths[piece + 1 :]
    before = record.u_earlier[:piece] + record.u_earlier[piece + 1 :]
    shorter = replace(record, u=record.u[left], y=record.y[left], excited=len(left), lengths=lengths, u_earlier=before)
    fewer = Fit(shorter)
    times, out = found.theta[structure.searched :], fit.pieces[piece]
    times = times[(times < out.start) | (times >= out.stop)]
    times = np.where(times >= out.stop, times - (out.stop - out.start), times)
    hypothesis = replace(found.hypothesis, load_disturbances=len(times))
    theta = np.append(found.theta[: structure.searched], times)
    return fewer.model(fewer.search(structure, hypothesis, [theta]))
