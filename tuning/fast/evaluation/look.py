"""One look at the growing record of pulses, and whether two looks in a row agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.design.uncertainty import peak
from loopwright.tuning.fast.evaluation.controller_effect import with_controller
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.outcome import refusal_of
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_excitation
from loopwright.tuning.fast.evaluation.still_open import OPEN_REASONS, open_by, trial_may_tell
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.reasons import Reason, Refused

MIN_OWN_PERIODS = 2.0
"""Smallest length of the record, in ultimate periods of its own model."""
MAX_DISAGREEMENT = 0.08
"""Largest difference of Ms from the Ms of the design, of the gains of two successive looks on each other's model."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One look at the record.

    period: the time scale of the fit, in samples.
    evaluation: the evaluation, None where the record could not be evaluated.
    refusal: the refusal that follows from the look; None where its gains may be proposed.
    """

    period: float
    evaluation: Evaluation | None
    refusal: Refused | None


def look_at(facts: Facts, options: DesignOptions, record: ExperimentRecord) -> Look:
    """One look at the record so far."""
    try:
        evaluation = with_controller(evaluate_excitation(record, options.spec(), test_follows=options.verify))
    except Refused as refused:
        return Look(record.period, None, refused)
    return Look(evaluation.fit.period, evaluation, refusal_of(facts, evaluation))


def or_a_pi(facts: Facts, options: DesignOptions, evaluation: Evaluation, refused: Refused) -> Refused:
    """The refusal that follows from an evaluation, with what its record says of a PI where a PID was asked for.

    A PID needs the plant at higher frequencies than a PI, which the record may not show.
    """
    if not options.derivative or refused.reason not in OPEN_REASONS:
        return refused
    look = look_at(facts, replace(options, derivative=False), evaluation.fit.record)
    if look.evaluation is None:
        return refused
    if look.refusal is not None and not (options.verify and trial_may_tell(look.evaluation, look.refusal)):
        return refused
    known = f"Ms of a PI is known to +{open_by(look.evaluation):.2g}"
    return Refused(refused.reason, f"{refused.detail}; {known}: ask for one, without derivative action")


def settled(look: Look, last: Look, samples: int, max_disagreement: float = MAX_DISAGREEMENT) -> bool:
    """Whether the pulses may end: the look has no objection to the record, the record is long enough for its own model,
    and this look and the one before agree on each other's gains."""
    now, before = look.evaluation, last.evaluation
    if now is None or before is None or (look.refusal and look.refusal.reason is not Reason.NOT_POSSIBLE):
        return False
    if samples < MIN_OWN_PERIODS * now.period / now.fit.record.Ts:
        return False
    w = frequencies(now.period)
    delay = now.design_delay
    return all(
        abs(peak(model.model, gains.best.gains, w, delay) - gains.best.Ms) <= max_disagreement
        for model, gains in ((now, before), (before, now))
    )
