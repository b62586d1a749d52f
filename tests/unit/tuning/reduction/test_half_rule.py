"""The half rule and the tangent against the papers' tables, what they preserve, and a response differentiated."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.tuning.models import FOPDT, SOPDT, Integrating, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.reduction.half_rule import exact, half_rule
from loopwright.tuning.reduction.tangent import tangent
from tests.unit.tuning.rules.tables import OBJECTS, plant, sopdt
from tests.unit.tuning.tables import EQUIPOLE5, TABLES

W = np.geomspace(1e-3, 1e2, 100)
lags = st.lists(st.floats(0.01, 100.0), min_size=1, max_size=6)


def of_lags(gain: float, lags: list[float], zeros: list[float], L: float, origin: bool = False) -> TransferFunction:
    """zeros: time constants b of (1 - b s)."""
    num, den = np.array([gain]), np.array([1.0, 0.0] if origin else [1.0])
    for lag in lags:
        den = np.polymul(den, [lag, 1.0])
    for zero in zeros:
        num = np.polymul(num, [-zero, 1.0])
    return TransferFunction(tuple(num), tuple(den), L)


@pytest.mark.parametrize(
    ("name", "T", "L"), [("G1", 1.5, 0.5), ("G2", 1.5, 1.5), ("G3", 1.5, 1.6), ("G4", 1.05, 0.061), ("G5", 0.75, 1.25)]
)
def test_the_plants_of_the_me_pso_paper(name: str, T: float, L: float) -> None:
    found = half_rule(plant(name))
    assert isinstance(found, FOPDT)
    assert pytest.approx([1.0, T, L], rel=1e-6) == [found.K, found.T, found.L]


def test_table_1_of_the_five_stage_paper() -> None:
    row = next(r for r in TABLES["table1"]["rows"] if r["method"] == "Half rule")
    found = half_rule(EQUIPOLE5)
    assert pytest.approx([1.0, row["printed"]["T"], row["printed"]["tau"]], rel=1e-6) == [found.K, found.T, found.L]


def test_examples_of_skogestad() -> None:
    """Two of the plants of his paper, to the first and to the second order."""
    found = half_rule(of_lags(1.0, [1.0, 0.2], [], 0.0))
    assert pytest.approx([1.0, 1.1, 0.1]) == [found.K, found.T, found.L]
    # (-0.3 s + 1)(0.08 s + 1)/((2 s + 1)(1 s + 1)(0.4 s + 1)(0.2 s + 1)(0.05 s + 1)^3), the zero at the left left out
    found = half_rule(of_lags(1.0, [2.0, 1.0, 0.4, 0.2, 0.05, 0.05, 0.05], [0.3], 0.0))
    assert pytest.approx([2.5, 0.5 + 0.4 + 0.2 + 0.15 + 0.3], rel=1e-6) == [found.T, found.L]
    second = half_rule(of_lags(1.0, [2.0, 1.0, 0.4, 0.2, 0.05, 0.05, 0.05], [0.3], 0.0), 2)
    assert isinstance(second, SOPDT)
    assert pytest.approx([2.0, 1.2, 0.2 + 0.2 + 0.15 + 0.3], rel=1e-6) == [second.T1, second.T2, second.L]


@pytest.mark.parametrize("order", [1, 2])
@given(lags=lags, zeros=st.lists(st.floats(0.01, 10.0), max_size=1), L=st.floats(0.0, 10.0))
def test_the_mean_residence_time_stays(order: Any, lags: list[float], zeros: list[float], L: float) -> None:
    """The area between a step and the response to it, per unit of gain: sum of lags + dead time + zeros."""
    found = half_rule(of_lags(-2.0, lags, zeros, L), order)
    kept = found.T if isinstance(found, FOPDT) else 2.0 * found.zeta * found.T  # type: ignore[union-attr]
    assert pytest.approx(-2.0) == found.K
    assert kept + found.L == pytest.approx(sum(lags) + sum(zeros) + L, rel=1e-6)


@given(lags=lags, L=st.floats(0.0, 10.0))
def test_the_ramp_of_an_integrating_plant_stays(lags: list[float], L: float) -> None:
    found, second = (half_rule(of_lags(0.3, lags, [], L, origin=True), order) for order in (1, 2))
    assert isinstance(found, Integrating) and isinstance(second, Integrating)
    assert pytest.approx([0.3, 0.0]) == [found.K, found.T]
    assert pytest.approx(L + sum(lags), rel=1e-6) == found.L
    assert pytest.approx(L + sum(lags), rel=1e-6) == second.T + second.L


def test_half_rule_with_a_right_zero_keeps_two_lags() -> None:
    # lags 12, 3, 1, 0.2 s, zero 0.3 s, dead time 1 s: T2 3.5, L 1 + 0.5 + 0.2 + 0.3
    den = np.polymul(np.polymul([12.0, 1.0], [3.0, 1.0]), np.polymul([1.0, 1.0], [0.2, 1.0]))
    model = half_rule(TransferFunction((-0.6, 2.0), tuple(den), 1.0), 2)
    assert isinstance(model, SOPDT)
    assert pytest.approx((2.0, 12.0, 3.5, 2.0), rel=1e-9) == (model.K, model.T1, model.T2, model.L)


def test_half_rule_of_an_integrating_model() -> None:
    model = TransferFunction((0.4,), tuple(np.polymul([1.0, 0.0], np.polymul([4.0, 2.0], [1.0, 1.0]))), 0.5)
    assert half_rule(model) == Integrating(0.2, 3.5)
    kept = half_rule(model, 2)
    assert isinstance(kept, Integrating)
    assert pytest.approx((0.2, 2.5, 1.0), rel=1e-9) == (kept.K, kept.T, kept.L)


@pytest.mark.parametrize("T", [0.1, 1.0, 3.7, 27.0, 1000.0])
@pytest.mark.parametrize("n", [5, 6, 7, 8, 10, 12])
def test_equal_lags_of_a_high_order(n: int, T: float) -> None:
    """The computed poles of n equal lags are complex, up to 0.17 of their size."""
    found = half_rule(of_lags(2.0, [T] * n, [], 0.5 * T))
    assert isinstance(found, FOPDT)
    assert pytest.approx([2.0, 1.5 * T, (n - 1.0) * T], rel=1e-6) == [found.K, found.T, found.L]
    second = half_rule(of_lags(2.0, [T] * n, [], 0.5 * T, origin=True), 2)
    assert isinstance(second, Integrating)
    assert pytest.approx([2.0, 1.5 * T, (n - 1.0) * T], rel=1e-6) == [second.K, second.T, second.L]


@pytest.mark.parametrize(("n", "zeta"), [(3, 0.9999), (6, 0.9999), (8, 0.998), (10, 0.99), (12, 0.97), (20, 0.97)])
def test_a_plant_that_oscillates_is_refused_at_any_order(n: int, zeta: float) -> None:
    lags = of_lags(1.0, [0.6**k for k in range(n - 2)], [], 0.0)
    model = TransferFunction(lags.num, tuple(np.polymul(lags.den, [9.0, 6.0 * zeta, 1.0])), 1.0)
    with pytest.raises(Refused, match="complex"):
        half_rule(model)


@given(T=st.floats(0.1, 10.0), ratio=st.floats(0.01, 1.0))
def test_a_model_of_that_order_is_left_alone(T: float, ratio: float) -> None:
    for model, order in ((FOPDT(1.0, T, 1.0), 1), (Integrating(1.0, 1.0, T), 2)):
        assert half_rule(model, order) is model
    second = SOPDT(K=1.0, T1=T, T2=ratio * T, L=1.0)
    assert half_rule(second, 2) is second


@pytest.mark.parametrize(
    ("model", "why"),
    [
        (SOPDT(1.0, 1.0, 0.5, 0.1), "zeta = 0.5"),
        (TransferFunction((1.0,), (1.0, 0.4, 1.0, 1.0)), "not stable"),
        (TransferFunction((1.0,), (1.0, 2.0, 2.0, 1.0)), "complex"),
        (TransferFunction((1.0,), (-1.0, 1.0)), "not stable"),
        (TransferFunction((0.5, 1.0), (1.0, 3.0, 3.0, 1.0)), "left half-plane"),
    ],
)
def test_what_it_is_not_for(model: Any, why: str) -> None:
    with pytest.raises(Refused, match=why) as caught:
        half_rule(model)
    assert caught.value.reason is Reason.OUTSIDE_RANGE


@pytest.mark.parametrize(
    "model", [FOPDT(-2.0, 3.0, 1.0), SOPDT(2.0, 3.0, 0.4, 0.0), Integrating(0.2, 1.0), Integrating(-0.2, 1.0, 3.0)]
)
def test_a_transfer_function_that_is_one_of_the_kinds(model: Any) -> None:
    scaled = TransferFunction(tuple(3.0 * c for c in model.num), tuple(3.0 * c for c in model.den), model.L)
    found = exact(scaled)
    assert type(found) is type(model)
    np.testing.assert_allclose(found.frequency_response(W), model.frequency_response(W), rtol=1e-12)


@pytest.mark.parametrize(
    "model",
    [
        TransferFunction((1.0,), (-1.0, 1.0)),
        TransferFunction((1.0,), (1.0, -0.1, 1.0)),
        TransferFunction((1.0,), (-1.0, 1.0, 0.0)),
        TransferFunction((0.1, 1.0), (1.0, 2.0, 1.0)),
    ],
)
def test_a_transfer_function_that_is_none_of_them(model: TransferFunction) -> None:
    assert exact(model) is model


@pytest.mark.parametrize("name", OBJECTS)
def test_tangents_of_the_direct_synthesis_paper(name: str) -> None:
    found = tangent(sopdt(name))
    assert pytest.approx([OBJECTS[name]["tangent_T"], OBJECTS[name]["tangent_L"]], rel=1e-6) == [found.T, found.L]


@pytest.mark.parametrize("T2", [0.01, 0.5, 0.999999, 1.0])
def test_the_tangent_of_a_response_differentiated(T2: float) -> None:
    t = np.linspace(0.0, 10.0, 200_001)
    equal = 1.0 - (1.0 + t) * np.exp(-t)
    y = 1.0 - (np.exp(-t) - T2 * np.exp(-t / T2)) / (1.0 - T2) if T2 < 0.9 else equal
    slope = np.gradient(y, t)
    i = int(np.argmax(slope))
    found = tangent(SOPDT(K=4.0, T1=1.0, T2=T2, L=0.3))
    assert found.K == 4.0
    assert pytest.approx(1.0 / slope[i], rel=1e-5) == found.T
    assert pytest.approx(0.3 + t[i] - y[i] / slope[i], rel=1e-4) == found.L


def test_no_tangent_of_a_ringing_response() -> None:
    with pytest.raises(Refused, match="zeta >= 1") as caught:
        tangent(SOPDT(1.0, 1.0, 0.7, 1.0))
    assert caught.value.reason is Reason.OUTSIDE_RANGE
    assert math.isfinite(tangent(SOPDT(1.0, 1.0, 1.0, 1.0)).L)
