"""The structures, the load and the drift in records of the devices' own simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.identification.output_error import UNDISTURBED, DisturbanceHypothesis, Fit
from loopwright.tuning.identification.structures import FIRST_WITH_FEED_THROUGH, SECOND_WITH_FEED_THROUGH
from loopwright.tuning.models import TransferFunction
from tests.unit.tuning.fast.records import BENCHES, FIRST, FIVE_LAGS, THREE_LAGS, Bench, record


def error_near_the_crossover(bench: Bench, found: TransferFunction) -> float:
    """The largest relative error of the frequency response from half the ultimate frequency to 1.5 times it."""
    w = 2.0 * math.pi / ultimate_point(bench.model)[1] * np.linspace(0.5, 1.5, 21)
    return float(np.max(np.abs(found.frequency_response(w) / bench.model.frequency_response(w) - 1.0)))


@pytest.mark.parametrize("name", BENCHES)
def test_without_noise_the_plant_is_found(name: str) -> None:
    fit = Fit(record(BENCHES[name]))
    chosen = choose_structure(fit)
    assert chosen.best.hypothesis == UNDISTURBED
    # five lags are not among the structures: their phase at 1.5 times the crossover is 1 degree off
    maximum = 0.02 if name == "five lags" else 1e-4
    assert error_near_the_crossover(BENCHES[name], fit.model(chosen.best)) < maximum


@pytest.mark.parametrize("name", BENCHES)
def test_with_noise_it_is_known_near_the_crossover(name: str) -> None:
    bench = BENCHES[name]
    fit = Fit(record(bench, 0.01 * record(bench).output_range))
    chosen = choose_structure(fit)
    assert chosen.best.hypothesis == UNDISTURBED
    assert error_near_the_crossover(bench, fit.model(chosen.best)) < 0.03
    assert chosen.best.rms == pytest.approx(fit.record.noise / fit.record.output_range, rel=0.25)


def test_a_part_that_passes_at_once_is_found() -> None:
    bench = Bench((1.5, 1.0), (5.0, 1.0), 1.0, 0.05)
    fit = Fit(record(bench))
    chosen = choose_structure(fit)
    assert chosen.best.structure in (FIRST_WITH_FEED_THROUGH, SECOND_WITH_FEED_THROUGH)
    # where between two samples the jump comes is not to be seen
    found = fit.model(chosen.best)
    assert abs(found.L - bench.L) < bench.Ts
    assert found.num == pytest.approx((0.3, 0.2), rel=0.001)


@pytest.mark.parametrize("bench", [FIRST, THREE_LAGS, FIVE_LAGS])
@pytest.mark.parametrize("size", [0.3, -0.4])
@pytest.mark.parametrize("part", [0.3, 0.6])
def test_a_step_of_the_load_in_mid_relay_is_found_within_ten_percent(bench: Bench, size: float, part: float) -> None:
    undisturbed = record(bench)
    at = undisturbed.listened + round(part * (undisturbed.excited - undisturbed.listened))
    evidence = record(bench, 0.01 * undisturbed.output_range, load=size, load_at=at)
    fit = Fit(evidence)
    chosen = choose_structure(fit)
    best = chosen.best
    assert best.hypothesis == DisturbanceHypothesis(load_disturbances=1)
    order = best.structure.order
    found = best.linear.coefficients[-order] / best.linear.coefficients[0] * evidence.input_range
    time = best.theta[-1] - best.theta[best.structure.lags]
    assert found == pytest.approx(size, rel=0.1)
    assert time - evidence.listened == pytest.approx(at - evidence.listened, abs=0.1 * evidence.period)
    assert error_near_the_crossover(bench, fit.model(best)) < 0.05


def test_a_drift_is_found() -> None:
    undisturbed = record(THREE_LAGS)
    evidence = record(
        THREE_LAGS, 0.003 * undisturbed.output_range, drift=0.2 * undisturbed.output_range / len(undisturbed.u)
    )
    fit = Fit(evidence)
    chosen = choose_structure(fit)
    assert error_near_the_crossover(THREE_LAGS, fit.model(chosen.best)) < 0.05


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("part", [0.05, 0.2])
def test_a_slow_drift_is_not_taken_for_a_load_disturbance(name: str, part: float) -> None:
    bench = BENCHES[name]
    undisturbed = record(bench)
    drift = part * undisturbed.output_range / (len(undisturbed.u) - undisturbed.listened)
    fit = Fit(record(bench, 0.01 * undisturbed.output_range, drift=drift))
    best = choose_structure(fit).best
    assert best.hypothesis == DisturbanceHypothesis(drift=True)
    assert error_near_the_crossover(bench, fit.model(best)) < 0.03


def test_faster_sampling_is_averaged_and_finds_the_same_plant() -> None:
    slow = Bench(THREE_LAGS.num, THREE_LAGS.den, THREE_LAGS.L, THREE_LAGS.Ts / 2.0)
    evidence = record(slow, 0.01 * record(slow).output_range)
    fit = Fit(evidence)
    assert evidence.block == 2
    assert fit.samples == len(evidence.u) // 2
    assert error_near_the_crossover(slow, fit.model(choose_structure(fit).best)) < 0.03
