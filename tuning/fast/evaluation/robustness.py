"""How well the Ms of any gains on the plant of a record is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

from loopwright.tuning.analysis.comparison import as_sampled
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.uncertainty import difference_of_rivals, filter_ratio, uncertainty_of_Ms
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Refused


@dataclass(frozen=True, slots=True)
class KnownMs:
    """Ms of gains on the model, and how far it may be off: by two standard deviations of the model, or on another model
    that explains the record as well. Both None where the loop is not stable on the model."""

    Ms: float | None
    uncertainty: float | None


def known_Ms(evaluation: Evaluation, gains: Gains) -> KnownMs:
    """Ms of these gains on the model of an evaluation, with its uncertainty."""
    delay = evaluation.design_delay
    model = replace(evaluation.model, L=evaluation.model.L + delay)
    try:  # as the comparison of old and new gains has it
        found = margins(model, as_sampled(gains, evaluation.fit.record.Ts))
    except Refused:  # gains that the analysis does not take, of a controller that works all the same
        return KnownMs(None, None)
    if not found.stable:
        return KnownMs(None, None)
    fit, chosen, w = evaluation.fit, evaluation.chosen, frequencies(evaluation.period)
    spread = uncertainty_of_Ms(fit, chosen.best, gains, w, filter_ratio(gains), delay)
    rivals = difference_of_rivals(fit, chosen.best, chosen.rivals, gains, w, delay)
    return KnownMs(found.Ms, max(spread, rivals))
