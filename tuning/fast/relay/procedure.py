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
from loopwright.tuning.experiments.ramp import ramped
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.look import or_a_pi
from loopwright.tuning.fast.evaluation.outcome import evaluated
from loopwright.tuning.fast.evaluation.proposal import (
    FastProposal,
    VerifiedStep,
    comparison_of,
    evaluation_summary,
    proposed,
    verified_step,
)
from loopwright.tuning.fast.evaluation.still_open import OPEN_REASONS, open_by, trial_may_tell
from loopwright.tuning.fast.experiment import on_trial
from loopwright.tuning.fast.record import MIN_LISTENED
from loopwright.tuning.fast.relay.relay_test import RelayTest
from loopwright.tuning.fast.score_tests.what_hides import naming_what_hides, while_open
from loopwright.tuning.plan import Note, Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["FAST", "FAST_STAGES", "FastOptions", "FastProposal", "by_relay", "fast"]

FAST = "fast"
FAST_STAGES = ("preflight", "relay", "design", "verify", "redesign")
SWITCHES = (4, 6, 8, 10)
ENDING = (Reason.CONTROLLER_MISMATCH, Reason.NOT_POSSIBLE)
"""Reasons for a refusal that a longer relay cannot remove."""
MIN_SAMPLES = 2 * MIN_LISTENED
"""Smallest number of samples at rest, from which noise and offset are estimated."""


@dataclass(frozen=True, slots=True)
class FastOptions(DesignOptions):
    """The options of the procedure: those of the design, and the conduct of the relay test.

    amplitude: the amplitude of the relay's higher side, MV units; by default half of what MV permits, adapted after the
    first wave.
    begins_with: the amplitude with which the default begins in place of its own, larger one, MV units: so that PV keeps
    its limits.
    min_switches: the smallest number of switches of the relay, one of SWITCHES; without the set-point step six at
    least.
    """

    amplitude: float | None = None
    begins_with: float | None = None
    min_switches: int = SWITCHES[0]

    def __post_init__(self) -> None:
        self.spec()
        if self.amplitude is not None and not (math.isfinite(self.amplitude) and self.amplitude > 0.0):
            raise Refused(Reason.BAD_INPUT, f"amplitude must be a positive number, not {self.amplitude!r}")


def fast_stages(verify: bool) -> tuple[str, ...]:
    """The stages of a run with or without the set-point step, in their order."""
    return FAST_STAGES if verify else FAST_STAGES[:3]


def _expected_s(facts: Facts) -> dict[str, float]:
    """The expected plant time of each stage, s."""
    T95 = facts.T95_s
    return {"preflight": T95 / 2, "relay": T95, "design": 0.0, "verify": 1.5 * T95, "redesign": 0.0}


def fast(facts: Facts, options: FastOptions) -> Plan[FastProposal]:
    """The plan of the whole procedure, for a loop in automatic and at rest.

    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    return (yield from ramped(facts, fast_by_relay(facts, options)))


def fast_by_relay(facts: Facts, options: FastOptions) -> Plan[FastProposal]:
    """The plan of the whole procedure without the limit of the set-point's rate, see `ramped`.

    Raises Refused, BAD_LIMITS where the loop may be moved to one side only: a relay moves PV to both.
    """
    options.check_sampling(facts)
    if facts.one_sided:
        text = f"the loop may be moved {facts.directions} only, and a relay moves PV to both sides of its rest"
        raise Refused(Reason.BAD_LIMITS, text)
    expected = _expected_s(facts)
    after_s = sum(expected[stage] for stage in fast_stages(options.verify)[1:])
    point, listened = yield from at_rest(facts, after_s, MIN_SAMPLES)
    experiment = RelayTest(facts, point, listened, options.amplitude, begins_with=options.begins_with)
    yield from experiment.report(StageDone("preflight", point))
    return (yield from by_relay(facts, options, experiment))


def by_relay(facts: Facts, options: FastOptions, experiment: RelayTest) -> Plan[FastProposal]:
    """The plan of the procedure from the relay on. Raises Refused."""
    return (yield from naming_what_hides(experiment, partial(_by_relay, facts, options, experiment)))


def _by_relay(facts: Facts, options: FastOptions, experiment: RelayTest) -> Plan[FastProposal]:
    spec = options.spec()
    todo = fast_stages(options.verify)

    def started(stage: str) -> tuple[StageStarted]:
        expected = _expected_s(facts)
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    yield from experiment.report(*started("relay"))
    evaluation: Evaluation | None = None
    outcome: Refused | Comparison = Refused(Reason.STALLED, "the relay came to nothing")
    smallest = options.min_switches if options.verify else max(options.min_switches, SWITCHES[1])
    for switches in filter(lambda count: count >= smallest, SWITCHES):
        in_time = yield from experiment.relay(switches)
        evaluation = None
        try:
            record = experiment.experiment_record()
            evaluation, outcome = yield from experiment.computed(partial(evaluated, facts, options, record))
        except Refused as refused:
            outcome = refused
        if isinstance(outcome, Comparison) or not in_time or outcome.reason in ENDING:
            break
        yield from experiment.report(Note(f"after {switches} switches: {while_open(experiment, outcome)}"))
    open_still = outcome if isinstance(outcome, Refused) else None
    if options.verify and evaluation is not None and open_still and trial_may_tell(evaluation, open_still):
        known = f"Ms of the new gains is known to +{open_by(evaluation):.2g}"
        yield from experiment.report(Note(f"{known}: the step under the new gains shall tell"))
        outcome = comparison_of(evaluation, facts, spec, options.propose_anyway)
    # the evaluation is reported even if the record is refused: its numbers say why
    yield from experiment.report(StageDone("relay", experiment.relay_figures()), *started("design"))
    if evaluation is not None:
        yield from experiment.report(StageDone("design", evaluation_summary(evaluation)))
    if isinstance(outcome, Refused):
        if evaluation is None:
            raise outcome
        raise (yield from experiment.computed(partial(or_a_pi, facts, options, evaluation, outcome)))
    assert evaluation is not None

    shown: VerifiedStep | None = None
    if options.verify and (outcome.gain or options.propose_anyway):
        yield from experiment.report(*started("verify"))
        first = evaluation
        tested = on_trial(first.best.gains)
        yield from experiment.step(tested, first.period)
        evaluating = partial(evaluated, facts, options, experiment.experiment_record(), first)
        evaluation, outcome = yield from experiment.computed(evaluating)
        shown = verified_step(evaluation, tested, *experiment.stepped)
        if isinstance(outcome, Refused) and outcome.reason in OPEN_REASONS:
            text = while_open(experiment, outcome)
            yield from experiment.report(Note(f"after the set-point step: {text}; it is stepped back"))
            yield from experiment.step_back()
            evaluating = partial(evaluated, facts, options, experiment.experiment_record(), first)
            evaluation, outcome = yield from experiment.computed(evaluating)
            shown = verified_step(evaluation, tested, *experiment.stepped)
        yield (StageDone("verify", shown), *started("redesign"), StageDone("redesign", evaluation_summary(evaluation)))
        if isinstance(outcome, Refused):
            raise outcome
    begun_at_s = experiment.trace.t[experiment.listened]
    work = partial(proposed, FAST, facts, spec, evaluation, outcome, shown, begun_at_s)
    return (yield from experiment.computed(work))
