"""What decides whether an excitation goes on, or the new gains are tried."""

from __future__ import annotations

from dataclasses import replace

import pytest

from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import MAX_UNCERTAINTY, Evaluation, evaluate
from loopwright.tuning.fast.evaluation.still_open import (
    MAX_UNCERTAINTY_TO_TRY,
    open_by,
    samples_needed,
    trial_may_tell,
)
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.fast.records import FIRST, THREE_LAGS, record

UNCERTAIN = Refused(Reason.UNCERTAIN, "Ms is known to +0.2 only")
LIMIT = MAX_UNCERTAINTY[Excitation.RELAY]


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    return evaluate(record(THREE_LAGS, 0.01 * record(THREE_LAGS).output_range), DesignSpec(1.6))


def known_to(evaluation: Evaluation, uncertainty: float, ambiguity: float = 0.0) -> Evaluation:
    return replace(evaluation, uncertainty=uncertainty, ambiguity=ambiguity)


@pytest.mark.parametrize(("uncertainty", "ambiguity", "times"), [(2.0, 0.1, 4.0), (0.5, 3.0, 9.0), (0.5, 0.2, 1.0)])
def test_twice_as_uncertain_takes_four_times_as_long(
    evaluation: Evaluation, uncertainty: float, ambiguity: float, times: float
) -> None:
    found = known_to(evaluation, uncertainty * LIMIT, ambiguity * LIMIT)
    assert open_by(found) == pytest.approx(max(uncertainty, ambiguity) * LIMIT)
    assert samples_needed(found, 150) == pytest.approx(150 * times)


def test_the_time_needed_is_that_of_a_longer_relay() -> None:
    """The estimate, beside the records of longer relays on the same plant: what it says after four switches is what
    ten take, to a factor of two."""
    noise = 0.05 * record(THREE_LAGS).output_range
    short, long = (evaluate(record(THREE_LAGS, noise, switches), DesignSpec(1.6)) for switches in (4, 10))
    lengths = [each.fit.record.excited - each.fit.record.listened for each in (short, long)]
    assert 0.5 < (open_by(short) / open_by(long)) ** 2 * lengths[0] / lengths[1] < 4.0


def test_gains_are_tried_where_their_Ms_is_known_roughly(evaluation: Evaluation) -> None:
    assert trial_may_tell(known_to(evaluation, 0.9 * MAX_UNCERTAINTY_TO_TRY), UNCERTAIN)


@pytest.mark.parametrize(("uncertainty", "ambiguity"), [(1.1, 0.0), (0.5, 1.1)])
def test_gains_of_unknown_Ms_are_not_tried(evaluation: Evaluation, uncertainty: float, ambiguity: float) -> None:
    found = known_to(evaluation, uncertainty * MAX_UNCERTAINTY_TO_TRY, ambiguity * MAX_UNCERTAINTY_TO_TRY)
    assert not trial_may_tell(found, UNCERTAIN)


@pytest.mark.parametrize("reason", [Reason.WRONG_SIGN, Reason.UNEXPLAINED, Reason.DISTURBED])
def test_gains_that_are_refused_for_another_reason_are_not_tried(evaluation: Evaluation, reason: Reason) -> None:
    assert not trial_may_tell(known_to(evaluation, 0.1), Refused(reason, ""))


def test_gains_for_a_plant_that_is_not_linear_are_not_tried() -> None:
    of_two_gains = evaluate(record(FIRST, 0.005 * record(FIRST).output_range, below=0.7), DesignSpec(1.6))
    assert not trial_may_tell(known_to(of_two_gains, 0.1), UNCERTAIN)
