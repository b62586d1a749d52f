"""A gain that differs above and below rest, a curved valve, and a load disturbance, in records of the relay and of
pulses of the set-point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import evaluate
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.changing_gain import find_changing_gain
from loopwright.tuning.fast.structure_choice import RIVAL_BIC, choose_structure
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Reason
from tests.unit.tuning.fast.records import BENCHES, FIRST, THREE_LAGS, Bench, pulse_record, record

NOISE = 0.01
STEEPER = ("first order", "three lags", "five lags", "integrates")


def relay_record(name: str, **more: float) -> ExperimentRecord:
    bench = BENCHES[name]
    return record(bench, NOISE * record(bench).output_range, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("below", [0.6, 0.7])
@pytest.mark.parametrize("name", STEEPER)
def test_a_gain_that_is_smaller_below_rest_is_found_with_its_size(name: str, below: float) -> None:
    fit = Fit(relay_record(name, below=below))
    best = choose_structure(fit).best
    assert best.hypothesis.load_disturbances  # which stand for the difference
    found = find_changing_gain(fit, best)
    assert found is not None and found.bic_gain > 0.0
    # the two levels of a relay, +d and -d/2, do not tell two sides from an even change: (1 - s/2) / (1 + s) = below
    even = (1.0 - below) / (0.5 + below)
    expected = even if "changes by" in found.what else 1.0 / below - 1.0
    assert found.size == pytest.approx(expected, abs=0.05)


def test_a_curved_valve_is_found_with_its_curvature() -> None:
    """MV acts as u + 0.2 u^2 / d: the gain at the largest MV is 1.4 times that at rest."""
    fit = Fit(curved(THREE_LAGS, 0.2))
    found = find_changing_gain(fit, choose_structure(fit).best)
    assert found is not None and found.bic_gain > 0.0
    assert found.size == pytest.approx(0.2 if "changes by" in found.what else 1.2 / 0.9 - 1.0, abs=0.03)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", BENCHES)
def test_a_load_disturbance_is_not_taken_for_it_in_a_relay(name: str, seed: int) -> None:
    found = relay_record(name, load=0.3, load_at=230, seed=seed)
    fit = Fit(found)
    best = choose_structure(fit).best
    if best.hypothesis.load_disturbances:
        changing = find_changing_gain(fit, best)
        assert changing is None or changing.bic_gain < -RIVAL_BIC


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("bench", "Kp", "Ti"), [(FIRST, 1.0, 10.0), (THREE_LAGS, 0.8, 3.0)])
def test_nor_in_pulses(bench: Bench, Kp: float, Ti: float, seed: int) -> None:
    fit = Fit(pulse_record(bench, Kp, Ti, noise=0.005, load=0.5, periods=4.0, seed=seed))
    best = choose_structure(fit).best
    assert best.hypothesis.load_disturbances
    changing = find_changing_gain(fit, best)
    assert changing is None or changing.bic_gain < -5.0 * RIVAL_BIC
    assert evaluate(fit.record, DesignSpec(1.6)).reason not in (Reason.UNEXPLAINED, Reason.AMBIGUOUS)


def test_a_curved_valve_in_place_of_load_disturbances_is_refused_with_its_size() -> None:
    evaluation = evaluate(curved(THREE_LAGS, 0.2), DesignSpec(1.6))
    assert evaluation.reason in (Reason.UNEXPLAINED, Reason.AMBIGUOUS, Reason.UNCERTAIN)
    assert "the plant's gain" in evaluation.detail


def test_a_model_without_load_disturbances_is_not_asked() -> None:
    fit = Fit(relay_record("three lags"))
    best = choose_structure(fit).best
    assert not best.hypothesis.load_disturbances
    assert find_changing_gain(fit, best) is None


def curved(bench: Bench, curvature: float) -> ExperimentRecord:
    """A relay's record of this plant behind a curved valve: PV is what the plant makes of u + curvature u^2 / d."""
    linear = record(bench, 0.0)
    changed = replace(linear, u=np.asarray(linear.u + curvature * np.square(linear.u) / linear.input_range))
    y = _driven(bench, changed.u) + np.random.default_rng(3).normal(0.0, NOISE * linear.output_range, len(linear.u))
    return replace(linear, y=np.asarray(y))


def _driven(bench: Bench, u: Reals) -> Reals:
    plant = LinearPlant(bench.num, bench.den, bench.L, bench.Ts)
    found = []
    for value in u:
        found.append(plant.pv)
        plant.step(float(value))
    return np.array(found)
