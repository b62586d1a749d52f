"""What another law of the controller does to the gains designed, and when that is a refusal."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.control_law import ControlLaw
from loopwright.tuning.experiments.control_record import ControlPiece, ControlRecord
from loopwright.tuning.experiments.controller_check import check_controller
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.controller_effect import Ms_instead, mismatch, note_of, with_controller
from loopwright.tuning.fast.evaluation.evaluation import Evaluation, evaluate
from loopwright.tuning.fast.evaluation.outcome import refusal_of
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Reason
from tests.unit.tuning.experiments.driven import recorded
from tests.unit.tuning.fast.records import FIRST, record

SAID = Gains(2.0, 5.0)
PID = Gains(2.0, 4.0, 0.8, 0.08)


@cache
def designed(derivative: bool = False) -> Evaluation:
    return evaluate(record(FIRST), DesignSpec(1.6, derivative))


def seen(control: ControlRecord | None, derivative: bool = False) -> Evaluation:
    """The evaluation with a record that shows this of the controller."""
    found = designed(derivative)
    fit = copy(found.fit)
    fit.record = replace(fit.record, control=control)
    return replace(found, fit=fit)


def true_Ms(evaluation: Evaluation, gains: Gains, filter_s: float = 0.0) -> float:
    model = evaluation.model
    den = tuple(map(float, np.convolve(model.den, (filter_s, 1.0)))) if filter_s else model.den
    return margins(TransferFunction(model.num, den, model.L + evaluation.design_delay), gains).Ms


def test_the_law_as_said_is_no_mismatch_and_needs_no_note() -> None:
    evaluation = seen(recorded(SAID, ControlLaw(SAID)))
    assert mismatch(evaluation) is None and note_of(evaluation) is None


@pytest.mark.parametrize("factor", [0.7, 0.9, 1.03, 1.4])
def test_a_gain_that_is_another_one_changes_Ms(factor: float) -> None:
    evaluation = seen(recorded(SAID, ControlLaw(replace(SAID, Kp=factor * SAID.Kp))))
    gains = evaluation.best.gains
    expected = true_Ms(evaluation, replace(gains, Kp=factor * gains.Kp))
    check = check_controller(evaluation.fit.record.control or pytest.fail())
    assert Ms_instead(evaluation, check) == pytest.approx(expected, abs=2e-3)
    refused = mismatch(evaluation)
    if abs(expected - 1.6) > 0.1:
        assert refused is not None and refused.reason is Reason.CONTROLLER_MISMATCH
        assert f"Kp times {factor:g} " in refused.detail and f"Ms would be {expected:.2f} in place of" in refused.detail
        facts = Facts(FIRST.Ts, 30.0, -1.0, 1.0, 1.0, SAID)
        assert refusal_of(facts, evaluation) is None
        named = refusal_of(facts, with_controller(evaluation))
        assert named is not None and (named.reason, named.detail) == (refused.reason, refused.detail)
    else:
        assert refused is None
        note = note_of(evaluation)
        assert note is not None and f"Kp times {factor:g} " in note and f"changes Ms to {expected:.2f}" in note


def test_a_filter_of_pv_is_a_lag_more_in_the_loop() -> None:
    evaluation = seen(recorded(SAID, ControlLaw(SAID, 0.6)))
    expected = true_Ms(evaluation, evaluation.best.gains, 0.6)
    refused = mismatch(evaluation)
    assert refused is not None and "a filter of PV inside the controller of 0.6 " in refused.detail
    assert f"Ms would be {expected:.2f}" in refused.detail and expected > 1.7


def test_the_parallel_form_is_wrong_by_the_gain_that_is_designed() -> None:
    parallel = ControlLaw(replace(SAID, Ti=SAID.Kp * SAID.Ti))
    evaluation = seen(recorded(SAID, parallel))
    gains = evaluation.best.gains
    check = check_controller(evaluation.fit.record.control or pytest.fail())
    assert Ms_instead(evaluation, check) == pytest.approx(
        true_Ms(evaluation, replace(gains, Ti=gains.Kp * gains.Ti)), abs=2e-3
    )


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (ControlLaw(replace(PID, c=1.0)), "a derivative of the error"),
        (ControlLaw(replace(PID, b=0.0)), "a set-point weight b of"),
        (ControlLaw(replace(PID, Tf=0.0)), "a derivative without its filter"),
    ],
)
def test_what_leaves_Ms_alone_is_refused_for_what_else_the_proposal_says(law: ControlLaw, words: str) -> None:
    refused = mismatch(seen(recorded(PID, law), derivative=True))
    assert refused is not None and refused.reason is Reason.CONTROLLER_MISMATCH and words in refused.detail


def test_a_controller_that_no_law_explains_is_refused() -> None:
    [piece] = recorded(SAID, ControlLaw(SAID)).pieces
    odd = ControlPiece(SAID, piece.sp, piece.pv, piece.mv + np.sin(0.9 * np.arange(len(piece.mv))))
    refused = mismatch(seen(ControlRecord(0.1, True, (odd,))))
    assert refused is not None and "none of the other laws that were tried gives it" in refused.detail


def test_coarse_values_are_neither_refused_nor_noted() -> None:
    evaluation = seen(recorded(SAID, ControlLaw(SAID), noise=0.03, mv_step=0.1))
    assert mismatch(evaluation) is None and note_of(evaluation) is None


def test_a_record_that_does_not_tell_is_noted() -> None:
    note = note_of(seen(ControlRecord(0.1, True, ())))
    assert note is not None and note.startswith("The record does not show whether the controller does what its gains")


def test_of_a_controller_of_which_nothing_is_known_nothing_is_said() -> None:
    assert mismatch(seen(None)) is None and note_of(seen(None)) is None
    assert designed().fit.record.excitation is Excitation.RELAY
