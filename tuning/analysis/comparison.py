"""Old and new gains side by side on the model found, and whether what was asked for gets better.

Asked for are bounds of robustness (Ms, and what else there is) and, under these, the least J: the criterion that the
procedure minimises. New gains are worth having where they restore a bound that the old ones pass, or bring J down, by
more than `MIN_GAIN` each; and never where no figure shown is better.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from loopwright.tuning.analysis.assessment import assess
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, integrators
from loopwright.tuning.reasons import Ended

MIN_GAIN = 0.05
"""Of a bound or of J, as a fraction: less is not worth a change of a loop that works."""
BAND = 0.05
"""Of settling, a fraction of the final change (load: of the peak)."""
SAME = 0.005
"""Figures that are so near, as a fraction, are called the same."""


@dataclass(frozen=True, slots=True)
class StepPerformance:
    """The answer to a unit step of the set-point (PV units), or of the load at the plant's input (MV units).

    IAE: integral of |error|, in units of PV over that of the step, times s; None where an offset stays.
    peak: largest change of PV.  settling_s: into 5 %; None where it is not within the response looked at.
    TV: total variation of MV, the effort.
    """

    IAE: float | None
    peak: float
    settling_s: float | None
    TV: float


@dataclass(frozen=True, slots=True)
class LoopPerformance:
    """What gains are worth on a model. Where the loop is not stable there are no figures.

    GM: ratio.  PM_deg: degrees; None where there is no such crossing.  noise_gain: MV's answer to a jump of PV.
    overshoot_pct: of a step of the set-point.
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


@dataclass(frozen=True, slots=True)
class RobustnessBounds:
    """Bounds of robustness; None: no bound. Ms, Mt, noise_gain: at most so much.  GM: at least so much.

    by: who asks, in words.
    """

    Ms: float
    Mt: float | None = None
    GM: float | None = None
    noise_gain: float | None = None
    by: str = "asked for"

    def worst(self, found: LoopPerformance) -> tuple[float, str]:
        """Of the bound that is passed farthest (or kept most narrowly): value over bound, and that in words."""
        return max(self._each(found))

    def _each(self, found: LoopPerformance) -> Iterator[tuple[float, str]]:
        for name, value, maximum in (
            ("Ms", found.Ms, self.Ms),
            ("Mt", found.Mt, self.Mt),
            ("noise gain", found.noise_gain, self.noise_gain),
        ):
            if value is not None and maximum is not None:
                yield value / maximum, f"{name} {value:.2f} ({self.by}: at most {maximum:.2f})"
        if found.GM is not None and self.GM is not None:
            yield self.GM / found.GM, f"GM {found.GM:.2f} ({self.by}: at least {self.GM:.2f})"


@dataclass(frozen=True, slots=True)
class Comparison:
    """before, after: old and new gains on the same model.  J_before, J_after: of the criterion, the less the better;
    None where it cannot be counted: the loop is not stable, or leaves an offset.  gain: what was asked for gets better
    by more than 5 %.  verdict: that in a sentence.
    """

    before: LoopPerformance
    after: LoopPerformance
    Ms_asked: float
    criterion: str
    J_before: float | None
    J_after: float | None
    gain: bool
    verdict: str


@dataclass(frozen=True, slots=True)
class Predicted:
    """Of the new gains on the model: Ms, GM (ratio), PM (degrees), set-point step figures (settling into 5 %).

    None where the loop has no such crossing, does not settle, or keeps an offset (IAE).
    """

    Ms: float
    GM: float | None
    PM_deg: float | None
    overshoot_pct: float
    settling_s: float | None
    IAE_per_unit: float | None


def loop_performance(model: Model, gains: Gains, sample_time_s: float = 0.0) -> LoopPerformance:
    """What these gains are worth on this model, which has the delay of the sampling in it already.

    An ideal derivative is taken as a controller of this sample time carries it out.
    """
    realised = gains
    if gains.Td > 0.0 and gains.Tf == 0.0:
        # a difference over one sample lags by half of it
        realised = replace(gains, Tf=0.5 * sample_time_s)
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
    )


def weighted_IAE(found: LoopPerformance, setpoint: float, load: float) -> float | None:
    """Half of the set-point's and half of the load's IAE, each over the one given."""
    if found.setpoint is None or found.load is None or found.setpoint.IAE is None or found.load.IAE is None:
        return None
    return 0.5 * found.setpoint.IAE / setpoint + 0.5 * found.load.IAE / load


def IAE_over_present(before: LoopPerformance, after: LoopPerformance) -> tuple[float | None, float | None]:
    """The same of both, over those of the old gains, where they have them."""
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
) -> Comparison:
    """J: of the old and of the new gains.  anyway: a proposal is wanted where there is no gain, too; the words differ.

    The new gains are stable: no procedure hands over others.
    """
    gain, words = _conclusion(before, after, asked, J)
    if not gain:
        end = "the new gains are proposed because that was asked for" if anyway else "the present gains are kept"
        words = f"Nothing asked for gets better by more than {100.0 * MIN_GAIN:.0f} %: {end}; {words}."
    return Comparison(before, after, asked.Ms, criterion, *J, gain, words)


def _conclusion(
    before: LoopPerformance, after: LoopPerformance, asked: RobustnessBounds, J: tuple[float | None, float | None]
) -> tuple[bool, str]:
    """Whether there is a gain, and a sentence, or the end of one where there is none."""
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
        falls = "" if now is None else f"; J falls by {100.0 * (1.0 - then / now):.0f} %"
        return True, f"{rest[0].upper()}{rest[1:]}{falls}."
    return False, rest


def _errors(before: LoopPerformance, after: LoopPerformance) -> str:
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
    """Of a stable loop; the less the better."""
    assert found.Ms is not None and found.overshoot_pct is not None and found.setpoint and found.load
    figures = [found.Ms, found.overshoot_pct, *(1.0 / margin if margin else 0.0 for margin in (found.GM, found.PM_deg))]
    for step in (found.setpoint, found.load):
        never = (math.inf if figure is None else figure for figure in (step.IAE, step.settling_s))
        figures += [*never, step.peak, step.TV]
    return figures


def _step(figures: StepFigures, offset: bool) -> StepPerformance:
    assert figures.TV is not None  # of a response with MV
    return StepPerformance(None if offset else figures.IAE, figures.peak, figures.settling_s, figures.TV)


def predicted(found: LoopPerformance) -> Predicted:
    """Of a stable loop."""
    assert found.Ms is not None and found.overshoot_pct is not None and found.setpoint is not None
    step = found.setpoint
    return Predicted(found.Ms, found.GM, found.PM_deg, found.overshoot_pct, step.settling_s, step.IAE)
