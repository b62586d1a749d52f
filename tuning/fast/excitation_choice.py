"""The fast procedure chooses what moves the loop, among what the loop permits.

    (listen - design - trial, where the plant is known from operation; where that fails:)
    listen - pulses of the set-point - (where they tell too little: relay) - design - verify - design again

Of a plant that is known from normal operation only the new gains are tried (`known_procedure`). Else, or where the
trial shows another plant, the pulses come first, because they leave the loop in automatic. The choice is made at each
look at their record: the relay follows as soon as it would take less time than the pulses still need. Present gains
that are sluggish excite little around the ultimate frequency, above all for a PID. Pulses and relay are then one
record.
"""

from __future__ import annotations

from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.ramp import ramped
from loopwright.tuning.experiments.settle import after_settling
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.known_plant.procedure import KNOWN_STAGES, TRIAL, ObservedPlantFails, by_known_plant
from loopwright.tuning.fast.manual.procedure import MANUAL, MANUAL_STAGES, by_manual
from loopwright.tuning.fast.pulses.procedure import SETPOINT_STAGES, TooLittleExcited, by_pulses
from loopwright.tuning.fast.pulses.pulse_test import PulseTest
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FAST, FastOptions, by_relay, fast_by_relay
from loopwright.tuning.fast.relay.relay_test import BIAS, RelayTest
from loopwright.tuning.plan import Note, Plan
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["chosen_stages", "fast_by"]

MAX_AWAY = 1.0 - 1.0 / (1.0 + BIAS)
"""Largest distance of MV from rest with which a relay of the largest amplitude may begin, in permitted jumps of MV."""
NOT_ASKED = NothingKnown("the history of the loop was not looked at")
MAX_NEAR_T95 = 10.0
"""Longest time for MV to come near enough to rest for the relay, in T95."""


def chosen_stages(excitations: tuple[Excitation, ...], verify: bool) -> tuple[str, ...]:
    """The stages that a run with these excitations may have, in their order; the relay's is left out where the pulses
    tell enough."""
    if excitations == (Excitation.MANUAL,):
        return MANUAL_STAGES
    manual = (MANUAL,) if Excitation.MANUAL in excitations else ()
    trial = (TRIAL,) if Excitation.OBSERVE in excitations and verify else ()
    if excitations == (Excitation.OBSERVE,):
        return KNOWN_STAGES
    relay = ("relay",) if Excitation.RELAY in excitations else ()
    pulses = ("pulses",) if Excitation.SETPOINT in excitations else ()
    first, _, design, *last = SETPOINT_STAGES
    return (first, *trial, *pulses, *relay, *manual, design, *(last if verify else ()))


def fast_by(
    excitations: tuple[Excitation, ...],
    facts: Facts,
    options: FastOptions,
    known: ObservedPlant | NothingKnown = NOT_ASKED,
) -> Plan[FastProposal]:
    """The plan of the fast procedure with the excitations that the loop permits, for a loop in automatic and at rest.

    known: what normal operation has shown of the plant.
    With MANUAL alone the loop is in manual and stays there.
    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    if excitations == (Excitation.MANUAL,):
        return (yield from by_manual(facts, options, FAST))
    return (yield from ramped(facts, _chosen(excitations, facts, options, known)))


def _chosen(
    excitations: tuple[Excitation, ...], facts: Facts, options: FastOptions, known: ObservedPlant | NothingKnown
) -> Plan[FastProposal]:
    if Excitation.OBSERVE not in excitations:
        return (yield from _moved_by(excitations, facts, options))
    try:
        if isinstance(known, NothingKnown):
            raise ObservedPlantFails(Reason.UNCERTAIN, known.why)
        return (yield from by_known_plant(facts, options, known, FAST))
    except ObservedPlantFails as failed:
        others = tuple(each for each in excitations if each is not Excitation.OBSERVE)
        what = "the trial of gains from operation failed" if failed.moved else "operation does not give gains to try"
        if not others:
            raise Refused(failed.reason, f"{what}, and no other excitation is permitted: {failed.detail}") from None
        yield (Note(f"{what}: {failed.detail}; the loop is moved by {' or '.join(each.in_words for each in others)}"),)
        moved = failed.moved
    plan = _moved_by(others, facts, options)
    return (yield from (after_settling(facts, plan) if moved else plan))


def _moved_by(excitations: tuple[Excitation, ...], facts: Facts, options: FastOptions) -> Plan[FastProposal]:
    if Excitation.SETPOINT not in excitations:
        return (yield from fast_by_relay(facts, options))
    relay_follows = Excitation.RELAY in excitations
    try:
        return (yield from by_pulses(facts, options, FAST, relay_follows))
    except TooLittleExcited as found:
        test, refused = found.test, found
    yield from test.report(Note(f"the relay follows, because the pulses tell too little: {refused.detail}"))
    if not (yield from _near_rest(test, facts)):
        away = test.trace.mv[-1] - test.point.mv
        raise Refused(
            refused.reason,
            f"{refused.detail}; and the relay cannot follow: MV stays {away:+.4g} from rest, and a relay "
            f"would jump further than the permitted {facts.mv_step_max:.4g}",
        ) from refused
    relay = RelayTest(facts, test.point, test.trace, options.amplitude, test.listened, options.begins_with)
    return (yield from by_relay(facts, options, relay))


def _near_rest(test: PulseTest, facts: Facts) -> Plan[bool]:
    """Brings MV so near to rest that the relay begins with a permitted jump: the integral may have moved MV far during
    the pulses. Returns False if MV does not come near in time."""
    maximum = MAX_AWAY * facts.mv_step_max

    def away() -> float:
        return abs(test.trace.mv[-1] - test.point.mv)

    if away() <= maximum:
        return True
    yield from test.report(
        Note(f"MV is {away():.4g} from rest: the set-point returns first, so that the relay does not jump too far")
    )
    yield from test.turn(0.0)
    home_s = facts.ramp_s(test.trace.sp[-1] - test.point.sp)
    longest = test.elapsed + (MAX_NEAR_T95 * facts.T95_s + home_s) / facts.sample_time_s
    while away() > maximum and test.elapsed < longest:
        yield from test.sample()
    return away() <= maximum
