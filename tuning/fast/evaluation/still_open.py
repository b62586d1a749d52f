"""What a record leaves open of Ms, for how long its excitation would have to go on, and whether the step under the new
gains may tell it instead."""

from __future__ import annotations

from loopwright.tuning.fast.evaluation.evaluation import MAX_UNCERTAINTY, Evaluation
from loopwright.tuning.fast.score_tests.score_tests import ScoreTests
from loopwright.tuning.reasons import Reason, Refused

OPEN_REASONS = (Reason.UNCERTAIN, Reason.AMBIGUOUS)
"""Reasons for a refusal that a longer record of the same kind may remove."""
MAX_UNCERTAINTY_TO_TRY = 0.3
"""Largest uncertainty of Ms with which new gains may be tried."""
MAX_DIFFERENCE_TO_TRY = 1.0
"""Largest difference of the gain above and below rest that may be open where new gains are tried, a fraction of the
gain. The gain margin of a loop of Ms 1.6 is at least 2.7."""


def open_by(evaluation: Evaluation) -> float:
    """How far Ms of the gains designed may be off: by two standard deviations of the model, or on a rival model."""
    return max(evaluation.uncertainty, evaluation.ambiguity)


def samples_needed(evaluation: Evaluation, samples: int) -> float:
    """How long a record has to be until Ms is known well enough, in samples, at this length by now.

    The uncertainty of Ms falls about with the root of the record's length.
    """
    excess = open_by(evaluation) / MAX_UNCERTAINTY[evaluation.fit.record.excitation]
    return samples * max(excess, 1.0) ** 2


def trial_may_tell(evaluation: Evaluation, refused: Refused) -> bool:
    """Whether Ms is known well enough to try the new gains, whose step may then tell the rest.

    Under the new gains the loop moves at the frequencies that decide its Ms more than under most excitations.
    refused: the refusal that follows from the evaluation.
    """
    if refused.reason not in OPEN_REASONS or open_by(evaluation) > MAX_UNCERTAINTY_TO_TRY:
        return False
    tests = ScoreTests(evaluation.fit, evaluation.chosen.best)
    return tests.nonlinearity() is None and tests.unknown_difference() <= MAX_DIFFERENCE_TO_TRY
