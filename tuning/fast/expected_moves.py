"""What the procedures move, without the computations between: driven on a model they tell how far PV will go.

The moves are those of the tests themselves (`RelayTest`, `PulseTest`, `ManualTest`, `KnownTrial`), with their sizes,
their turns and their adaptation. A procedure looks at its record between them; here each excitation goes on as long as
it may move PV further, and the step under the new gains follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.fast.experiment import Experiment, on_trial
from loopwright.tuning.fast.known_procedure import TRIAL, KnownTrial
from loopwright.tuning.fast.manual_procedure import MANUAL
from loopwright.tuning.fast.manual_test import ManualTest
from loopwright.tuning.fast.procedure import MIN_SAMPLES, SWITCHES, FastOptions
from loopwright.tuning.fast.pulse_test import BACK, DOWN, UP, PulseTest
from loopwright.tuning.fast.record import Excitation, noise_of
from loopwright.tuning.fast.relay_test import RelayTest
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model
from loopwright.tuning.plan import Mode, Plan, Sample, StageStarted

SEED = 1
LAST_LEVEL_TURNS = 2.0
"""How long the last level of the set-point is held, in times of the two turns before it: PV's swing is over by then."""


@dataclass(frozen=True, slots=True)
class NewGains:
    """The gains that a test on this model would design.

    gains: as they are tried. period_s: the ultimate period of the model, s. model: the model.
    """

    gains: Gains
    period_s: float
    model: Model


def rest(facts: Facts, noise: float, mode: Mode = Mode.AUTOMATIC) -> tuple[OperatingPoint, Trace]:
    """A loop at rest at SP, PV and MV of 0, and the samples of its rest, which end one sample before the time 0.

    noise: the standard deviation that a test estimates from these samples, PV units.
    """
    drawn = np.random.default_rng(SEED).normal(size=MIN_SAMPLES)
    pv = noise * (drawn - drawn.mean()) / noise_of(drawn)
    trace = Trace()
    for k, each in enumerate(pv):
        trace.add(Sample((k - MIN_SAMPLES) * facts.sample_time_s, 0.0, float(each), 0.0, int(mode)))
    room = min(facts.mv_high, -facts.mv_low, 0.5 * facts.mv_step_max)
    return OperatingPoint(0.0, 0.0, 0.0, noise, room), trace


def expected_moves(
    excitation: Excitation, facts: Facts, noise: float, options: FastOptions, new: NewGains | None, after_pulses: bool
) -> Plan[None]:
    """The moves of one excitation from rest, with those of the stages that follow it.

    facts: of a loop at rest at SP, PV and MV of 0. noise: its standard deviation, PV units.
    new: the gains of the step that follows; None where none does.
    after_pulses: whether the relay follows pulses of the set-point.
    Raises Refused as the tests do.
    """
    point, trace = rest(facts, noise, Mode.MANUAL if excitation is Excitation.MANUAL else Mode.AUTOMATIC)
    match excitation:
        case Excitation.OBSERVE:
            return (yield from _trial(KnownTrial(facts, point, trace, None), new))
        case Excitation.SETPOINT:
            pulses = PulseTest(facts, point, trace)
            yield from _pulses(pulses)
            return (yield from _step_home(pulses, new))
        case Excitation.MANUAL:
            return (yield from _manual(ManualTest(facts, point, trace)))
        case Excitation.RELAY:
            if not after_pulses:
                return (yield from _relay(RelayTest(facts, point, trace, options.amplitude), new))
            pulses = PulseTest(facts, point, trace)
            yield from _pulses(pulses)
            relay = RelayTest(facts, point, pulses.trace, options.amplitude, pulses.listened)
            return (yield from _relay(relay, new))


def _begins(test: Experiment, stage: str) -> Plan[None]:
    yield from test.report(StageStarted(stage, 0.0, 0.0))


def _trial(test: KnownTrial, new: NewGains | None) -> Plan[None]:
    if new is not None:
        yield from _begins(test, TRIAL)
        yield from test.step(new.gains, new.period_s)
        yield from test.step_home()


def _relay(test: RelayTest, new: NewGains | None) -> Plan[None]:
    yield from _begins(test, "relay")
    yield from test.relay(SWITCHES[-1])
    if new is not None:
        yield from _begins(test, "verify")
        yield from test.step(new.gains, new.period_s)
        yield from test.step_back()


def _pulses(test: PulseTest) -> Plan[None]:
    yield from _begins(test, "pulses")
    yield from test.start()
    yield from test.until_followed()
    yield from test.turn(BACK if test.facts.one_sided else DOWN)
    yield from test.until_followed()
    turned_at = test.elapsed
    yield from test.turn(UP)
    yield from test.lasting((1.0 + LAST_LEVEL_TURNS) * turned_at)
    test.period = float(turned_at)


def _step_home(test: PulseTest, new: NewGains | None) -> Plan[None]:
    if new is not None:
        yield from test.approach([new.model], new.gains, new.period_s)
        yield from _begins(test, "verify")
        yield from test.step(new.gains, new.period_s)
        yield from test.step_again()


def _manual(test: ManualTest) -> Plan[None]:
    yield from _begins(test, MANUAL)
    yield from test.start()
    yield from test.first()


def new_gains(gains: Gains, period_s: float, model: Model) -> NewGains:
    """The gains designed, as they are tried."""
    return NewGains(on_trial(gains), period_s, model)
