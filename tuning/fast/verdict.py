"""Identification, design and verdict of a fast record in one call."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from loopwright.tuning.fast.design import Best, Design, DesignSpec
from loopwright.tuning.fast.record import Evidence
from loopwright.tuning.fast.structure_choice import Chosen, choose
from loopwright.tuning.fast.uncertainty import colour, difference_of_rivals, peak, uncertainty_of_Ms
from loopwright.tuning.fast.valve_faults import suspect
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.models import TransferFunction

MAX_RESIDUAL, UNIMPORTANT = 1.35, 0.004
"""Of the residual: in noises at rest; in spans of PV, below which it does not matter."""
MAX_COLOUR = 1.35
MAX_ROUNDED = 1.25
"""Of what rounding leaves on average, which is not quite random and not white."""
MAX_UNCERTAINTY = 0.10
"""Of Ms, by the delta method and among the rivals."""
SURPRISE, SURPRISE_OF_A_STORY = 0.5, 0.2
"""Of Ms from what was asked, of the tested controller on the new model and the new one on the earlier model; where the
load is said to have moved twice."""
WITH_A_STEP = (0.15, 0.8)
"""Periods before and after the step of the set-point, within which a load is said to have come with it."""
LATE, ALIKE = 0.5, 0.3
"""Periods: a load so shortly before the step need not have shown in the relay, and if it has not, it may as well be a
plant that has changed; two that are so near are the same."""
REDRAWN = 1.5
"""Times by which the tested gains may change where a load is said to have come with them."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """cause: the value of the reason why the result is not to be trusted, None if it is.

    model: without the delay of the sampling, which is in `design_delay` (s).  Ms: on the model.
    uncertainty, ambiguity: of Ms.  residual: its rms in noises at rest.  period: ultimate, of the model, s.
    """

    cause: str | None
    detail: str
    model: TransferFunction
    structure: str
    best: Best
    Ms: float
    uncertainty: float
    ambiguity: float
    residual: float
    chosen: Chosen
    fit: Fit[Evidence]
    design_delay: float
    period: float


def evaluate(evidence: Evidence, spec: DesignSpec, earlier: Evaluation | None = None) -> Evaluation:
    """earlier: of a first part of the record, whose gains were tested in the rest of it.

    Raises Refused, NOT_ROBUST, where the model allows no such controller.
    """
    fit = Fit(evidence)
    chosen = choose(fit, earlier.chosen.fits if earlier else ())
    found = chosen.best
    model = fit.model(found)
    delay = 0.5 * evidence.Ts
    design = Design(replace(model, L=model.L + delay), spec, evidence.period * evidence.Ts)
    best = design.best()
    spread = uncertainty_of_Ms(fit, found, best.gains, design.w, spec.N, delay)
    rivals = difference_of_rivals(fit, found, chosen.rivals, best.gains, design.w, delay)
    noise, rounding = evidence.noise / evidence.span, evidence.rounding / evidence.span
    whiteness = colour(found.linear.residual)
    cause, detail = None, ""
    if found.rms > max(MAX_RESIDUAL * noise, UNIMPORTANT):
        cause = "unexplained"
        rms = 100.0 * found.rms
        detail = f"the model leaves {rms:.2g} % of PV's span unexplained, the noise is {100.0 * noise:.2g} %"
    elif found.rms > max(UNIMPORTANT, MAX_ROUNDED * rounding) and whiteness > MAX_COLOUR * max(evidence.colour, 1.0):
        cause = "disturbed"
        at_rest = f"{evidence.colour:.2f} at rest"
        detail = f"what the model leaves varies slowly: {whiteness:.2f} times white noise, {at_rest}"
    elif spread > MAX_UNCERTAINTY:
        cause = "uncertain"
        detail = f"Ms is known to +{spread:.2g} only"
    elif rivals > MAX_UNCERTAINTY:
        cause = "ambiguous"
        detail = f"another model that explains the record as well gives an Ms off by {rivals:.2g}"
    elif earlier is not None:
        cause, detail = _surprise(earlier, model, best.gains, spec, design, found.hypothesis.loads)
        if cause is None and (suspicion := suspect(fit, found)) is not None:
            cause, detail = "unexplained", f"{suspicion.fault} explains the record better, or the plant is not linear"
        if cause is None:
            cause, detail = _excused(fit, found, earlier, best.gains)
    return Evaluation(
        cause=cause,
        detail=detail,
        model=model,
        structure=found.structure.name,
        best=best,
        Ms=peak(model, best.gains, design.w, delay),
        uncertainty=spread,
        ambiguity=rivals,
        residual=found.rms / noise if noise > 0.0 else math.inf,
        chosen=chosen,
        fit=fit,
        design_delay=delay,
        period=design.period,
    )


def evaluate_again(evidence: Evidence, spec: DesignSpec) -> Evaluation:
    """The verdict on a whole record as the procedure comes to it, which judges the relay's part first.

    Raises Refused, NOT_ROBUST.
    """
    if not evidence.steps:
        return evaluate(evidence, spec)
    until = slice(evidence.relayed)
    return evaluate(
        evidence, spec, evaluate(replace(evidence, u=evidence.u[until], y=evidence.y[until], steps=()), spec)
    )


def _excused(fit: Fit[Evidence], found: Fitted, earlier: Evaluation, gains: Gains) -> tuple[str | None, str]:
    """Loads that came with the new gains explain away what was to be tested: a plant that has changed looks the same.

    One may be true, if the step back is explained without another, by about the gains that were tested: relay and steps
    show different frequencies, and one model can be drawn through both plants. So does one in mid-relay that the
    relay's own record had not shown.
    """
    steps, period = fit.evidence.steps, fit.period
    if not steps:
        return None, ""
    times, told = _loads(found), _loads(earlier.chosen.best)
    untold = [at for at in times if all(abs(at - each) > ALIKE * period for each in told)]
    if any(at < steps[0] - LATE * period for at in untold):
        if len(steps) == 1:
            return "ambiguous", "the whole record tells of a load in mid-relay that the relay's own record did not show"
        if len(times) > 1:
            return "surprise", "the whole record tells of other loads in mid-relay than the relay's own record"
    before, after = WITH_A_STEP
    loads = [at for at in times if at > steps[0] - (LATE if at in untold else before) * period]
    with_the_step = any(at < steps[0] + after * period for at in loads)
    if len(steps) == 1 and (with_the_step or len(loads) > 1):
        return "ambiguous", "a load seems to have come with the new gains; a plant that has changed would look the same"
    if len(loads) > 1:
        return "surprise", "PV answered each step of the new gains as if a load had come with it"
    tested = earlier.best.gains
    Kp, Ti = gains.Kp / tested.Kp, gains.Ti / tested.Ti
    if with_the_step and max(Kp, 1.0 / Kp, Ti, 1.0 / Ti) > REDRAWN:
        text = f"a load seems to have come with the new gains, and would ask for {Kp:.2f} times their Kp, {Ti:.2f} Ti"
        return "surprise", f"{text}; a plant that has changed would look the same"
    return None, ""


def _loads(found: Fitted) -> list[float]:
    """Samples at which the load stepped."""
    return [float(at) for at in found.theta[found.structure.searched :]]


def _surprise(
    earlier: Evaluation, model: TransferFunction, gains: Gains, spec: DesignSpec, design: Design, loads: int
) -> tuple[str | None, str]:
    """Both models must agree roughly on both controllers: one of them may be a story told of a disturbance."""
    maximum = SURPRISE_OF_A_STORY if loads > 1 else SURPRISE
    tested = peak(model, earlier.best.gains, design.w, earlier.design_delay)
    again = peak(earlier.model, gains, design.w, earlier.design_delay)
    if abs(tested - spec.Ms) > maximum:
        text = f"the controller that was tested has Ms {tested:.2f} on the model of the whole record, not {spec.Ms:g}"
        return "surprise", text
    if abs(again - spec.Ms) > maximum:
        text = f"the controller designed on the whole record has Ms {again:.2f} on the relay's model, not {spec.Ms:g}"
        return "surprise", text
    return None, ""
