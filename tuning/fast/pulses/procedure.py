"""The set-point procedure is one plan made of smaller plans; the loop stays in automatic all the time.

    listen - pulses of the set-point under the present gains - fit and design - set-point step home under the new gains

When the pulses end is decided in `pulses`.
"""

from __future__ import annotations

from functools import partial

from loopwright.tuning.experiments.preflight import at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.ramp import check_ramp, ramped
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.outcome import evaluated
from loopwright.tuning.fast.evaluation.proposal import (
    FastProposal,
    VerifiedStep,
    comparison_of,
    evaluation_summary,
    proposed,
    verified_step,
)
from loopwright.tuning.fast.evaluation.still_open import OPEN_REASONS
from loopwright.tuning.fast.experiment import on_trial
from loopwright.tuning.fast.pulses.pulse_test import PulseTest
from loopwright.tuning.fast.pulses.stage import TooLittleExcited, pulsed
from loopwright.tuning.fast.record import MIN_LISTENED
from loopwright.tuning.fast.score_tests.what_hides import naming_what_hides, while_open
from loopwright.tuning.plan import Note, Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Refused

__all__ = ["SETPOINT", "SETPOINT_STAGES", "TooLittleExcited", "by_pulses", "setpoint"]

SETPOINT = "setpoint"
SETPOINT_STAGES = ("preflight", "pulses", "design", "verify", "redesign")
MIN_SAMPLES = 2 * MIN_LISTENED
MAX_MODELS = 4
"""Number of models that are asked whether the step home fits into MV's limits."""


def setpoint_stages(verify: bool) -> tuple[str, ...]:
    """The stages of a run with or without the set-point step, in their order."""
    return SETPOINT_STAGES if verify else SETPOINT_STAGES[:3]


def setpoint(facts: Facts, options: DesignOptions) -> Plan[FastProposal]:
    """The plan of the whole procedure, for a loop in automatic and at rest.

    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    return (yield from ramped(facts, by_pulses(facts, options)))


def by_pulses(
    facts: Facts, options: DesignOptions, method: str = SETPOINT, relay_follows: bool = False
) -> Plan[FastProposal]:
    """The plan of the whole procedure without the limit of the set-point's rate, see `ramped`.

    method: the name of the procedure in the proposal.
    relay_follows: TooLittleExcited is raised as soon as a relay would take less time than the pulses still need.
    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    options.check_sampling(facts)
    after = (_expected_s(facts)[stage] for stage in setpoint_stages(options.verify)[1:])
    point, listened = yield from at_rest(facts, sum(after), MIN_SAMPLES)
    test = PulseTest(facts, point, listened)
    yield from test.report(StageDone("preflight", point))
    plan = partial(_tested, facts, options, test, method, relay_follows)
    return (yield from naming_what_hides(test, plan))


def _expected_s(facts: Facts) -> dict[str, float]:
    """The expected plant time of each stage, s."""
    T95 = facts.T95_s
    return {"preflight": T95 / 2, "pulses": T95, "design": 0.0, "verify": 1.5 * T95, "redesign": 0.0}


def _tested(
    facts: Facts, options: DesignOptions, test: PulseTest, method: str, relay_follows: bool
) -> Plan[FastProposal]:
    spec, expected, todo = options.spec(), _expected_s(facts), setpoint_stages(options.verify)

    def started(stage: str) -> tuple[StageStarted]:
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    check_ramp(facts, test.noise)
    yield from test.report(*started("pulses"))
    look = yield from pulsed(test, options, relay_follows)
    evaluation = look.evaluation
    yield from test.report(StageDone("pulses", test.figures()), *started("design"))
    if evaluation is not None:
        yield from test.report(StageDone("design", evaluation_summary(evaluation)))
    if look.refusal is not None:
        raise look.refusal
    assert evaluation is not None
    comparison = yield from test.computed(partial(comparison_of, evaluation, facts, spec, options.propose_anyway))

    shown: VerifiedStep | None = None
    if options.verify and (comparison.gain or options.propose_anyway):
        yield from test.report(*started("verify"))
        first = evaluation
        tested = on_trial(first.best.gains)
        models = [first.fit.model(each) for each in (first.chosen.best, *first.chosen.rivals)][:MAX_MODELS]
        yield from test.approach(models, tested, first.period)
        yield from test.step(tested, first.period)
        evaluation, outcome = yield from test.computed(
            partial(evaluated, facts, options, test.experiment_record(), first)
        )
        shown = verified_step(evaluation, tested, *test.stepped)
        if isinstance(outcome, Refused) and outcome.reason in OPEN_REASONS:
            yield from test.report(Note(f"after the set-point step: {while_open(test, outcome)}; it is stepped again"))
            yield from test.step_again()
            evaluation, outcome = yield from test.computed(
                partial(evaluated, facts, options, test.experiment_record(), first)
            )
            shown = verified_step(evaluation, tested, *test.stepped)
        yield (StageDone("verify", shown), *started("redesign"), StageDone("redesign", evaluation_summary(evaluation)))
        if isinstance(outcome, Refused):
            raise outcome
        comparison = outcome
    begun_at_s = test.trace.t[test.listened]
    return (yield from test.computed(partial(proposed, method, facts, spec, evaluation, comparison, shown, begun_at_s)))
