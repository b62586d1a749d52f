"""Whether a gain that changes with MV explains a record as well as the load disturbances of its model do.

Under a few moves of MV a curved valve, or a gain that differs above and below rest, looks much like one or two load
disturbances. The record is therefore fitted again without load disturbances, with MV above rest or the square of MV as
a second input that has the lags and the dead time of the plant and a numerator of its own (a Hammerstein model; K. S.
Narendra, P. G. Gallman, IEEE Trans. Automatic Control 11, 1966).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.score_tests import CHANGING_WITH_MV, GainAlternative
from loopwright.tuning.fast.score_tests.without_loads import at_the_ultimate_period, fit_without_loads
from loopwright.tuning.identification.output_error import (
    LOG_STEP,
    MAX_LOG_STEP,
    DisturbanceHypothesis,
    Fit,
    Fitted,
)
from loopwright.tuning.identification.regressors import Regressors
from loopwright.tuning.identification.variable_projection import SearchBounds
from loopwright.tuning.models import Reals


@dataclass(frozen=True, slots=True)
class ChangingGain:
    """A gain that changes with MV and explains a record without load disturbances.

    what: how the gain changes, in words.
    size: the size of the change, see `ScoreTests.score`.
    bic_gain: by how much it lowers BIC below the model with load disturbances; negative where it raises BIC.
    rms: the rms of the residual that it leaves, as a fraction of the range of PV.
    """

    what: str
    size: float
    bic_gain: float
    rms: float


def find_changing_gain(fit: Fit[ExperimentRecord], best: Fitted) -> ChangingGain | None:
    """The gain that changes with MV and explains the record best in place of the load disturbances of the best model.

    None where the model has no load disturbance, where the record has several pieces, or where the change found is too
    small to matter for Ms.
    """
    if not best.hypothesis.load_disturbances or len(fit.record.pieces) > 1:
        return None
    return max(fit_changing_gains(fit, best), key=lambda each: each.bic_gain, default=None)


def fit_changing_gains(fit: Fit[ExperimentRecord], best: Fitted) -> list[ChangingGain]:
    """The gains that change with MV, fitted to a record of one piece without load disturbances."""
    return [each for alternative in CHANGING_WITH_MV if (each := _fitted(fit, best, alternative)) is not None]


def _fitted(fit: Fit[ExperimentRecord], best: Fitted, alternative: GainAlternative) -> ChangingGain | None:
    structure = best.structure
    hypothesis = DisturbanceHypothesis(drift=best.hypothesis.drift)
    second = Fit(replace(fit.record, u=alternative.changed(fit.record)))
    inputs, lags = structure.inputs, structure.lags

    def regressors(at: Reals) -> Regressors:
        first, further = (each.regressors(structure, hypothesis, at).common for each in (fit, second))
        return Regressors(np.concatenate((first, further[:, :, :inputs]), axis=2))

    bounds = SearchBounds(
        *fit.bounds(structure, hypothesis),
        np.append(np.full(lags, MAX_LOG_STEP), 0.25 * fit.period),
        np.append(np.full(lags, LOG_STEP), LOG_STEP * fit.period),
    )
    found = fit_without_loads(fit, best, regressors, best.theta[None, : structure.searched], bounds)
    linear, changing = (
        at_the_ultimate_period(fit, best, found.at, each)
        for each in (found.coefficients[:inputs], found.coefficients[-inputs:])
    )
    size = (changing / linear).real * fit.record.input_range / second.record.input_range if linear else math.inf
    if abs(size) < alternative.minimum:
        return None
    return ChangingGain(alternative.words(size), size, found.bic_gain, found.rms)
