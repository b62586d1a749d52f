"""What the procedures move, without the computations between: driven on a model they tell how far PV will go.

The moves are those of the tests themselves (`RelayTest`, `PulseTest`, `ManualTest`, `KnownTrial`), with their sizes,
their turns and their adaptation. A procedure looks at its record between them; here each excitation goes on as long as
it may move PV further, and the step under the new gains follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.fast.evaluation.record_evaluation import first_period
from loopwright.tuning.fast.experiment import Experiment
from loopwright.tuning.fast.known_plant.procedure import TRIAL, KnownTrial
from loopwright.tuning.fast.manual.manual_test import ManualTest
from loopwright.tuning.fast.manual.procedure import MANUAL, MAX_PERIODS, MORE_REST, REST, WIDTHS
from loopwright.tuning.fast.pulses.pulse_test import PulseTest
from loopwright.tuning.fast.pulses.stage import turn_down, turn_up
from loopwright.tuning.fast.record import Excitation, noise_of
from loopwright.tuning.fast.relay.procedure import MIN_SAMPLES, SWITCHES, FastOptions
from loopwright.tuning.fast.relay.relay_test import RelayTest
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, TransferFunction
from loopwright.tuning.plan import Mode, Plan, Sample, StageStarted

SEED = 1
GAIN_SEEN_BY_PULSES, GAIN_SEEN_IN_MANUAL = 0.85, 0.9
"""The gain that a test may take the plant to have as it sizes its later moves, over what it is: the first response
shows it to 10 or 20 %."""
LAST_LEVEL_TURNS = (2.0, 0.0, 0.3, 0.7)
"""How long the last level of the set-point is held, in times of the two turns before it. After the longest PV's swing
is over. The pulses end as soon as the record tells enough, and the step under the new gains may begin anywhere in that
swing, which adds to it: the others are such moments."""


@dataclass(frozen=True, slots=True)
class NewGains:
    """The gains that a test on this model would design.

    gains: as they are tried. period_s: the ultimate period of the model, s.
    """

    gains: Gains
    period_s: float


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
    excitation: Excitation,
    facts: Facts,
    noise: float,
    options: FastOptions,
    model: Model,
    new: NewGains | None,
    after_pulses: bool = False,
    last_level_turns: float = LAST_LEVEL_TURNS[0],
) -> Plan[None]:
    """The moves of one excitation from rest, with those of the stages that follow it.

    facts: of a loop at rest at SP, PV and MV of 0. noise: its standard deviation, PV units.
    model: the model that the moves are driven on.
    new: the gains of the step that follows; None where none does.
    after_pulses: whether the relay follows pulses of the set-point.
    last_level_turns: how long pulses of the set-point hold their last level, one of LAST_LEVEL_TURNS.
    Raises Refused as the tests do.
    """
    point, trace = rest(facts, noise, Mode.MANUAL if excitation is Excitation.MANUAL else Mode.AUTOMATIC)
    match excitation:
        case Excitation.OBSERVE:
            return (yield from _trial(KnownTrial(facts, point, trace, None), new))
        case Excitation.SETPOINT:
            pulses = PulseTest(facts, point, trace)
            yield from _pulses(pulses, _seen(model, GAIN_SEEN_BY_PULSES), last_level_turns)
            return (yield from _step_home(pulses, model, new))
        case Excitation.MANUAL:
            return (yield from _manual(ManualTest(facts, point, trace), _seen(model, GAIN_SEEN_IN_MANUAL)))
        case Excitation.RELAY:
            if not after_pulses:
                relay = RelayTest(facts, point, trace, options.amplitude, begins_with=options.begins_with)
                return (yield from _relay(relay, new))
            pulses = PulseTest(facts, point, trace)
            yield from _pulses(pulses, _seen(model, GAIN_SEEN_BY_PULSES), last_level_turns)
            relay = RelayTest(facts, point, pulses.trace, options.amplitude, pulses.listened, options.begins_with)
            return (yield from _relay(relay, new))


def _seen(model: Model, gain: float) -> Model:
    return TransferFunction(tuple(gain * each for each in model.num), model.den, model.L)


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


def _pulses(test: PulseTest, model: Model, last_level_turns: float) -> Plan[None]:
    yield from _begins(test, "pulses")
    yield from test.start()
    yield from test.until_followed()
    yield from turn_down(test, [model])
    yield from test.until_followed()
    turned_at = test.elapsed
    yield from turn_up(test, [model])
    yield from test.lasting((1.0 + last_level_turns) * turned_at)
    test.period = float(turned_at)


def _step_home(test: PulseTest, model: Model, new: NewGains | None) -> Plan[None]:
    if new is not None:
        yield from test.approach([model], new.gains, new.period_s)
        yield from _begins(test, "verify")
        yield from test.step(new.gains, new.period_s)
        yield from test.step_again()


def _manual(test: ManualTest, model: Model) -> Plan[None]:
    yield from _begins(test, MANUAL)
    yield from test.start()
    yield from test.first()
    period = first_period(*test.columns(), test.facts.sample_time_s)
    longest = test.elapsed + MAX_PERIODS * period
    for width in WIDTHS:
        while not (yield from test.pulse(max(1, round(width * period)), [model])):
            if test.elapsed > longest:
                return
            yield from test.resting(MORE_REST * period)
        yield from test.resting(REST * period)
