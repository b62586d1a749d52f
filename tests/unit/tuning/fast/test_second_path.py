"""A second path from MV to PV, and a load disturbance, in records of pulses of the set-point."""

from __future__ import annotations

import pytest

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import evaluate
from loopwright.tuning.fast.score_tests.second_path import find_second_path
from loopwright.tuning.fast.structure_choice import RIVAL_BIC, choose_structure
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.reasons import Reason
from tests.unit.tuning.fast.records import FIRST, THREE_LAGS, Bench, pulse_record

LOOPS = {"first order": (FIRST, 1.0, 10.0), "three lags": (THREE_LAGS, 0.8, 3.0)}


@pytest.mark.parametrize("share", [0.3, -0.3, 0.6])
@pytest.mark.parametrize("name", LOOPS)
def test_a_second_path_is_found_with_its_share_and_delay(name: str, share: float) -> None:
    bench, Kp, Ti = LOOPS[name]
    fit = Fit(pulse_record(bench, Kp, Ti, noise=0.005, share=share, later=2.0, periods=4.0))
    best = choose_structure(fit).best
    assert best.hypothesis.load_disturbances  # which stand for the second path
    found = find_second_path(fit, best)
    assert found is not None
    assert found.later_s == pytest.approx(2.0 * ultimate_point(bench.model)[1], rel=0.03)
    assert found.share == pytest.approx(abs(share), rel=0.1)
    assert found.bic_gain > 0.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", LOOPS)
def test_a_load_disturbance_is_not_taken_for_a_second_path(name: str, seed: int) -> None:
    fit = Fit(pulse_record(*LOOPS[name], noise=0.005, load=0.5, periods=4.0, seed=seed))
    best = choose_structure(fit).best
    assert best.hypothesis.load_disturbances
    found = find_second_path(fit, best)
    assert found is None or found.bic_gain < -5.0 * RIVAL_BIC
    assert evaluate(fit.record, DesignSpec(1.6)).reason is not Reason.AMBIGUOUS


def test_a_record_that_shows_little_more_than_the_beginning_of_a_second_path_is_ambiguous() -> None:
    bench: Bench = FIRST
    record = pulse_record(bench, 1.0, 10.0, noise=0.005, share=0.6, later=2.2)
    evaluation = evaluate(record, DesignSpec(1.6))
    assert evaluation.reason is not None and "later than the rest" in evaluation.detail


def test_a_model_without_load_disturbances_is_not_asked() -> None:
    fit = Fit(pulse_record(FIRST, 1.0, 10.0, noise=0.005))
    best = choose_structure(fit).best
    assert not best.hypothesis.load_disturbances
    assert find_second_path(fit, best) is None
