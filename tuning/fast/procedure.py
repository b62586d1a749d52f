"""The fast procedure is one plan made of smaller plans.

    listen - relay (biased, 4 to 10 switches) - fit and design - verify (set-point step) - fit and design again

The relay ends when the gains that would be proposed are certain enough, not after a fixed number of switches. The gains
proposed are designed on the whole record of relay and set-point step. Where the design improves nothing that was asked
for, the procedure ends after the design, and no new gains are tried on the loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

from loopwright.tuning.analysis.comparison import Comparison
from loopwright.tuning.experiments.preflight import at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.fast.evaluation import Evaluation, evaluate
from loopwright.tuning.fast.proposal import (
    FastProposal,
    VerifiedStep,
    comparison_of,
    evaluation_summary,
    proposed,
    verified_step,
)
from loopwright.tuning.fast.record import MIN_LISTENED, ExperimentRecord
from loopwright.tuning.fast.relay_test import RelayTest
from loopwright.tuning.models import sign
from loopwright.tuning.plan import Note, Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["FAST", "FAST_STAGES", "FastOptions", "FastProposal", "fast"]

FAST = "fast"
FAST_STAGES = ("preflight", "relay", "design", "verify", "redesign")
SWITCHES = (4, 6, 8, 10)
OPEN_REASONS = (Reason.UNCERTAIN, Reason.AMBIGUOUS)
"""Reasons for a refusal that a longer record of the same kind may remove."""
MIN_SAMPLES = 2 * MIN_LISTENED
"""Smallest number of samples at rest, from which noise and offset are estimated."""


@dataclass(frozen=True, slots=True)
class FastOptions:
    """The options of the procedure: the design specification and the conduct of the test.

    Ms, derivative, Mt, noise_gain: see `tuning.fast.design.DesignSpec`.
    amplitude: the amplitude of the relay's higher side, MV units; by default half of what MV permits, adapted after the
    first wave.
    careful: the relay switches six times at least.
    verify: the set-point step under the new gains is made; without it the relay switches six times at least.
    propose_anyway: the procedure goes on where the new gains improve nothing that was asked for.
    """

    Ms: float = 1.6
    derivative: bool = False
    Mt: float | None = None
    noise_gain: float | None = None
    amplitude: float | None = None
    careful: bool = False
    verify: bool = True
    propose_anyway: bool = False

    def spec(self) -> DesignSpec:
        """The design specification of these options. Raises Refused, BAD_INPUT."""
        return DesignSpec(self.Ms, self.derivative, self.Mt, self.noise_gain)

    def __post_init__(self) -> None:
        self.spec()
        if self.amplitude is not None and not (math.isfinite(self.amplitude) and self.amplitude > 0.0):
            raise Refused(Reason.BAD_INPUT, f"amplitude must be a positive number, not {self.amplitude!r}")


def fast_stages(verify: bool) -> tuple[str, ...]:
    """The stages of a run with or without the set-point step, in their order."""
    return FAST_STAGES if verify else FAST_STAGES[:3]


def fast(facts: Facts, options: FastOptions) -> Plan[FastProposal]:
    """The plan of the whole procedure, for a loop in automatic and at rest.

    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    T95, spec = facts.T95_s, options.spec()
    expected = {"preflight": T95 / 2, "relay": T95, "design": 0.0, "verify": 1.5 * T95, "redesign": 0.0}
    todo = fast_stages(options.verify)

    def started(stage: str) -> tuple[StageStarted]:
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    after_s = sum(expected[stage] for stage in todo[1:])
    point, listened = yield from at_rest(facts, after_s, MIN_SAMPLES)
    experiment = RelayTest(facts, point, listened, options.amplitude)
    yield from experiment.report(StageDone("preflight", point))

    yield from experiment.report(*started("relay"))
    evaluation: Evaluation | None = None
    outcome: Refused | Comparison = Refused(Reason.STALLED, "the relay came to nothing")
    careful = options.careful or not options.verify
    for switches in SWITCHES[careful:]:
        in_time = yield from experiment.relay(switches)
        evaluation = None
        try:
            record = experiment.experiment_record()
            evaluation, outcome = yield from experiment.computed(partial(_evaluated, facts, options, record))
        except Refused as refused:
            outcome = refused
        if isinstance(outcome, Comparison) or not in_time:
            break
        yield from experiment.report(Note(f"after {switches} switches: {outcome.detail}"))
    # the evaluation is reported even if the record is refused: its numbers say why
    yield from experiment.report(StageDone("relay", experiment.relay_figures()), *started("design"))
    if evaluation is not None:
        yield from experiment.report(StageDone("design", evaluation_summary(evaluation)))
    if isinstance(outcome, Refused):
        raise outcome
    assert evaluation is not None

    shown: VerifiedStep | None = None
    if options.verify and (outcome.gain or options.propose_anyway):
        yield from experiment.report(*started("verify"))
        first = evaluation
        tested = first.best.gains
        yield from experiment.step(tested, first.period)
        evaluating = partial(_evaluated, facts, options, experiment.experiment_record(), first)
        evaluation, outcome = yield from experiment.computed(evaluating)
        shown = verified_step(evaluation, tested, *experiment.stepped)
        if isinstance(outcome, Refused) and outcome.reason in OPEN_REASONS:
            yield from experiment.report(Note(f"after the set-point step: {outcome.detail}; it is stepped back"))
            yield from experiment.step_back()
            evaluating = partial(_evaluated, facts, options, experiment.experiment_record(), first)
            evaluation, outcome = yield from experiment.computed(evaluating)
            shown = verified_step(evaluation, tested, *experiment.stepped)
        yield (StageDone("verify", shown), *started("redesign"), StageDone("redesign", evaluation_summary(evaluation)))
        if isinstance(outcome, Refused):
            raise outcome
    relay_at_s = experiment.trace.t[experiment.listened]
    return (yield from experiment.computed(partial(proposed, facts, spec, evaluation, outcome, shown, relay_at_s)))


def _evaluated(
    facts: Facts, options: FastOptions, record: ExperimentRecord, first: Evaluation | None = None
) -> tuple[Evaluation, Refused | Comparison]:
    """The evaluation of a record, with the refusal that follows from it or else the comparison of old and new gains.

    first: the evaluation of the relay's record, see `earlier` of `evaluate`.
    Raises Refused, NOT_ROBUST.
    """
    evaluation = evaluate(record, options.spec(), first)
    return evaluation, refusal(facts, evaluation) or comparison_of(
        evaluation, facts, options.spec(), options.propose_anyway
    )


def refusal(facts: Facts, evaluation: Evaluation) -> Refused | None:
    """The refusal that follows from an evaluation, None where its gains may be proposed."""
    model = evaluation.model
    if (sign(model) > 0.0) != facts.reverse:
        return Refused(
            Reason.WRONG_SIGN,
            f"the record fits a plant of {'positive' if sign(model) > 0.0 else 'negative'} gain; the controller acts "
            f"{'reverse' if facts.reverse else 'direct'}",
        )
    return None if evaluation.reason is None else Refused(evaluation.reason, evaluation.detail)
