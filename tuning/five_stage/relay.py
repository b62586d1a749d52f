"""Stage 1 is a relay test, which gives a rough ultimate gain and period.

The relay runs inside the controller, centred on the present output. Ku_a = |U1| / |Y1| comes from the first harmonics
of MV and PV over the last cycles. With an ideal relay this is the describing function 4d/(pi a), and it stays right
with hysteresis and noise (the paper's `max(P) - SP` does not). The paper's parallel path, Ts/10 * e, is left out: its
weight depends on the unit of PV, and added to the relay it leaves the permitted range of MV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.half_wave import HalfWaves
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, no_oscillation, to_rest
from loopwright.tuning.identification.oscillation import harmonic
from loopwright.tuning.plan import Mode, Plan, SetMode, SetRelay
from loopwright.tuning.reasons import Reason, Refused

STEADY = 0.10
MIN_SAMPLES_PER_PERIOD = 22


@dataclass(frozen=True, slots=True)
class RelayResult:
    """The result of the relay test.

    Ku_a: the approximate ultimate gain, MV units per PV unit.
    Pu_a_s: the approximate ultimate period, s.
    amplitude: the amplitude of PV, PV units.
    relay: the amplitude of the relay, MV units.
    hysteresis: the hysteresis of the relay, PV units.
    cycles: the number of cycles.
    """

    Ku_a: float
    Pu_a_s: float
    amplitude: float
    relay: float
    hysteresis: float
    cycles: int


def relay_test(facts: Facts, point: OperatingPoint) -> Plan[RelayResult]:
    """The relay test, until its oscillation is steady. Raises Refused: WRONG_SIGN, NO_RESPONSE, CANNOT_OSCILLATE."""
    d = point.room
    hysteresis = 3 * point.noise
    sample = yield (SetRelay(d, hysteresis, point.mv), SetMode(Mode.EXPERIMENT))
    trace = Trace()
    start = sample.t
    ups: list[int] = []
    was_high = True
    half_waves = HalfWaves(facts, point, point.noise, hysteresis)
    switches = 0
    while True:
        trace.add(sample)
        if sample.mode == Mode.EXPERIMENT:
            high = sample.mv > point.mv
            if high != was_high:
                half_waves.switched()
                switches += 1
            if half_waves.goes_wrong(sample.pv, high == facts.reverse):
                raise no_oscillation(facts, point, trace, len(ups)) if switches else half_waves.wrong_sign()
            if high and not was_high:
                ups.append(len(trace) - 1)
                if _steady(trace, ups):
                    break
            was_high = high
        last = trace.t[ups[-1]] if ups else start
        if sample.t - last > max(3 * facts.T95_s, 40 * facts.sample_time_s) or len(ups) > 120:
            raise no_oscillation(facts, point, trace, len(ups))
        sample = yield ()
    first, end = ups[-4], ups[-1]
    t, pv, mv = (np.asarray(column[first:end]) for column in (trace.t, trace.pv, trace.mv))
    period = (trace.t[end] - trace.t[first]) / 3
    if period < MIN_SAMPLES_PER_PERIOD * facts.sample_time_s:
        raise Refused(
            Reason.CANNOT_OSCILLATE,
            f"under the relay PV oscillates with a period of {period:.3g} s, {period / facts.sample_time_s:.1f} "
            "samples: there is no ultimate point slower than the sampling",
        )
    amplitude = abs(harmonic(t, pv, period))
    if amplitude < 2 * point.noise or amplitude == 0:
        raise Refused(
            Reason.NO_RESPONSE, f"the relay of {d:.3g} moved PV by {amplitude:.3g} only (noise {point.noise:.3g})"
        )
    rough = abs(harmonic(t, mv, period)) / amplitude
    yield from to_rest(facts, point, 0.02 * facts.sp_deviation)
    return RelayResult(rough, period, amplitude, d, hysteresis, len(ups))


def _steady(trace: Trace, ups: list[int]) -> bool:
    """Whether the last three cycles agree within 10 % in height and period (the third closes the paper's 3 L).

    ups: the samples at which the relay switched up.
    """
    if len(ups) < 5:
        return False
    heights = [max(trace.pv[a:b]) - min(trace.pv[a:b]) for a, b in zip(ups[-4:-1], ups[-3:], strict=True)]
    periods = [trace.t[b] - trace.t[a] for a, b in zip(ups[-4:-1], ups[-3:], strict=True)]
    dt = trace.t[-1] - trace.t[-2]
    return max(heights) - min(heights) <= STEADY * max(heights) and max(periods) - min(periods) <= max(
        STEADY * max(periods), 2 * dt
    )
