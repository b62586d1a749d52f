"""The score tests of a plant that is not linear, on records of pulses of the set-point and of a relay."""

from __future__ import annotations

import pytest

from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.fast.evaluation import evaluate
from loopwright.tuning.fast.score_tests import ScoreTests, above_rest, squared
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.reasons import Reason
from tests.unit.tuning.fast.records import FIRST, THREE_LAGS, Bench, pulse_record, record

LOOPS = {"first order": (FIRST, 1.0, 10.0), "three lags": (THREE_LAGS, 0.8, 3.0)}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", LOOPS)
def test_a_linear_plant_is_not_told_to_be_another(name: str, seed: int) -> None:
    fit = Fit(pulse_record(*LOOPS[name], noise=0.01, seed=seed))
    linearity = ScoreTests(fit, choose_structure(fit).best)
    assert linearity.nonlinearity() is None
    for changed in (above_rest, squared):
        size, deviation = linearity.score(changed)
        assert abs(size) < 4.0 * deviation and deviation < 0.1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bench", [FIRST, THREE_LAGS])
def test_a_linear_plant_under_a_relay_is_not_told_to_be_another(bench: Bench, seed: int) -> None:
    assert evaluate(record(bench, 0.01 * record(bench).output_range, seed=seed), DesignSpec(1.6)).reason is None


@pytest.mark.parametrize("below", [0.5, 0.7, 1.4, 2.0])
def test_a_relay_alone_gives_no_gains_where_the_gain_differs_above_and_below_rest(below: float) -> None:
    """A load disturbance can stand for the difference there: the record is called uncertain. Where the gains are tested
    next, the test shows it."""
    noise = 0.005 * record(FIRST).output_range
    found = evaluate(record(FIRST, noise, below=below), DesignSpec(1.6))
    assert found.reason in (Reason.UNCERTAIN, Reason.UNEXPLAINED)


@pytest.mark.parametrize("below", [0.5, 0.7, 1.4, 2.0])
@pytest.mark.parametrize("name", LOOPS)
def test_a_gain_that_differs_above_and_below_rest_is_no_evidence(name: str, below: float) -> None:
    """Load disturbances can stand for a part of the difference: the record is then called uncertain, and goes on."""
    evaluation = evaluate(pulse_record(*LOOPS[name], noise=0.005, below=below), DesignSpec(1.6))
    assert evaluation.reason is not None
    size, deviation = ScoreTests(evaluation.fit, evaluation.chosen.best).score(above_rest)
    if (name, below) == ("first order", 0.7):  # 0.1 +- 0.6: the sign is chance
        assert deviation > 2.0 * abs(size)
    else:
        assert (size > 0.0) == (below < 1.0) and deviation > 0.0


def test_the_size_is_that_of_the_plant() -> None:
    """For a small difference the fit hardly bends: the score is then the difference itself."""
    bench: Bench = FIRST
    fit = Fit(pulse_record(bench, 1.0, 10.0, noise=0.001, below=0.97))
    size, deviation = ScoreTests(fit, choose_structure(fit).best).score(above_rest)
    assert size == pytest.approx(0.03, abs=4.0 * deviation + 0.01)
