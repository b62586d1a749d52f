"""The stage of pulses: the set-point moves until what would be proposed is known well enough, or the step under the new
gains may tell it, or nothing more is to be learned in reasonable time.

The record is looked at at growing times. What a look leaves open decides how the test goes on: where Ms is not known
well enough, further pulses follow, or, where those would take longer than the step under the new gains, that step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from loopwright.tuning.experiments.primitives import Unexplained
from loopwright.tuning.experiments.ramp import slow_words
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.look import Look, look_at, or_a_pi, settled
from loopwright.tuning.fast.evaluation.record_evaluation import first_period
from loopwright.tuning.fast.evaluation.still_open import OPEN_REASONS, open_by, samples_needed, trial_may_tell
from loopwright.tuning.fast.pulses.levels import back_level, last_level, last_level_of_one_side, second_level
from loopwright.tuning.fast.pulses.pulse_test import BACK, DOWN, UP, PulseTest
from loopwright.tuning.fast.pulses.pulse_test import MAX_T95 as MAX_T95_TO_FOLLOW
from loopwright.tuning.fast.score_tests.what_hides import while_open
from loopwright.tuning.models import Model
from loopwright.tuning.plan import Note, Plan
from loopwright.tuning.reasons import Reason, Refused

FIRST_LOOK = 1.5
"""Length of the record at the first look, in first periods."""
NEXT_LOOK, NEXT_LOOK_PERIODS = 1.25, 0.35
"""Growth of the record from one look to the next: this factor, and this number of periods more."""
LOOKS_OFTEN, LATER_LOOK = 5, 1.6
"""After so many looks the record has to grow by this factor from one to the next: each costs more than the last."""
MAX_PERIODS, MAX_T95, MAX_TURNS = 12.0, 1.5, 2.5
"""Longest record: the longest of these numbers of ultimate periods, of T95, and of the time of the first two turns."""
MAX_PERIODS_IN_ALL, MAX_TURNS_IN_ALL = 30.0, 12.0
"""The record is never longer than these numbers of ultimate periods and of the time of the first two turns. A load
disturbance can make the first of them far too long."""
RELAY_PERIODS, TRIAL_PERIODS = 4.0, 3.0
"""Time that the relay's record and the step under the new gains take, in ultimate periods of the model: where the
pulses would take longer than that, they end."""
NOT_FOLLOWED = (Reason.NO_RESPONSE, Reason.STALLED)
MAX_T95_BEFORE_RELAY = 1.0
"""Longest time for PV to follow a pulse, in T95, where the relay may follow."""


class TooLittleExcited(Refused):
    """The pulses end early, because the relay may follow and tells more. `test` holds their record."""

    def __init__(self, refused: Refused, test: PulseTest) -> None:
        super().__init__(refused.reason, refused.detail)
        self.test = test


def pulsed(test: PulseTest, options: DesignOptions, relay_follows: bool) -> Plan[Look]:
    """The plan of the pulses from the first move of the set-point on; its result is the last look at the record.

    The look has no refusal where the new gains may be tried, though Ms may not be known as well as a proposal needs it.
    relay_follows: TooLittleExcited is raised as soon as a relay would take less time than the pulses still need.
    Raises Refused.
    """
    facts = test.facts
    yield from _first_pulses(test, relay_follows)
    test.period = yield from test.computed(partial(first_period, *test.columns(), facts.sample_time_s))
    look = Look(test.period, None, Refused(Reason.STALLED, "the pulses came to nothing"))
    turned_at, looks = test.elapsed, 0
    at = FIRST_LOOK * test.period
    while True:
        yield from test.lasting(at)
        samples = test.elapsed
        record = test.experiment_record()
        last, look = look, (yield from test.computed(partial(look_at, facts, options, record)))
        own = test.period = look.period
        if settled(look, last, samples):
            return look
        if look.refusal is not None and look.refusal.reason is Reason.CONTROLLER_MISMATCH:
            return look
        longest = min(
            max(MAX_PERIODS * own, MAX_T95 * facts.T95_s / facts.sample_time_s, MAX_TURNS * turned_at),
            MAX_PERIODS_IN_ALL * own,
            MAX_TURNS_IN_ALL * turned_at,
        )
        if options.verify and (words := _trial_instead(test, look, last, longest)) is not None:
            yield from test.report(Note(words))
            return Look(own, look.evaluation, None)
        if samples >= longest:
            refusal = _refusal_at_the_end(test, look)
            if look.evaluation is not None:
                refusal = yield from test.computed(partial(or_a_pi, facts, options, look.evaluation, refusal))
            return Look(own, look.evaluation, refusal)
        if look.refusal is not None:
            if relay_follows and _relay_is_shorter(look, samples):
                raise TooLittleExcited(look.refusal, test)
            yield from test.report(Note(f"after {samples} samples: {while_open(test, look.refusal)}"))
        looks += 1
        growth = NEXT_LOOK if looks < LOOKS_OFTEN else LATER_LOOK
        at = min(growth * samples + NEXT_LOOK_PERIODS * own, longest)
        if look.refusal is not None and look.refusal.reason in OPEN_REASONS:
            while test.elapsed < at and test.elapsed + turned_at <= longest:
                yield from _two_pulses_more(test, turned_at)
            at = max(at, test.elapsed + NEXT_LOOK_PERIODS * own)


def _first_pulses(test: PulseTest, relay_follows: bool) -> Plan[None]:
    """Three moves of the set-point: up, down (to one side only: back) and up again."""
    longest_T95 = MAX_T95_BEFORE_RELAY if relay_follows else MAX_T95_TO_FOLLOW
    yield from test.start()
    try:
        yield from test.until_followed(longest_T95)
        yield from turn_down(test)
        yield from test.until_followed(longest_T95)
    except Unexplained as unexplained:
        if not relay_follows:
            raise
        refused = yield from test.computed(unexplained.search)
        raise TooLittleExcited(refused, test) if refused.reason in NOT_FOLLOWED else refused from None
    yield from turn_up(test)


def _two_pulses_more(test: PulseTest, samples: int) -> Plan[None]:
    """The set-point down and up once more; each time when PV has followed the move before, or after so many samples."""
    yield from test.followed_or_for(samples)
    yield from turn_down(test)
    yield from test.followed_or_for(samples)
    yield from turn_up(test)


def turn_down(test: PulseTest, models: Sequence[Model] = ()) -> Plan[None]:
    """The set-point down, to one side only: back. models: those that the turn is sized by, in place of those that
    explain the record."""
    level, wanted = (back_level, BACK) if test.facts.one_sided else (second_level, DOWN)
    yield from test.turn_within_bounds(partial(level, models=models), wanted)


def turn_up(test: PulseTest, models: Sequence[Model] = ()) -> Plan[None]:
    """The set-point up again. models: as of `turn_down`."""
    level = last_level_of_one_side if test.facts.one_sided else last_level
    yield from test.turn_within_bounds(partial(level, models=models), UP)


def _trial_instead(test: PulseTest, look: Look, last: Look, longest: float) -> str | None:
    """Why the step under the new gains follows though Ms is not known well enough; None where it shall not.

    last: the look before. Where that one knew Ms better, something else has moved PV since.
    longest: the length of the longest record, in samples.
    """
    now, before = look.evaluation, last.evaluation
    if now is None or look.refusal is None or not trial_may_tell(now, look.refusal):
        return None
    if before is not None and open_by(now) > open_by(before):
        return None
    samples = test.elapsed
    needed = min(samples_needed(now, samples), longest) - samples
    if needed <= TRIAL_PERIODS * look.period and samples < longest:
        return None
    known = f"Ms of the new gains is known to +{open_by(now):.2g}"
    takes = f"further pulses would take {max(needed, 0.0) * test.facts.sample_time_s:.3g} s more to tell it better"
    return f"{known}; {takes}: the step under the new gains shall tell it"


def _refusal_at_the_end(test: PulseTest, look: Look) -> Refused:
    """The refusal of the last look, where the record has lasted as long as it may."""
    refusal = look.refusal
    if refusal is None:
        text = f"after {test.elapsed} samples two successive evaluations still disagree on the gains"
        return Refused(Reason.UNCERTAIN, text)
    if math.isfinite(test.facts.sp_rate_max_per_s) and refusal.reason is Reason.UNCERTAIN:
        return Refused(Reason.UNCERTAIN, f"{refusal.detail}; {slow_words(test.facts)}, which excites little")
    return refusal


def _relay_is_shorter(look: Look, samples: int) -> bool:
    """Whether a relay would take less time than the pulses still need."""
    by_relay = samples + RELAY_PERIODS * look.period
    if look.evaluation is None:
        return samples > RELAY_PERIODS * look.period
    return samples_needed(look.evaluation, samples) > by_relay
