"""What follows from a record: a refusal, or the comparison of the present gains with those designed on it."""

from __future__ import annotations

from loopwright.tuning.analysis.comparison import Comparison
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.controller_effect import with_controller
from loopwright.tuning.fast.evaluation.evaluation import Evaluation, evaluate
from loopwright.tuning.fast.evaluation.proposal import comparison_of
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_excitation
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.models import sign
from loopwright.tuning.reasons import Reason, Refused


def outcome_of(facts: Facts, options: DesignOptions, evaluation: Evaluation) -> Refused | Comparison:
    """The refusal that follows from an evaluation, or else the comparison of the present and the new gains.

    Raises Refused, NOT_ROBUST.
    """
    return refusal_of(facts, evaluation) or comparison_of(evaluation, facts, options.spec(), options.propose_anyway)


def evaluated(
    facts: Facts, options: DesignOptions, record: ExperimentRecord, first: Evaluation | None = None
) -> tuple[Evaluation, Refused | Comparison]:
    """The evaluation of a record with what follows from it, see `outcome_of`.

    first: the evaluation of the record of the excitation alone, see `earlier` of `evaluate`.
    Raises Refused, NOT_ROBUST.
    """
    spec = options.spec()
    if first is None:
        evaluation = evaluate_excitation(record, spec, test_follows=options.verify)
    else:
        evaluation = evaluate(record, spec, first)
    evaluation = with_controller(evaluation)
    return evaluation, outcome_of(facts, options, evaluation)


def refusal_of(facts: Facts, evaluation: Evaluation) -> Refused | None:
    """The refusal that follows from an evaluation, None where its gains may be proposed."""
    model = evaluation.model
    if (sign(model) > 0.0) != facts.reverse:
        return Refused(
            Reason.WRONG_SIGN,
            f"the record fits a plant of {'positive' if sign(model) > 0.0 else 'negative'} gain; the controller acts "
            f"{'reverse' if facts.reverse else 'direct'}",
        )
    return None if evaluation.reason is None else Refused(evaluation.reason, evaluation.detail)
