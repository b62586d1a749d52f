"""The evaluation of a fast record: identification, design, and the reasons for which the result is not trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from loopwright.tuning.fast.design.design import DesignSpec, GainDesign, OptimalGains
from loopwright.tuning.fast.design.requirements import keeping, possible_instead
from loopwright.tuning.fast.design.uncertainty import difference_of_rivals, durbin_watson_ratio, peak, uncertainty_of_Ms
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.fast.score_tests.rival_explanations import rival_explanations
from loopwright.tuning.fast.score_tests.score_tests import ScoreTests
from loopwright.tuning.fast.score_tests.two_lags import find_two_lags
from loopwright.tuning.fast.score_tests.valve_faults import find_valve_fault
from loopwright.tuning.fast.structure_choice import RIVAL_BIC, StructureChoice, choose_structure
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.identification.structures import THIRD_WITH_ZEROS
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Reason, Refused

MAX_RESIDUAL, NEGLIGIBLE_RESIDUAL = 1.35, 0.004
"""Limits of the rms of the residual: the largest accepted, in standard deviations of the noise at rest; the fraction of
the range of PV below which a residual is accepted in any case."""
MAX_DURBIN_WATSON_RATIO = 1.35
MAX_ROUNDED = 1.25
"""Residual, in average rounding errors, below which slow variations are accepted: rounding errors are not white."""
MAX_UNCERTAINTY = {Excitation.RELAY: 0.10, Excitation.SETPOINT: 0.06, Excitation.OBSERVE: 0.06, Excitation.MANUAL: 0.05}
"""Largest accepted uncertainty of Ms, by the delta method and among rival models."""
MAX_DIFFERENCE, MAX_DIFFERENCE_UNTRIED = 0.25, 0.15
"""Largest difference of the gain above and below rest that a record may leave open, a fraction of the gain; the second
value holds in manual, where no step under the new gains follows."""
MAX_MODEL_MISMATCH, MAX_MODEL_MISMATCH_OF_TWO_LOADS = 0.5, 0.2
"""Largest accepted difference of Ms from the Ms asked for, of the tested gains on the new model and of the new gains on
the earlier model; the second value holds where the model has two load disturbances."""
LOAD_WINDOW = (0.15, 0.8)
"""Periods before and after the set-point step within which a load disturbance counts as coming with the step."""
LATE_LOAD, SAME_LOAD = 0.5, 0.3
"""Times in periods. A load disturbance at most LATE_LOAD before the step need not have shown in the record without the
step; if it has not, it may really be a change of the plant. Two load disturbances closer than SAME_LOAD are the same
one."""
MAX_GAIN_CHANGE = 1.5
"""Largest accepted ratio of new to tested Kp or Ti where a load disturbance seems to have come with the tested
gains."""

LIKE_TWO_LAGS = (Reason.UNEXPLAINED, Reason.DISTURBED, Reason.AMBIGUOUS, Reason.MODEL_MISMATCH)
"""Reasons that a linear model of a plant that rises and falls with different lags leads to."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The evaluation of one record.

    reason: the reason why the result is not trusted, None if it is.
    detail: the sentence with the numbers behind that reason.
    model: the process model, without the delay of the sampling.
    structure: the name of its structure.
    best: the gains designed on the model.
    Ms: the maximum sensitivity of these gains on the model, the delay of the sampling included.
    uncertainty: how much larger Ms may be with the model two standard deviations off.
    ambiguity: the largest difference of Ms on a rival model.
    residual: the rms of the residual in standard deviations of the noise at rest.
    chosen, fit: the choice of the structure, and the fits of the record behind it.
    design_delay: the delay of the sampling, s.
    period: the ultimate period of the model, s.
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

    def longest_delay_seen(self) -> float:
        """The longest delay, s, up to which the record would show a second path of 30 % of the plant's effect."""
        return ScoreTests(self.fit, self.chosen.best).longest_delay_seen()


