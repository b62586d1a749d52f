"""Identification, design and verdict of a fast record in one call."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from loopwright.tuning.fast.design import DesignSpec, GainDesign, OptimalGains
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.structure_choice import StructureChoice, choose_structure
from loopwright.tuning.fast.uncertainty import difference_of_rivals, durbin_watson_ratio, peak, uncertainty_of_Ms
from loopwright.tuning.fast.valve_faults import find_valve_fault
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Reason

MAX_RESIDUAL, UNIMPORTANT = 1.35, 0.004
"""Of the residual: in noises at rest; in spans of PV, below which it does not matter."""
MAX_DURBIN_WATSON_RATIO = 1.35
MAX_ROUNDED = 1.25
"""Of what rounding leaves on average, which is not quite random and not white."""
MAX_UNCERTAINTY = 0.10
"""Of Ms, by the delta method and among the rivals."""
MAX_MODEL_MISMATCH, MAX_MODEL_MISMATCH_OF_TWO_LOADS = 0.5, 0.2
"""Of Ms from what was asked, of the tested controller on the new model and the new one on the earlier model; where the
load is said to have moved twice."""
LOAD_WINDOW = (0.15, 0.8)
"""Periods before and after the step of the set-point, within which a load is said to have come with it."""
LATE_LOAD, SAME_LOAD = 0.5, 0.3
"""Periods: a load so shortly before the step need not have shown in the relay, and if it has not, it may as well be a
plant that has changed; two that are so near are the same."""
MAX_GAIN_CHANGE = 1.5
"""Times by which the tested gains may change where a load is said to have come with them."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """cause: the value of the reason why the result is not to be trusted, None if it is.

    model: without the delay of the sampling, which is in `design_delay` (s).  Ms: on the model.
    uncertainty, ambiguity: of Ms.  residual: its rms in noises at rest.  period: ultimate, of the model, s.
    """

    reason: Reason | None
    detail: str
    model: TransferFunction
    structure: str
    best: OptimalGains
    Ms: float
    uncertainty: float
    ambiguity: float
    residual: float
    chosen: StructureChoice
    fit: Fit[ExperimentRecord]
    design_delay: float
    period: float


def evaluate(record: ExperimentRecord, spec: DesignSpec, earlier: Evaluation | None = None) -> Evaluation:
    """earlier: of a first part of the record, whose gains were tested in the rest of it.

    Raises Refused, NOT_ROBUST, where the model allows no such controller.
    """
    fit = Fit(record)
    chosen = choose_structure(fit, earlier.chosen.fits if earlier else ())
    found = chosen.best
    model = fit.model(found)
    delay = 0.5 * record.Ts
    design = GainDesign(replace(model, L=model.L + delay), spec, record.period * record.Ts)
    best = design.best()
    spread = uncertainty_of_Ms(fit, found, best.gains, design.w, spec.N, delay)
    rivals = difference_of_rivals(fit, found, chosen.rivals, best.gains, design.w, delay)
    noise, rounding = record.noise / record.output_range, record.rounding / record.output_range
    ratio = durbin_watson_ratio(found.linear.residual)
    reason: Reason | None = None
    detail = ""
    if found.rms > max(MAX_RESIDUAL * noise, UNIMPORTANT):
        reason = Reason.UNEXPLAINED
        rms = 100.0 * found.rms
        detail = f"the model leaves {rms:.2g} % of PV's span unexplained, the noise is {100.0 * noise:.2g} %"
    elif found.rms > max(UNIMPORTANT, MAX_ROUNDED * rounding) and ratio > MAX_DURBIN_WATSON_RATIO * max(
        record.durbin_watson_ratio_at_rest, 1.0
    ):
        reason = Reason.DISTURBED
        at_rest = f"{record.durbin_watson_ratio_at_rest:.2f} at rest"
        detail = f"what the model leaves varies slowly: {ratio:.2f} times white noise, {at_rest}"
    elif spread > MAX_UNCERTAINTY:
        reason = Reason.UNCERTAIN
        detail = f"Ms is known to +{spread:.2g} only"
    elif rivals > MAX_UNCERTAINTY:
        reason = Reason.AMBIGUOUS
        detail = f"another model that explains the record as well gives an Ms off by {rivals:.2g}"
    elif earlier is not None:
        reason, detail = _model_mismatch(earlier, model, best.gains, spec, design, found.hypothesis.load_disturbances)
        if reason is None and (fault := find_valve_fault(fit, found)) is not None:
            reason, detail = Reason.UNEXPLAINED, f"{fault.fault} explains the record better, or the plant is not linear"
        if reason is None:
            reason, detail = _load_with_the_step(fit, found, earlier, best.gains)
    return Evaluation(
        reason=reason,
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


def evaluate_again(record: ExperimentRecord, spec: DesignSpec) -> Evaluation:
    """The verdict on a whole record as the procedure comes to it, which judges the relay's part first.

    Raises Refused, NOT_ROBUST.
    """
    if not record.steps:
        return evaluate(record, spec)
    until = slice(record.relayed)
    return evaluate(record, spec, evaluate(replace(record, u=record.u[until], y=record.y[until], steps=()), spec))


def _load_with_the_step(
    fit: Fit[ExperimentRecord], found: Fitted, earlier: Evaluation, gains: Gains
) -> tuple[Reason | None, str]:
    """Loads that came with the new gains explain away what was to be tested: a plant that has changed looks the same.

    One may be true, if the step back is explained without another, by about the gains that were tested: relay and steps
    show different frequencies, and one model can be drawn through both plants. So does one in mid-relay that the
    relay's own record had not shown.
    """
    steps, period = fit.record.steps, fit.period
    if not steps:
        return None, ""
    times, shown = _loads(found), _loads(earlier.chosen.best)
    new = [at for at in times if all(abs(at - each) > SAME_LOAD * period for each in shown)]
    if any(at < steps[0] - LATE_LOAD * period for at in new):
        if len(steps) == 1:
            return (
                Reason.AMBIGUOUS,
                "the whole record tells of a load in mid-relay that the relay's own record did not show",
            )
        if len(times) > 1:
            return (
                Reason.MODEL_MISMATCH,
                "the whole record tells of other loads in mid-relay than the relay's own record",
            )
    before, after = LOAD_WINDOW
    loads = [at for at in times if at > steps[0] - (LATE_LOAD if at in new else before) * period]
    with_the_step = any(at < steps[0] + after * period for at in loads)
    if len(steps) == 1 and (with_the_step or len(loads) > 1):
        return (
            Reason.AMBIGUOUS,
            "a load seems to have come with the new gains; a plant that has changed would look the same",
        )
    if len(loads) > 1:
        return Reason.MODEL_MISMATCH, "PV answered each step of the new gains as if a load had come with it"
    tested = earlier.best.gains
    Kp, Ti = gains.Kp / tested.Kp, gains.Ti / tested.Ti
    if with_the_step and max(Kp, 1.0 / Kp, Ti, 1.0 / Ti) > MAX_GAIN_CHANGE:
        text = f"a load seems to have come with the new gains, and would ask for {Kp:.2f} times their Kp, {Ti:.2f} Ti"
        return Reason.MODEL_MISMATCH, f"{text}; a plant that has changed would look the same"
    return None, ""


def _loads(found: Fitted) -> list[float]:
    """Samples at which the load stepped."""
    return [float(at) for at in found.theta[found.structure.searched :]]


def _model_mismatch(
    earlier: Evaluation, model: TransferFunction, gains: Gains, spec: DesignSpec, design: GainDesign, loads: int
) -> tuple[Reason | None, str]:
    """Both models must agree roughly on both controllers: one of them may be a story told of a disturbance."""
    maximum = MAX_MODEL_MISMATCH_OF_TWO_LOADS if loads > 1 else MAX_MODEL_MISMATCH
    tested = peak(model, earlier.best.gains, design.w, earlier.design_delay)
    again = peak(earlier.model, gains, design.w, earlier.design_delay)
    if abs(tested - spec.Ms) > maximum:
        text = f"the controller that was tested has Ms {tested:.2f} on the model of the whole record, not {spec.Ms:g}"
        return Reason.MODEL_MISMATCH, text
    if abs(again - spec.Ms) > maximum:
        text = f"the controller designed on the whole record has Ms {again:.2f} on the relay's model, not {spec.Ms:g}"
        return Reason.MODEL_MISMATCH, text
    return None, ""
