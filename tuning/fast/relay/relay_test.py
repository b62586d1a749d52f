"""The biased relay test and the set-point step of the fast procedure, sample by sample, with their record."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from loopwright.tuning.experiments.half_wave import HalfWaves, has_moved
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, held, no_oscillation
from loopwright.tuning.fast.evaluation.proposal import RelayFigures
from loopwright.tuning.fast.experiment import VERIFICATION_PERIODS, Experiment
from loopwright.tuning.fast.record import MIN_SWITCHES, Excitation, ExperimentRecord, oscillation_period, period
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import (
    Command,
    Mode,
    Plan,
    Sample,
    SetGains,
    SetMode,
    SetOutput,
    SetRelay,
    SetSetpoint,
)
from loopwright.tuning.reasons import Reason, Refused

BIAS = 0.5
"""Ratio of the relay's lower amplitude to its higher one."""
FIRST_AMPLITUDE = 0.5
"""Fraction of the largest permitted amplitude with which the relay begins."""
HYSTERESIS = 2.2  # standard deviations of the noise
SAMPLES_AVERAGED = 3
MIN_HYSTERESIS = 1e-3
"""Smallest hysteresis as a fraction of the permitted set-point step, for a PV without noise."""
STALLED = 2.5
"""Time without a switch, in longest half periods, after which the amplitude of the present side is raised."""
RAISE_FACTOR, MAX_RAISE = 1.7, 2.0
MIN_OUTPUT_RANGE, GOOD_OUTPUT_RANGE = 25.0, 60.0
"""Smallest and desired range of PV under the relay, in standard deviations of the noise."""
MAX_OUTPUT_RANGE = 2.0
"""Largest range of PV under the relay, in permitted set-point steps."""
OF_PV_LIMITS = 0.9
"""Part of the way to the limits of PV to which a larger amplitude may take it."""
MAX_PERIODS = 8.4
MIN_MODEL_PERIOD = 0.5
"""Fraction of the relay's period below which the ultimate period of a model is not used."""


def max_amplitude(mv: float, mv_low: float, mv_high: float, mv_step_max: float = math.inf) -> float:
    """The largest amplitude of the higher side of a relay around `mv` that keeps MV within its limits, and its jumps
    within the largest permitted one, MV units."""
    return min(mv_high - mv, (mv - mv_low) / BIAS, mv_step_max / (1.0 + BIAS))