def evaluate(
    record: ExperimentRecord, spec: DesignSpec, earlier: Evaluation | None = None, test_follows: bool = False
) -> Evaluation:
    """Identifies the model, designs the gains and assesses both.

    spec: the design specification.
    earlier: the evaluation of the first part of the record, whose gains were tested in the rest of it.
    test_follows: whether the gains are to be tested next. The record is then not asked whether a second path stands
    behind its load disturbances, which the test shows, and that of a relay is not asked whether the plant is linear: a
    load disturbance or backlash can look like a gain that differs above and below rest there, and the test tells them
    apart.
    Raises Refused, where the model permits no such controller: UNEXPLAINED or DISTURBED where the model does not
    explain the record, else NOT_ROBUST. Where `earlier` is given, a record that is not explained is evaluated with the
    gains of `earlier`.
    """
    fit = Fit(record)
    chosen = choose_structure(fit, earlier.chosen.fits if earlier else ())
    found = chosen.best
    by_relay, manual = (record.excitation is each for each in (Excitation.RELAY, Excitation.MANUAL))
    max_uncertainty = MAX_UNCERTAINTY[record.excitation]
    model = fit.model(found)
    delay = record.sampling_delay_s
    design = GainDesign(replace(model, L=model.L + delay), spec, record.period * record.Ts)
    unexplained = _unexplained(record, found)
    try:
        kept = keeping(design)
        best = design.best() if kept is None else kept  # the record is judged in any case
    except Refused:
        if unexplained is None:
            if (lags := find_two_lags(fit, found)) is not None:
                raise Refused(Reason.UNEXPLAINED, lags.what) from None
            raise
        if earlier is None:
            lags = find_two_lags(fit, found)
            raise Refused(*(unexplained if lags is None else (Reason.UNEXPLAINED, lags.what))) from None
        kept = best = earlier.best
    spread = uncertainty_of_Ms(fit, found, best.gains, design.w, spec.N, delay)
    rivals = difference_of_rivals(fit, found, chosen.rivals, best.gains, design.w, delay)
    reason: Reason | None = None
    detail = ""
    if unexplained is not None:
        reason, detail = unexplained
    elif spread > max_uncertainty:
        reason = Reason.UNCERTAIN
        detail = f"Ms is known to +{spread:.2g} only"
    elif rivals > max_uncertainty:
        reason = Reason.AMBIGUOUS
        detail = f"another model that explains the record as well gives an Ms off by {rivals:.2g}"
    elif manual and (fault := find_valve_fault(fit, found)) is not None:
        reason, detail = Reason.UNEXPLAINED, f"{fault.fault} explains the record better, or the plant is not linear"
    elif (not by_relay or (earlier is None and not test_follows)) and (shown := _nonlinearity(fit, found)) is not None:
        reason, detail = shown
    elif earlier is not None:
        reason, detail = _model_mismatch(earlier, model, best, design, found.hypothesis.load_disturbances)
        if reason is None and (fault := find_valve_fault(fit, found)) is not None:
            reason, detail = Reason.UNEXPLAINED, f"{fault.fault} explains the record better, or the plant is not linear"
        if reason is None and by_relay:
            reason, detail = _nonlinearity(fit, found) or (None, "")
        if reason is None:
            reason, detail = _load_with_the_step(fit, found, earlier, best.gains)
        if reason is None:
            reason, detail = _changed_with_the_gains(fit, found) or (None, "")
    if earlier is not None or not test_follows:
        reason, detail = _instead_of_loads(fit, found, reason, detail)
    if reason is None and _stand_for_a_curve(record, found):
        what = "two load disturbances within one test explain the record"
        reason, detail = Reason.DISTURBED, f"{what}; a plant that is not linear would look the same"
    if reason in LIKE_TWO_LAGS:
        lags = find_two_lags(fit, found)
        reason, detail = (reason, detail) if lags is None else (Reason.UNEXPLAINED, lags.what)
    if reason is None and kept is None:
        reason, detail = Reason.NOT_POSSIBLE, possible_instead(design)
    return Evaluation(
        reason=reason,
        detail=detail,
        model=model,
        structure=found.structure.name,
        best=best,
        Ms=peak(model, best.gains, design.w, delay),
        uncertainty=spread,
        ambiguity=rivals,
        residual=found.rms * record.output_range / record.noise if record.noise > 0.0 else math.inf,
        chosen=chosen,
        fit=fit,
        design_delay=delay,
        period=design.period,
    )


