"""The comparison of old and new gains on one model, and the conclusion whether the new gains are an improvement.

The user asks for bounds of robustness (Ms and others) and, under these, for the smallest J, the criterion that the
procedure minimises. New gains are an improvement where they restore a bound that the previous gains violate, or lower
J, by more than `MIN_GAIN` each; they are none where no figure shown is better.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

from loopwright.tuning.analysis.assessment import assess
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, integrators
from loopwright.tuning.reasons import Ended

MIN_GAIN = 0.05
"""Smallest relative improvement of a bound or of J that justifies a change of a loop that works."""
BAND = 0.05
"""Settling band, as a fraction of the final change (after a load disturbance: of the peak)."""
OVERSHOOT_UNIT_PCT = 20.0
"""Overshoot beyond its bound, percent of the set-point step, that counts as much as a bound that is exceeded twofold:
one percent as much as MIN_GAIN."""
SAME = 0.005
"""Relative difference below which two figures are called the same."""


@dataclass(frozen=True, slots=True)
class StepPerformance:
    """The answer to a unit set-point step (PV units), or to a unit load disturbance at the plant's input (MV units).

    IAE: the integral of |error|, in PV units per unit of the step, times s; None where an offset stays.
    peak: the largest change of PV.
    settling_s: the time until PV stays within 5 %, s; None where the simulated response ends before that.
    TV: the total variation of MV.
    mv_peak: the largest change of MV.
    """

    IAE: float | None
    peak: float
    settling_s: float | None
    TV: float
    mv_peak: float


@dataclass(frozen=True, slots=True)
class LoopPerformance:
    """The figures of one set of gains on a model; an unstable loop has none.

    gains, stable: the gains, and whether their loop is stable.
    Ms, Mt: the peaks of |1/(1+L)| and |L/(1+L)|.
    GM: the gain margin, a ratio; None where there is no phase crossover.
    PM_deg: the phase margin, degrees; None where there is no gain crossover.
    delay_margin_s: the further dead time at which the loop becomes unstable, s; None where there is none.
    noise_gain: the answer of MV to a jump of PV, MV units per PV unit.
    overshoot_pct: the overshoot after a set-point step, percent.
    setpoint, load: the figures of the set-point step and of the load disturbance.
    """

    gains: Gains
    stable: bool
    Ms: float | None = None
    Mt: float | None = None
    GM: float | None = None
    PM_deg: float | None = None
    noise_gain: float | None = None
    overshoot_pct: float | None = None
    setpoint: StepPerformance | None = None
    load: StepPerformance | None = None
    delay_margin_s: float | None = None


class _HasIAE(Protocol):
    @property
    def IAE(self) -> float | None: ...


class _Compared(Protocol):
    """The part of a `LoopPerformance` that a sentence compares."""

    @property
    def stable(self) -> bool: ...

    @property
    def Ms(self) -> float | None: ...

    @property
    def setpoint(self) -> _HasIAE | None: ...

    @property
    def load(self) -> _HasIAE | None: ...


@dataclass(frozen=True, slots=True)
class RobustnessBounds:
    """The bounds of robustness that a design must keep; None is no bound.

    Ms, Mt, noise_gain: the largest permitted values.
    overshoot_pct: the largest permitted overshoot after a set-point step, percent.
    settling_s, mv_peak: the longest settling time (into 5 %, s) and the largest change of MV (MV units per PV unit)
    after a set-point step.
    GM: the smallest permitted gain margin.
    by: who asks for the bounds, in words.
    """

    Ms: float
    Mt: float | None = None
    GM: float | None = None
    noise_gain: float | None = None
    overshoot_pct: float | None = None
    settling_s: float | None = None
    mv_peak: float | None = None
    by: str = "asked for"

    def worst(self, found: LoopPerformance) -> tuple[float, str]:
        """The bound that is violated most, or kept most narrowly: the ratio of value to bound, and the same in
        words."""
        return max(self._each(found))

    def _each(self, found: LoopPerformance) -> Iterator[tuple[float, str]]:
        for name, value, maximum in (
            ("Ms", found.Ms, self.Ms),
            ("Mt", found.Mt, self.Mt),
            ("noise gain", found.noise_gain, self.noise_gain),
        ):
            if value is not None and maximum is not None:
                yield value / maximum, f"{name} {value:.2f} ({self.by}: at most {maximum:.2f})"
        if found.setpoint is not None and self.settling_s is not None:
            settled = math.inf if found.setpoint.settling_s is None else found.setpoint.settling_s
            words = "no end of settling" if settled == math.inf else f"a settling time of {settled:.3g} s"
            yield settled / self.settling_s, f"{words} ({self.by}: at most {self.settling_s:.4g} s)"
        if found.setpoint is not None and self.mv_peak is not None:
            peak = found.setpoint.mv_peak
            words = f"a movement of MV of {peak:.3g} for each PV unit"
            yield peak / self.mv_peak, f"{words} ({self.by}: at most {self.mv_peak:.4g})"
        if found.GM is not None and self.GM is not None:
            yield self.GM / found.GM, f"GM {found.GM:.2f} ({self.by}: at least {self.GM:.2f})"
        if found.overshoot_pct is not None and self.overshoot_pct is not None:
            # a bound near zero has no ratio that means anything
            past = (found.overshoot_pct - self.overshoot_pct) / OVERSHOOT_UNIT_PCT
            yield 1.0 + past, f"overshoot {found.overshoot_pct:.1f} % ({self.by}: at most {self.overshoot_pct:g} %)"


@dataclass(frozen=True, slots=True)
class Comparison:
    """The comparison of old and new gains.

    previous, new: the figures of the old and of the new gains on the same model.
    Ms_asked: the largest permitted Ms.
    settling_s_asked, mv_peak_asked, noise_gain_asked: the largest permitted ones, see `RobustnessBounds`; None where
    none was asked for.
    criterion: the criterion J in words.
    J_previous, J_new: the values of J, the lower the better; None where the loop is not stable or leaves an offset.
    gain: True if what was asked for improves by more than 5 %.
    verdict: the conclusion in a sentence.
    """

    previous: LoopPerformance
    new: LoopPerformance
    Ms_asked: float
    criterion: str
    J_previous: float | None
    J_new: float | None
    gain: bool
    verdict: str
    settling_s_asked: float | None = None
    mv_peak_asked: float | None = None
    noise_gain_asked: float | None = None


@dataclass(frozen=True, slots=True)
class Predicted:
    """The main figures of gains on a model, as predicted.

    Ms: the maximum sensitivity.
    GM, PM_deg: the gain margin (a ratio) and the phase margin (degrees); None where there is no such crossover.
    overshoot_pct, settling_s: the overshoot (percent) and the settling time into 5 % (s) of a set-point step; None
    where PV does not settle.
    IAE_per_unit: the IAE of a unit set-point step, s; None where an offset stays.
    """

    Ms: float
    GM: float | None
    PM_deg: float | None
    overshoot_pct: float
    settling_s: float | None
    IAE_per_unit: float | None


def as_sampled(gains: Gains, sample_time_s: float) -> Gains:
    """The gains as a controller of this sample time (s) carries them out: an ideal derivative is a difference over one
    sample, which lags by half of it."""
    return replace(gains, Tf=0.5 * sample_time_s) if gains.Td > 0.0 and gains.Tf == 0.0 else gains


def loop_performance(model: Model, gains: Gains, sample_time_s: float = 0.0) -> LoopPerformance:
    """The figures of these gains on this model, whose dead time includes the delay of the sampling.

    An ideal derivative is taken as a controller of this sample time (s) carries it out.
    """
    realised = as_sampled(gains, sample_time_s)
    try:
        found = assess(model, realised, band=BAND)
    except Ended:  # its response leaves all bounds
        return LoopPerformance(gains, False)
    m, setpoint, load = found.margins, found.setpoint, found.load
    if setpoint is None or load is None:
        return LoopPerformance(gains, False)
    jump = math.inf if realised.Td > 0.0 and realised.Tf == 0.0 else 1.0
    if realised.Tf > 0.0:
        jump += realised.Td / realised.Tf
    # without integral action an offset stays, and the integral of the error grows with the record
    offset = gains.Ti == 0.0
    return LoopPerformance(
        gains=gains,
        stable=True,
        Ms=m.Ms,
        Mt=m.Mt,
        GM=m.GM,
        PM_deg=m.PM_deg,
        noise_gain=gains.Kp * jump,
        overshoot_pct=setpoint.overshoot_pct,
        setpoint=_step(setpoint, offset and not integrators(model)),
        load=_step(load, offset),
        delay_margin_s=m.delay_margin_s,
    )


def setpoint_performance(model: Model, gains: Gains) -> StepPerformance | None:
    """The answer to a set-point step alone, as `loop_performance` has it; None where the loop is unstable."""
    try:
        return _step(step_figures(model, gains, band=BAND), gains.Ti == 0.0 and not integrators(model))
    except Ended:
        return None


def weighted_IAE(found: LoopPerformance, setpoint: float, load: float, share: float = 0.5) -> float | None:
    """A share of the IAE of the set-point step and the rest of that of the load disturbance, each divided by the value
    given; None where there is no such IAE. share: half and half by default."""
    if found.setpoint is None or found.load is None or found.setpoint.IAE is None or found.load.IAE is None:
        return None
    return share * found.setpoint.IAE / setpoint + (1.0 - share) * found.load.IAE / load


def IAE_over_present(before: LoopPerformance, after: LoopPerformance) -> tuple[float | None, float | None]:
    """The weighted IAE of old and new gains, divided by the IAE of the previous gains, or of the new ones where the
    old have none."""
    for each in (before, after):
        if each.setpoint and each.load and each.setpoint.IAE and each.load.IAE:
            over = each.setpoint.IAE, each.load.IAE
            return weighted_IAE(before, *over), weighted_IAE(after, *over)
    return None, None


def compare(
    before: LoopPerformance,
    after: LoopPerformance,
    asked: RobustnessBounds,
    criterion: str,
    J: tuple[float | None, float | None],
    anyway: bool = False,
    keep_setpoint: bool = False,
) -> Comparison:
    """The comparison of the figures of old and new gains. The new gains are stable: no procedure hands over others.

    asked: the bounds of robustness.
    criterion: the criterion J in words.
    J: the values of J of the old and of the new gains.
    anyway: a proposal is wanted even without an improvement; only the conclusion's words differ.
    keep_setpoint: where the present gains keep all bounds, new gains with more than 5 % more IAE after a set-point step
    are no improvement, whatever they bring after a load disturbance.
    """
    gain, words = _conclusion(before, after, asked, J)
    if gain and keep_setpoint and (worse := _worse_setpoint(before, after, asked)) is not None:
        end = "they are proposed because that was asked for" if anyway else "the present gains are kept"
        words = f"The new gains would make a good answer to the set-point worse by {worse}, and {end}; {words}"
        gain = False
    elif not gain:
        end = "the new gains are proposed because that was asked for" if anyway else "the present gains are kept"
        words = f"Nothing asked for gets better by more than {100.0 * MIN_GAIN:.0f} %: {end}; {words}."
    also = asked.settling_s, asked.mv_peak, asked.noise_gain
    return Comparison(before, after, asked.Ms, criterion, *J, gain, words, *also)


def _conclusion(
    before: LoopPerformance, after: LoopPerformance, asked: RobustnessBounds, J: tuple[float | None, float | None]
) -> tuple[bool, str]:
    """Whether there is an improvement, and the conclusion: a sentence, or only its last part without an improvement."""
    Ms, wanted = after.Ms, f"{asked.by}: at most {asked.Ms:.2f}"
    if not before.stable:
        return True, f"The present gains are not stable on the model found; the new ones have Ms {Ms:.2f} ({wanted})."
    past, words = asked.worst(before)
    rest = f"{_errors(before, after)}; Ms {before.Ms:.2f} now, {Ms:.2f} with the new gains ({wanted})"
    better = _better(before, after)
    if better and past > 1.0 + MIN_GAIN and asked.worst(after)[0] * (1.0 + MIN_GAIN) < past:
        return True, f"The present gains have {words}, the new ones {asked.worst(after)[1]}; {_errors(before, after)}."
    now, then = J
    if better and then is not None and (now is None or then * (1.0 + MIN_GAIN) < now):
        falls = "" if now is None or asked.settling_s else f"; J falls by {100.0 * (1.0 - then / now):.0f} %"
        return True, f"{rest[0].upper()}{rest[1:]}{falls}."
    return False, rest


def beside(before: _Compared, after: _Compared) -> str:
    """How gains, which are stable, compare with those before a test: a sentence that holds whichever are in effect."""
    if not before.stable:
        return f"The gains before are not stable on this model; these have Ms {after.Ms:.2f}."
    errors = _errors(before, after)
    return f"Beside the gains before, {errors}; Ms {before.Ms:.2f} before, {after.Ms:.2f} with these gains."


def _worse_setpoint(before: LoopPerformance, after: LoopPerformance, asked: RobustnessBounds) -> str | None:
    """By how much the new gains raise the IAE after a set-point step, in words, where the present gains keep all bounds
    and that is more than 5 %; None elsewhere."""
    if before.setpoint is None or after.setpoint is None or asked.worst(before)[0] > 1.0 + MIN_GAIN:
        return None
    now, then = before.setpoint.IAE, after.setpoint.IAE
    if now is None or then is None or then <= now * (1.0 + MIN_GAIN):
        return None
    return f"{100.0 * (then / now - 1.0):.0f} % of IAE"


def _errors(before: _Compared, after: _Compared) -> str:
    assert before.load and after.load and before.setpoint and after.setpoint
    load, setpoint = (_change(a.IAE, b.IAE) for a, b in ((before.load, after.load), (before.setpoint, after.setpoint)))
    return f"load disturbances are corrected with {load} integral error (IAE), steps of the set-point with {setpoint}"


def _change(before: float | None, after: float | None) -> str:
    if after is None:
        return "a lasting"
    if before is None:
        return "no longer a lasting"
    change = after / before - 1.0
    if abs(change) < SAME:
        return "the same"
    return f"{100.0 * abs(change):.0f} % {'less' if change < 0.0 else 'more'}"


def _better(before: LoopPerformance, after: LoopPerformance) -> bool:
    """Whether any figure shown is better with the new gains."""
    return any(new < old * (1.0 - SAME) for old, new in zip(_figures(before), _figures(after), strict=True))


def _figures(found: LoopPerformance) -> list[float]:
    """The figures of a stable loop that are compared; the lower the better."""
    assert found.Ms is not None and found.overshoot_pct is not None and found.setpoint and found.load
    figures = [found.Ms, found.overshoot_pct, *(1.0 / margin if margin else 0.0 for margin in (found.GM, found.PM_deg))]
    for step in (found.setpoint, found.load):
        never = (math.inf if figure is None else figure for figure in (step.IAE, step.settling_s))
        figures += [*never, step.peak, step.TV]
    return figures


def _step(figures: StepFigures, offset: bool) -> StepPerformance:
    assert figures.TV is not None and figures.peak_u is not None  # of a response with MV
    return StepPerformance(
        None if offset else figures.IAE, figures.peak, figures.settling_s, figures.TV, figures.peak_u
    )


def predicted(found: LoopPerformance) -> Predicted:
    """The main figures of a stable loop."""
    assert found.Ms is not None and found.overshoot_pct is not None and found.setpoint is not None
    step = found.setpoint
    return Predicted(found.Ms, found.GM, found.PM_deg, found.overshoot_pct, step.settling_s, step.IAE)
