"""The set-point procedure is one plan made of smaller plans; the loop stays in automatic all the time.

    listen - pulses of the set-point under the present gains - fit and design - set-point step home under the new gains

The pulses end when the gains that would be proposed are certain enough: see `look.settled`.
"""

from __future__ import annotations

import math
from functools import partial

from loopwright.tuning.experiments.preflight import at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.ramp import check_ramp, ramped, slow_words
from loopwright.tuning.fast.evaluation import MAX_UNCERTAINTY
from loopwright.tuning.fast.experiment import on_trial
from loopwright.tuning.fast.look import Look, look_at, settled
from loopwright.tuning.fast.options import DesignOptions
from loopwright.tuning.fast.outcome import OPEN_REASONS, evaluated
from loopwright.tuning.fast.proposal import (
    FastProposal,
    VerifiedStep,
    comparison_of,
    evaluation_summary,
    proposed,
    verified_step,
)
from loopwright.tuning.fast.pulse_levels import back_level, last_level, last_level_of_one_side, second_level
from loopwright.tuning.fast.pulse_test import BACK, DOWN, UP, PulseTest
from loopwright.tuning.fast.pulse_test import MAX_T95 as MAX_T95_TO_FOLLOW
from loopwright.tuning.fast.record import MIN_LISTENED, Excitation
from loopwright.tuning.fast.record_evaluation import first_period
from loopwright.tuning.plan import Note, Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["SETPOINT", "SETPOINT_STAGES", "TooLittleExcited", "by_pulses", "setpoint"]

SETPOINT = "setpoint"
SETPOINT_STAGES = ("preflight", "pulses", "design", "verify", "redesign")
MIN_SAMPLES = 2 * MIN_LISTENED
FIRST_LOOK = 1.5
"""Length of the record at the first look, in first periods."""
NEXT_LOOK, NEXT_LOOK_PERIODS = 1.25, 0.35
"""Growth of the record from one look to the next: this factor, and this number of periods more."""
LOOKS_OFTEN, LATER_LOOK = 5, 1.6
"""After so many looks the record has to grow by this factor from one to the next: each costs more than the last."""
MAX_MODELS = 4
"""Number of models that are asked whether the step home fits into MV's limits."""
MAX_PERIODS, MAX_T95, MAX_TURNS = 12.0, 1.5, 2.5
"""Longest record: the longest of these numbers of ultimate periods, of T95, and of the time of the first two turns."""
MAX_PERIODS_IN_ALL, MAX_TURNS_IN_ALL = 30.0, 12.0
"""The record is never longer than these numbers of ultimate periods and of the time of the first two turns. A load
disturbance can make the first of them far too long."""
RELAY_PERIODS = 4.0
"""Time that the relay's record takes, in ultimate periods of the model: where the relay may follow and the pulses would
take longer than that, they end."""

NOT_FOLLOWED = (Reason.NO_RESPONSE, Reason.STALLED)
MAX_T95_BEFORE_RELAY = 1.0
"""Longest time for PV to follow a pulse, in T95, where the relay may follow."""


class TooLittleExcited(Refused):
    """The pulses end early, because the relay may follow and tells more. `test` holds their record."""

    def __init__(self, refused: Refused, test: PulseTest) -> None:
        super().__init__(refused.reason, refused.detail)
        self.test = test


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
    T95, spec = facts.T95_s, options.spec()
    expected = {"preflight": T95 / 2, "pulses": T95, "design": 0.0, "verify": 1.5 * T95, "redesign": 0.0}
    todo = setpoint_stages(options.verify)

    def started(stage: str) -> tuple[StageStarted]:
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    point, listened = yield from at_rest(facts, sum(expected[stage] for stage in todo[1:]), MIN_SAMPLES)
    test = PulseTest(facts, point, listened)
    yield from test.report(StageDone("preflight", point))
    check_ramp(facts, test.noise)
    yield from test.report(*started("pulses"))
    yield from test.start()
    longest_T95 = MAX_T95_BEFORE_RELAY if relay_follows else MAX_T95_TO_FOLLOW
    try:
        yield from test.until_followed(longest_T95)
        second, wanted = (back_level, BACK) if facts.one_sided else (second_level, DOWN)
        yield from test.turn_within_bounds(second, wanted)
        yield from test.until_followed(longest_T95)
    except Refused as refused:
        if relay_follows and refused.reason in NOT_FOLLOWED:
            raise TooLittleExcited(refused, test) from None
        raise
    yield from test.turn_within_bounds(last_level_of_one_side if facts.one_sided else last_level, UP)
    test.period = yield from test.computed(partial(first_period, *test.columns(), facts.sample_time_s))
    look = Look(test.period, None, Refused(Reason.STALLED, "the pulses came to nothing"))
    turned_at, looks = test.elapsed, 0
    at = FIRST_LOOK * test.period
    while True:
        yield from test.lasting(at)
        looked_at = test.elapsed
        record = test.experiment_record()
        last, look = look, (yield from test.computed(partial(look_at, facts, options, record)))
        test.period = look.period
        if settled(look, last, looked_at):
            break
        if look.refusal is not None and look.refusal.reason is Reason.CONTROLLER_MISMATCH:
            break
        own = look.period
        longest = min(
            max(MAX_PERIODS * own, MAX_T95 * facts.T95_s / facts.sample_time_s, MAX_TURNS * turned_at),
            MAX_PERIODS_IN_ALL * own,
            MAX_TURNS_IN_ALL * turned_at,
        )
        if looked_at >= longest:
            if look.refusal is None:
                text = f"after {looked_at} samples two successive evaluations still disagree on the gains"
                look = Look(look.period, look.evaluation, Refused(Reason.UNCERTAIN, text))
            elif math.isfinite(facts.sp_rate_max_per_s) and look.refusal.reason is Reason.UNCERTAIN:
                text = f"{look.refusal.detail}; {slow_words(facts)}, which excites little"
                look = Look(look.period, look.evaluation, Refused(Reason.UNCERTAIN, text))
            break
        if look.refusal is not None:
            if relay_follows and _relay_is_shorter(look, looked_at):
                raise TooLittleExcited(look.refusal, test)
            yield from test.report(Note(f"after {looked_at} samples: {look.refusal.detail}"))
        looks += 1
        growth = NEXT_LOOK if looks < LOOKS_OFTEN else LATER_LOOK
        at = min(growth * looked_at + NEXT_LOOK_PERIODS * own, longest)
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
            yield from test.report(Note(f"after the set-point step: {outcome.detail}; it is stepped again"))
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


def _relay_is_shorter(look: Look, samples: int) -> bool:
    """Whether a relay would take less time than the pulses still need.

    The uncertainty of Ms falls at most with the root of the record's length, because the last level of the set-point
    is held.
    """
    by_relay = samples + RELAY_PERIODS * look.period
    if look.evaluation is None:
        return samples > RELAY_PERIODS * look.period
    open_by = max(look.evaluation.uncertainty, look.evaluation.ambiguity)
    return samples * (open_by / MAX_UNCERTAINTY[Excitation.SETPOINT]) ** 2 > by_relay