def _unexplained(record: ExperimentRecord, found: Fitted) -> tuple[Reason, str] | None:
    """The reason and the detail where the residual is not the noise at rest."""
    noise, rounding = record.noise / record.output_range, record.rounding / record.output_range
    if found.rms > max(MAX_RESIDUAL * noise, NEGLIGIBLE_RESIDUAL):
        text = f"the model leaves {100.0 * found.rms:.2g} % of PV's range unexplained"
        return Reason.UNEXPLAINED, f"{text}, the noise is {100.0 * noise:.2g} %"
    ratio = durbin_watson_ratio(found.linear.residual)
    slow = MAX_DURBIN_WATSON_RATIO * max(record.durbin_watson_ratio_at_rest, 1.0)
    if found.rms > max(NEGLIGIBLE_RESIDUAL, MAX_ROUNDED * rounding) and ratio > slow:
        at_rest = f"{record.durbin_watson_ratio_at_rest:.2f} at rest"
        return Reason.DISTURBED, f"what the model leaves varies slowly: {ratio:.2f} times white noise, {at_rest}"
    return None


def _stand_for_a_curve(record: ExperimentRecord, found: Fitted) -> bool:
    """Whether the load disturbances of the model may stand for a plant that is not linear in PV, such as a pH.

    Two of them can, under the few moves of PV that pulses make with any structure, under a relay with the richest one.
    """
    richest = found.structure == THIRD_WITH_ZEROS
    return found.hypothesis.load_disturbances > 1 and (record.excitation is Excitation.SETPOINT or richest)


def _nonlinearity(fit: Fit[ExperimentRecord], found: Fitted) -> tuple[Reason, str] | None:
    """The reason and the detail where the record shows a plant that is not linear, or leaves that open."""
    test = ScoreTests(fit, found)
    if (shown := test.nonlinearity()) is not None:
        return Reason.UNEXPLAINED, f"{shown.what}, +-{2.0 * shown.deviation:.2g}"
    if fit.record.one_sided:  # such a record cannot tell how far the sides differ, and its proposal says so
        return None
    untried = fit.record.excitation is Excitation.MANUAL
    if (unknown := test.unknown_difference()) > (MAX_DIFFERENCE_UNTRIED if untried else MAX_DIFFERENCE):
        by = f"{100.0 * unknown:.0f} %" if unknown < 1.0 else "any factor"
        what = f"the gain above and below the operating point may differ by {by}"
        return Reason.UNCERTAIN, f"{what}, the record does not tell"
    return None


def _instead_of_loads(
    fit: Fit[ExperimentRecord], found: Fitted, reason: Reason | None, detail: str
) -> tuple[Reason | None, str]:
    """The reason and the detail with what a second path, or a gain that changes with MV, in place of the load
    disturbances says to them.

    Where one of them explains the record as well as the load disturbances do, the model is ambiguous: PV answers the
    next step twice where there is a second path, and a load disturbance stays as it is. Where a gain that changes
    explains the record better, the record is not explained by a linear plant.
    """
    instead = rival_explanations(fit, found)
    # a record of one side hardly shows the other one, and its proposal says so
    as_well = MIN_BIC_GAIN if instead is not None and instead.changing and fit.record.one_sided else -RIVAL_BIC
    if instead is None or instead.bic_gain < as_well:
        return reason, detail
    what = f"the record looks as if {instead.what}"
    if reason is None and instead.changing and instead.bic_gain > MIN_BIC_GAIN:
        return Reason.UNEXPLAINED, f"{what}, more than as if a load disturbance had come"
    if reason is None:
        return Reason.AMBIGUOUS, f"{what}, as much as if a load disturbance had come"
    explained = max(MAX_RESIDUAL * fit.record.noise / fit.record.output_range, NEGLIGIBLE_RESIDUAL)
    if instead.plausible and instead.bic_gain > MIN_BIC_GAIN and instead.rms <= explained:
        detail = f"{detail}; {what}"
    return reason, detail


