"""What the controller's own law, where it is not the one that its gains say, does to the gains designed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from loopwright.tuning.experiments.control_law import ControlLaw, LawDifference
from loopwright.tuning.experiments.controller_check import ControllerCheck, check_controller
from loopwright.tuning.experiments.controller_mismatch import in_words, law_instead, mismatch_of
from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.uncertainty import peak
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Reason, Refused

MAX_DIFFERENCE = 0.1
"""Largest difference of Ms that another law of the controller may make."""
GAIN_KNOWN, INTEGRAL_KNOWN, FILTER_KNOWN = 0.03, 0.1, 0.02
"""Standard deviations up to which a record tells of a controller: of the factors of gain and integral, and of a filter
of PV, in ultimate periods."""
WITHOUT_MODEL = (LawDifference.DERIVATIVE_ON_ERROR, LawDifference.SETPOINT_WEIGHT, LawDifference.NO_DERIVATIVE_FILTER)
"""Other laws that are refused whatever they do to Ms."""
DIRECT = 1e-6
"""Filter of a derivative without one, in derivative times."""


def with_controller(evaluation: Evaluation) -> Evaluation:
    """The evaluation, with the reason for a refusal where its record shows another controller: longer records, and
    other models, would not change that."""
    refused = mismatch(evaluation)
    return evaluation if refused is None else replace(evaluation, reason=refused.reason, detail=refused.detail)


def mismatch(evaluation: Evaluation) -> Refused | None:
    """The refusal where the record shows a controller under which the gains designed would not do what they promise;
    None where it does not, or does not tell."""
    check = checked(evaluation)
    if check is None or check.exact:
        return None
    control = evaluation.fit.record.control
    assert control is not None
    said = control.pieces[-1].gains
    if check.other is None or check.other.kind in WITHOUT_MODEL:
        text = mismatch_of(check, said, math.inf)
        return None if text is None else Refused(Reason.CONTROLLER_MISMATCH, text)
    Ms = Ms_instead(evaluation, check)
    if abs(Ms - evaluation.Ms) <= MAX_DIFFERENCE:
        return None
    text = f"{in_words(check, said)}: with the gains designed Ms would be {Ms:.2f} in place of {evaluation.Ms:.2f}"
    return Refused(Reason.CONTROLLER_MISMATCH, text)


def note_of(evaluation: Evaluation) -> str | None:
    """What the operator should know of the controller beside the gains proposed: that the record does not tell whether
    it does what its gains say, or in what it differs a little; None where it does what they say."""
    if evaluation.fit.record.excitation is Excitation.MANUAL:
        return None
    check = checked(evaluation)
    if check is None:
        return None
    if check.other is not None:
        control = evaluation.fit.record.control
        assert control is not None
        text = in_words(check, control.pieces[-1].gains)
        Ms = Ms_instead(evaluation, check)
        return f"{text[0].upper()}{text[1:]}. That changes Ms to {Ms:.2f}."
    filter_s = FILTER_KNOWN * evaluation.period
    if check.gain_error < GAIN_KNOWN and check.integral_error < INTEGRAL_KNOWN and check.filter_error_s < filter_s:
        return None
    return (
        "The record does not show whether the controller does what its gains say: MV hardly moved in automatic. A "
        "filter of PV inside the controller, or gains of another form, would make Ms another one."
    )


def checked(evaluation: Evaluation) -> ControllerCheck | None:
    """The check of the controller on the record of an evaluation, None where nothing is known of the controller."""
    control = evaluation.fit.record.control
    return None if control is None else check_controller(control)


def Ms_instead(evaluation: Evaluation, check: ControllerCheck) -> float:
    """Ms of the gains designed under the law that fits in place of the one that the controller is said to have;
    infinite where there is no such law for these gains."""
    assert check.other is not None
    law = law_instead(check.other, evaluation.best.gains, evaluation.fit.record.Ts)
    if law is None:
        return math.inf
    model, gains = _with_filter(evaluation.model, law), law.gains
    if gains.Td > 0.0 and not gains.Tf > 0.0:
        gains = replace(gains, Tf=DIRECT * gains.Td)
    return peak(model, gains, frequencies(evaluation.period), evaluation.design_delay)


def _with_filter(model: TransferFunction, law: ControlLaw) -> TransferFunction:
    if not law.filter_s > 0.0:
        return model
    den = tuple(float(each) for each in np.convolve(model.den, (law.filter_s, 1.0)))
    return TransferFunction(model.num, den, model.L)