class RelayTest(Experiment):
    """The relay test and the set-point step that follows it.

    facts, point: what is known of the loop, and the operating point at rest.
    record: the samples so far, with which the record begins.
    amplitude: the amplitude of the relay's higher side, MV units; None for the default, adapted after the first wave.
    begins_with: the amplitude with which the default begins where its own is not to be, MV units; it is adapted too.
    at_rest: the number of samples at rest at the beginning of the record, where the relay follows another excitation;
    None where it is the first one.
    Raises Refused, BAD_LIMITS: an amplitude that MV does not permit.
    """

    def __init__(
        self,
        facts: Facts,
        point: OperatingPoint,
        record: Trace,
        amplitude: float | None,
        at_rest: int | None = None,
        begins_with: float | None = None,
    ) -> None:
        super().__init__(facts, point, record, at_rest)
        self._follows = at_rest is not None
        self._begun = 0
        """The number of samples before the relay."""
        self.switches: list[int] = []
        self._max = max_amplitude(point.mv, facts.mv_low, facts.mv_high, facts.mv_step_max)
        if amplitude is not None and not 0.0 < amplitude <= self._max:
            raise Refused(
                Reason.BAD_LIMITS, f"a relay amplitude of {amplitude:g} is asked for; MV permits up to {self._max:.4g}"
            )
        self._fixed = amplitude is not None
        self.amplitude = amplitude or min(begins_with or math.inf, FIRST_AMPLITUDE * self._max)
        self._sides = [BIAS, 1.0]  # low, high, in amplitudes
        self._high = True
        self._raise_at = 0
        self._goes_wrong = False
        self._half_waves = HalfWaves(facts, point, self.noise, self._hysteresis)

    def relay_figures(self) -> RelayFigures:
        """The figures of the relay test so far."""
        record = self.experiment_record()
        return RelayFigures(
            switches=record.turns,
            period_s=record.period * record.Ts,
            span=record.output_range,
            noise=self.noise,
            amplitude=self.amplitude,
            samples=len(record.y),
        )

    def relay(self, switches: int) -> Plan[bool]:
        """Runs the relay until it has switched this number of times; False if the time is over before that.

        Raises Refused, see `held`: otherwise CANNOT_OSCILLATE up to the second switch, STALLED before the fourth.
        """
        if not self.excited:
            self._begun = len(self.trace)
            if not self._follows:
                self.listened = self._begun
            self.excited = self.listened
            home = (SetSetpoint(self.point.sp),) if self._follows else ()
            self._commands = (*home, self._relay_command(), SetMode(Mode.EXPERIMENT))
        while len(self.switches) < switches:
            self._commands = self._on_sample((yield self._commands))
            if self._goes_wrong or self._time_is_over():
                if len(self.switches) < MIN_SWITCHES:
                    raise self._stalled()
                return False
        return True

    def step(self, gains: Gains, model_period: float) -> Plan[None]:
        """Puts the new gains in effect with an empty integral, then steps the set-point by at most half the range of
        PV under the relay.

        model_period: the ultimate period of the model, s; a load disturbance or the hysteresis prolongs the relay's own
        period.
        """
        relay_period = period(tuple(self.switches)) * self.facts.sample_time_s
        self._follow_s = VERIFICATION_PERIODS * min(max(model_period, MIN_MODEL_PERIOD * relay_period), relay_period)
        facts, point = self.facts, self.point
        output_range = self.experiment_record().output_range
        # with a set-point weight below one the integral moves MV as far a little later
        size = min(0.5 * output_range, self.amplitude / gains.Kp, facts.sp_deviation)
        self.excited = len(self.trace)
        self._gains_tried = gains
        self._commands = ()
        # A bumpless transfer from the relay would start the integral at the relay's output, which acts like a load
        # disturbance. The output is set to the proportional part first, so that the integral starts at rest.
        error = (point.pv - self.trace.pv[-1]) * (1.0 if facts.reverse else -1.0)
        low = max(facts.mv_low, self.trace.mv[-1] - facts.mv_step_max)
        high = min(facts.mv_high, self.trace.mv[-1] + facts.mv_step_max)
        output = min(max(point.mv + gains.Kp * error, low), high)
        self._add((yield (SetMode(Mode.MANUAL), SetOutput(output), SetGains(gains))))
        self._step = size
        yield from self._follow((SetMode(Mode.AUTOMATIC), SetSetpoint(point.sp + size)), output_range)

    def experiment_record(self) -> ExperimentRecord:
        """The record so far, as deviations from rest. Raises Refused as `ExperimentRecord` and `oscillation_period`."""
        return self._record(len(self.switches), oscillation_period(self.switches), Excitation.RELAY, self._control())

    def _on_sample(self, sample: Sample) -> tuple[Command, ...]:
        """Records one sample and returns the commands that follow from it."""
        trace = self.trace
        self._add(sample)
        at = len(trace) - 1
        if sample.mode != Mode.EXPERIMENT or self._stepping:
            return ()
        self._goes_wrong = self._half_waves.goes_wrong(sample.pv, self._high == self.facts.reverse)
        if self._goes_wrong and len(self.switches) < 2:
            raise self._half_waves.wrong_sign() if not self.switches else self._no_oscillation()
        high = sample.mv > self.point.mv
        if high != self._high:
            self._high = high
            self._half_waves.switched()
            self.switches.append(at)
            if len(self.switches) == 2 and not self._fixed:
                return self._adapted()
            if self._sides != [BIAS, 1.0]:
                self._sides = [BIAS, 1.0]
                return (self._relay_command(),)
        elif len(self.switches) >= 2:
            longest = max(np.diff([self._begun, *self.switches]))
            since = at - max(self.switches[-1], self._raise_at)
            if since > STALLED * longest:
                self._raise_at = at
                side = int(high)
                maximum = self._max * (1.0 if high else BIAS) / self.amplitude
                raised = min(RAISE_FACTOR * self._sides[side], MAX_RAISE * (1.0, BIAS)[not high], maximum)
                if raised > self._sides[side] and self._moved_since(self.switches[-1]):
                    self._sides[side] = raised
                    return (self._relay_command(),)
        return ()

    def _adapted(self) -> tuple[Command, ...]:
        """Adapts the amplitude after the first wave: up where PV hardly exceeds the noise, but has moved beyond it
        since the first switch, down where PV moved too far.

        Raises Refused, NO_RESPONSE: MV has switched, and PV stands still.
        """
        seen = float(np.ptp(self.trace.pv[self._begun :]))
        factor = 1.0
        if seen == 0.0:
            raise Refused(
                Reason.NO_RESPONSE,
                f"the relay of {self.amplitude:.4g} has switched twice, and PV is exactly {self.trace.pv[-1]:.6g} "
                f"all the time (noise {self.noise:.3g} before)",
            )
        if seen < MIN_OUTPUT_RANGE * self.noise and self._moved_since(self.switches[0]):
            factor = min(GOOD_OUTPUT_RANGE * self.noise / seen, self._max / self.amplitude, self._pv_permits())
        elif seen > MAX_OUTPUT_RANGE * self.facts.sp_deviation:
            factor = max(MAX_OUTPUT_RANGE * self.facts.sp_deviation, MIN_OUTPUT_RANGE * self.noise) / seen
        if 0.8 < factor < 1.25:
            return ()
        self.amplitude *= factor
        return (self._relay_command(),)

    def _pv_permits(self) -> float:
        """How many times the first wave PV may move within its limits."""
        wave, rest = self.trace.pv[self._begun :], self.point.pv
        up, down = max(wave) - rest, rest - min(wave)
        above, below = self.facts.pv_high - rest, rest - self.facts.pv_low
        ways = [OF_PV_LIMITS * room / gone for room, gone in ((above, up), (below, down)) if gone > 0.0]
        return max(1.0, min(ways, default=math.inf))

    def _relay_command(self) -> SetRelay:
        low, high = (self.amplitude * side for side in self._sides)
        average = SAMPLES_AVERAGED if self.noise > 0.0 else 1
        return SetRelay(high, self._hysteresis, self.point.mv, amplitude_low=low, average=average)

    @property
    def _hysteresis(self) -> float:
        return max(HYSTERESIS * self.noise, MIN_HYSTERESIS * self.facts.sp_deviation)

    def _moved_since(self, sample: int) -> bool:
        """Whether PV has moved beyond its noise since this sample."""
        return has_moved(self.trace.pv[sample:], self.noise, MIN_HYSTERESIS * self.facts.sp_deviation)

    def _time_is_over(self) -> bool:
        """Whether the time of the relay is over. The limit comes from T95 before the second switch, and from the half
        periods after it. Raises Refused before the second switch, see `no_oscillation`."""
        passed = len(self.trace) - self._begun
        if len(self.switches) < 2:
            if passed * self.facts.sample_time_s > max(3.0 * self.facts.T95_s, 40 * self.facts.sample_time_s):
                raise self._no_oscillation()
            return False
        halves = np.diff(self.switches)
        known = period(tuple(self.switches)) if len(halves) >= 2 else 2.0 * float(halves[0])
        return passed > MAX_PERIODS * max(known, 2.0 * float(np.max(halves)) if len(halves) < 3 else 0.0)

    def _no_oscillation(self) -> Refused:
        point = replace(self.point, room=self.amplitude)  # the message names the amplitude of the relay
        return no_oscillation(self.facts, point, self._since(), len(self.switches))

    def _since(self) -> Trace:
        trace, at = self.trace, self._begun
        return Trace(trace.t[at:], trace.sp[at:], trace.pv[at:], trace.mv[at:])

    def _stalled(self) -> Refused:
        passed = (len(self.trace) - self._begun) * self.facts.sample_time_s
        text = (
            f"the relay of {self.amplitude:.4g} switched {len(self.switches)} times in {passed:.4g} s, "
            f"{MIN_SWITCHES} are needed; PV is {self.trace.pv[-1] - self.point.pv:+.4g} away"
        )
        return held(self.facts, self.point, self._since(), text, Reason.STALLED)
