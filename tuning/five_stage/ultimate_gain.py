"""Stage 2 finds the ultimate gain and period by P control.

Each run makes a set-point step under a P controller and measures whether the oscillation grows or decays. The growth
per period is fitted (`tuning.identification.oscillation`). The sign tables of the paper become a bracket, and the next
gain comes from the measured growth (false position on ln K, kept inside the bracket) instead of a sweep. The result is
the same, a gap below 1 %, after two to five runs, and no gain far above Ku is tried on the plant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, same, to_rest
from loopwright.tuning.five_stage.relay import RelayResult
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.oscillation import Growth, fit_growth
from loopwright.tuning.plan import Mode, Note, Plan, SetGains, SetMode, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

GAP = 0.01
EQUAL = 0.002
"""Growth per period below which the oscillation counts as undamped: 0.1 % of Ku on a plant of this class."""
SLOPE = 2.5
"""d ln(growth per period) / d ln K near Ku for a FOPDT plant with L/T = 0.5; a start value only."""
MAX_RUNS = 16
KICK, NOISY_KICK = 0.25, 0.45
"""First kick of the step as a fraction of the room for MV, without and with noise. Gains stay near Ku, so MV stays
within its room."""
RUN_MV_LIMIT = 0.98
"""Move of MV, as a fraction of its room, at which a run is ended."""
UNCERTAIN = 0.05
"""Noise, as a fraction of the step, above which noise sustains the oscillation and Ku is uncertain."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run under P control.

    K: the gain, MV units per PV unit.
    growth: the logarithm of the growth of the oscillation per period.
    error: the standard error of `growth`.
    period_s, duration_s: the period of the oscillation and the duration of the run, s.
    ended: why the run ended.
    """

    K: float
    growth: float
    error: float
    period_s: float
    duration_s: float
    ended: str


@dataclass(frozen=True, slots=True)
class UltimateResult:
    """The ultimate point, as measured.

    Ku: the ultimate gain, MV units per PV unit.
    Pu_s: the ultimate period, s.
    gap: the relative width of the last bracket.
    static_gain: the static gain from the offsets under P control, PV units per MV unit, signed.
    step: the set-point step of the runs, PV units.
    runs: all runs.
    """

    Ku: float
    Pu_s: float
    gap: float
    static_gain: float
    step: float
    runs: tuple[Run, ...]


def ultimate_gain(facts: Facts, point: OperatingPoint, rough: RelayResult) -> Plan[UltimateResult]:
    """Finds the ultimate point, starting from the result of the relay test. Raises Refused: NO_BRACKET,
    NOISE_TOO_HIGH."""
    step = KICK * point.room / rough.Ku_a
    step = min(facts.sp_deviation, step if point.noise < UNCERTAIN / 2 * step else NOISY_KICK / KICK * step)
    if point.noise > UNCERTAIN * step:
        yield (Note(f"noise {point.noise:.3g} is {point.noise / step:.0%} of the P runs' step: Ku will be uncertain"),)
    runs: list[Run] = []
    statics: list[float] = []
    low: Run | None = None
    high: Run | None = None
    K = rough.Ku_a
    while True:
        run, mean = yield from _p_run(facts, point, K, step, runs[-1].period_s if runs else rough.Pu_a_s)
        runs.append(run)
        yield (Note(f"P run {len(runs)}: K = {K:.4g}, growth {run.growth:+.2%} per period ({run.ended})"),)
        offset = mean - point.pv
        if 0 < offset < step and run.ended != "mv limit":
            statics.append(offset / (step - offset) / K)
        yield from to_rest(facts, point, 0.03 * step)
        if run.growth < 0:
            low = run if low is None or run.K > low.K else low
        else:
            high = run if high is None or run.K < high.K else high
        if low and high and low.K > high.K:  # noise turned a sign near Ku: believe the newer run
            low, high = (run, None) if run.growth < 0 else (None, run)
        equal = abs(run.growth) <= max(EQUAL, 2 * run.error) and run.error < 0.02 and run.ended != "mv limit"
        if equal or (low and high and (high.K - low.K) / low.K < GAP):
            break
        if len(runs) == MAX_RUNS or not rough.Ku_a / 8 < K < rough.Ku_a * 8:
            tried = ", ".join(f"{r.K:.3g}: {r.growth:+.1%}" for r in runs)
            raise Refused(Reason.NO_BRACKET, f"after {len(runs)} runs (gain: growth per period) {tried}")
        K = _next_gain(runs, low, high)
    gap = (high.K - low.K) / low.K if low and high else math.inf
    if gap < GAP and low and high:
        share = -low.growth / (high.growth - low.growth) if high.growth > low.growth else 0.5
        Ku = low.K * (high.K / low.K) ** share
        Pu = low.period_s + share * (high.period_s - low.period_s)
    else:
        Ku, Pu = run.K * math.exp(-run.growth / SLOPE), run.period_s
    static = float(np.median(statics)) if statics else math.nan
    return UltimateResult(Ku, Pu, gap, static if facts.reverse else -static, step, tuple(runs))


def _next_gain(runs: list[Run], low: Run | None, high: Run | None) -> float:
    """The gain of the next run: a little beyond the gain at which the growth should be zero, so that the bracket closes
    from both sides."""
    last = runs[-1]
    slope = SLOPE
    if len(runs) > 1:
        other = min(runs[:-1], key=lambda r: abs(math.log(r.K / last.K)))
        if other.K != last.K:
            slope = min(8.0, max(0.8, (last.growth - other.growth) / math.log(last.K / other.K)))
    beyond = math.copysign(min(0.004, 0.2 * abs(last.growth)), -last.growth)
    factor = math.exp(min(0.6, max(-0.6, -last.growth / slope + beyond)))
    K = last.K * factor
    if low and high and not low.K * 1.0005 < K < high.K / 1.0005:
        K = math.sqrt(low.K * high.K)
    return K


def _p_run(facts: Facts, point: OperatingPoint, K: float, step: float, period: float) -> Plan[tuple[Run, float]]:
    """One run under P control, and the mean of PV in it.

    The run ends when the sign of the growth is clear twice in a row, at the latest after max(1.2 T95, 6 periods).
    """
    target = point.sp + step
    sample = yield (SetGains(Gains(Kp=K)), SetMode(Mode.AUTOMATIC), SetSetpoint(target))
    while not same(sample.sp, target) or sample.mode != Mode.AUTOMATIC:
        sample = yield ()
    trace = Trace()
    start = sample.t
    longest = max(1.2 * facts.T95_s, 6 * period)
    ask = start + 2.5 * period
    limit = RUN_MV_LIMIT * point.room
    before: Growth | None = None
    growth: Growth | None = None
    ended = "time"
    at_limit = 0
    while sample.t - start < longest:
        trace.add(sample)
        if sample.t - start > 0.5 * period and abs(sample.mv - point.mv) > limit:
            at_limit += 1
            if at_limit * facts.sample_time_s > 0.02 * period:
                ended = "mv limit"
                break
        if sample.t >= ask:
            ask += 0.5 * period
            growth = _growth(trace, start + period, period)
            clear = abs(growth.log_per_period) > max(0.02, 5 * growth.error)
            if clear and before and growth.log_per_period * before.log_per_period > 0:
                ended = "clear"
                break
            before = growth
        sample = yield ()
    if ended == "mv limit":
        growth_per_period = growth.log_per_period if growth else 0.0
        mean = growth.mean if growth else point.pv
        return Run(K, max(0.05, growth_per_period), math.inf, period, sample.t - start, ended), mean
    if ended == "time":
        growth = _growth(trace, start + period, period)
    assert growth is not None
    if not 0.5 < growth.period / period < 2 or growth.amplitude < 2 * growth.noise / math.sqrt(len(trace)):
        return Run(K, -0.5, 0.1, period, sample.t - start, "died out"), growth.mean
    return Run(K, growth.log_per_period, growth.error, growth.period, sample.t - start, ended), growth.mean


def _growth(trace: Trace, since: float, period: float) -> Growth:
    """The growth of the oscillation over at most the last four periods; earlier samples show only the transient.

    since: the plant time from which samples are used, s.
    """
    t = np.asarray(trace.t)
    keep = t >= max(since, t[-1] - 4 * period)
    return fit_growth(t[keep], np.asarray(trace.pv)[keep], period)