def _load_with_the_step(
    fit: Fit[ExperimentRecord], found: Fitted, earlier: Evaluation, gains: Gains
) -> tuple[Reason | None, str]:
    """The reason and the detail where the model explains the test of the new gains by a load disturbance.

    A load disturbance found together with the new gains may really be a change of the plant, so it is accepted only if
    the step back is explained without another one and the gains designed on the whole record are close to those tested.
    The second condition is needed because relay and steps excite different frequencies: one model can fit the plant
    before the change at the former and the plant after the change at the latter. A load disturbance before the step is
    treated in the same way where the record without the step had not shown it.
    """
    steps, period = fit.record.steps, fit.period
    if not steps:
        return None, ""
    times, shown = _loads(found), _loads(earlier.chosen.best)
    new = [at for at in times if all(abs(at - each) > SAME_LOAD * period for each in shown)]
    before_step = fit.record.excitation.record
    if any(at < steps[0] - LATE_LOAD * period for at in new):
        if len(steps) == 1:
            return (
                Reason.AMBIGUOUS,
                f"the whole record shows a load disturbance before the step that {before_step} did not show",
            )
        if len(times) > 1:
            return (
                Reason.MODEL_MISMATCH,
                f"the whole record shows other load disturbances before the step than {before_step}",
            )
    before, after = LOAD_WINDOW
    loads = [at for at in times if at > steps[0] - (LATE_LOAD if at in new else before) * period]
    with_the_step = any(at < steps[0] + after * period for at in loads)
    if len(steps) == 1 and (with_the_step or len(loads) > 1):
        return (
            Reason.AMBIGUOUS,
            "a load disturbance seems to have come with the new gains; a plant that has changed would look the same",
        )
    if len(loads) > 1:
        return Reason.MODEL_MISMATCH, "PV answered each step of the new gains as if a load disturbance had come with it"
    tested = earlier.best.gains
    Kp, Ti = gains.Kp / tested.Kp, gains.Ti / tested.Ti
    if with_the_step and max(Kp, 1.0 / Kp, Ti, 1.0 / Ti) > MAX_GAIN_CHANGE:
        come = "a load disturbance seems to have come with the new gains"
        text = f"{come}, and would ask for {Kp:.2f} times their Kp, {Ti:.2f} Ti"
        return Reason.MODEL_MISMATCH, f"{text}; a plant that has changed would look the same"
    return None, ""


def _changed_with_the_gains(fit: Fit[ExperimentRecord], found: Fitted) -> tuple[Reason, str] | None:
    """The reason and the detail where the record shows another gain of the plant under the new gains. A load
    disturbance that came with one step would look the same, one that comes with two does not."""
    if (shown := ScoreTests(fit, found).changed_with_the_gains()) is None:
        return None
    what = f"{shown.what}, +-{2.0 * shown.deviation:.2g}"
    if len(fit.record.steps) == 1:
        return Reason.AMBIGUOUS, f"{what}; a load disturbance with the step would look the same"
    return Reason.UNEXPLAINED, what


def _loads(found: Fitted) -> list[float]:
    """The times of the load disturbances, in samples."""
    return [float(at) for at in found.theta[found.structure.searched :]]


def _model_mismatch(
    earlier: Evaluation, model: TransferFunction, best: OptimalGains, design: GainDesign, loads: int
) -> tuple[Reason | None, str]:
    """The reason and the detail where the model without the step and that of the whole record disagree on a controller.

    Both models must give both controllers about the Ms that each was designed for. Otherwise a disturbance, or a change
    of the plant, has entered one of the models.
    """
    maximum = MAX_MODEL_MISMATCH_OF_TWO_LOADS if loads > 1 else MAX_MODEL_MISMATCH
    tested = peak(model, earlier.best.gains, design.w, earlier.design_delay)
    again = peak(earlier.model, best.gains, design.w, earlier.design_delay)
    if abs(tested - earlier.best.Ms) > maximum:
        asked = f"{earlier.best.Ms:.4g}"
        text = f"the controller that was tested has Ms {tested:.2f} on the model of the whole record, not {asked}"
        return Reason.MODEL_MISMATCH, text
    if abs(again - best.Ms) > maximum:
        before_step = f"the model of {earlier.fit.record.excitation.record}"
        text = f"the controller designed on the whole record has Ms {again:.2f} on {before_step}, not {best.Ms:.4g}"
        return Reason.MODEL_MISMATCH, text
    return None, ""
