"""Proposed where the true loop has the Ms asked, refused with its cause where the record does not allow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.design.uncertainty import peak, seen_covariance
from loopwright.tuning.fast.evaluation.evaluation import evaluate
from loopwright.tuning.fast.record import Excitation, oscillation_period
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.fast.records import BENCHES, FIRST, THREE_LAGS, record


def true_Ms(name: str, noise: float, seed: int = 1) -> tuple[float, float, str | None]:
    """(Ms on the true plant with the sampling's half sample, two standard deviations by the verdict, cause)."""
    bench = BENCHES[name]
    found = evaluate(record(bench, noise * record(bench).output_range, seed=seed), DesignSpec(1.6))
    true = TransferFunction(bench.num, bench.den, bench.L + 0.5 * bench.Ts)
    return margins(true, found.best.gains).Ms, found.uncertainty, found.reason


@pytest.mark.parametrize("name", BENCHES)
def test_six_switches_with_one_percent_noise_give_the_Ms_asked(name: str) -> None:
    Ms, uncertainty, cause = true_Ms(name, 0.01)
    assert cause is None
    assert abs(Ms - 1.6) < 0.05
    assert uncertainty < 0.1


def test_the_uncertainty_is_that_of_many_seeds() -> None:
    found = [true_Ms("three lags", 0.02, seed) for seed in range(1, 17)]
    spread = float(np.std([Ms for Ms, _, _ in found]))
    told = float(np.median([uncertainty for _, uncertainty, _ in found])) / 2.0
    # the structure is chosen anew each time, which the linear theory does not count
    assert 0.4 * told < spread < 2.0 * told


def test_a_record_that_no_linear_model_explains_is_refused() -> None:
    evidence = record(THREE_LAGS, 0.002 * record(THREE_LAGS).output_range)
    # a second plant that only some of the time is there
    knocked = evidence.y + 0.05 * evidence.output_range * np.sin(np.arange(len(evidence.y)) / 7.0)
    found = evaluate(replace(evidence, y=np.where(np.arange(len(knocked)) < evidence.listened, evidence.y, knocked)),
                  DesignSpec(1.6))  # fmt: skip
    assert found.reason == Reason.UNEXPLAINED
    assert "unexplained" in found.detail


def test_slow_noise_that_was_not_there_at_rest_is_told_from_white_noise() -> None:
    evidence = record(FIRST, 0.01 * record(FIRST).output_range)
    slow = lfilter([1.0], [1.0, -0.97], np.random.default_rng(2).normal(size=len(evidence.y)))
    slow[: evidence.listened] = 0.0
    found = evaluate(
        replace(evidence, y=evidence.y + 0.004 * evidence.output_range * slow / np.std(slow)), DesignSpec(1.6)
    )
    assert found.reason is None and found.Ms == pytest.approx(1.6, abs=0.1)


def test_much_noise_and_few_switches_are_uncertain() -> None:
    found = evaluate(record(THREE_LAGS, 0.4 * record(THREE_LAGS).output_range, switches=4, seed=3), DesignSpec(1.6))
    assert found.reason == Reason.UNCERTAIN
    assert "Ms" in found.detail


def test_gains_that_came_of_another_plant_are_a_surprise() -> None:
    evidence = record(FIRST, 0.01 * record(FIRST).output_range)
    other = evaluate(evidence, DesignSpec(1.6))
    stronger = replace(other.best, gains=replace(other.best.gains, Kp=1.6 * other.best.gains.Kp))
    found = evaluate(evidence, DesignSpec(1.6), replace(other, best=stronger))
    assert found.reason == Reason.MODEL_MISMATCH
    assert f"{peak(found.model, stronger.gains, np.geomspace(1e-3, 30.0, 4000), 0.05):.2f}" in found.detail


@pytest.mark.parametrize(
    ("excitation", "said"), [(Excitation.RELAY, "the relay's record"), (Excitation.SETPOINT, "the pulses' record")]
)
def test_a_refusal_names_the_record_of_the_excitation_that_was_there(excitation: Excitation, said: str) -> None:
    evidence = replace(record(FIRST, 0.01 * record(FIRST).output_range), excitation=excitation)
    other = evaluate(evidence, DesignSpec(1.6))
    model = other.model
    stronger = replace(model, num=tuple(1.8 * each for each in model.num))
    found = evaluate(evidence, DesignSpec(1.6), replace(other, model=stronger))
    assert found.reason is Reason.MODEL_MISMATCH
    assert f"on the model of {said}, not 1.6" in found.detail


def test_too_few_switches_or_too_short_a_rest_are_no_evidence() -> None:
    evidence = record(FIRST)
    with pytest.raises(Refused) as refused:
        oscillation_period([130, 150, 170])
    assert refused.value.reason is Reason.CANNOT_OSCILLATE
    with pytest.raises(Refused):
        replace(evidence, listened=20)


def test_the_covariance_is_that_of_least_squares_and_leaves_out_what_is_not_seen() -> None:
    A = np.random.default_rng(1).normal(size=(50, 3))
    exact = 0.3 * np.linalg.inv(A.T @ A)
    assert seen_covariance(A, 0.3) == pytest.approx(exact, rel=1e-9)
    twice = np.column_stack((A, A[:, 0]))
    found = seen_covariance(twice, 0.3)
    # what both together do is known as before, how they share it does not count
    assert found[np.ix_([1, 2], [1, 2])] == pytest.approx(exact[1:, 1:], rel=1e-9)
    both = np.array([1.0, 0.0, 0.0, 1.0])
    assert both @ found @ both == pytest.approx(exact[0, 0], rel=1e-9)
