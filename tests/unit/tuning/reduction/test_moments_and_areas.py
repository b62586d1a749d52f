"""Reductions against closed forms, the paper's Table 1 and models that are known."""

from __future__ import annotations

import decimal
import math
from typing import Any

import numpy as np
import pytest

from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.reduction.half_rule import half_rule
from loopwright.tuning.reduction.moments_and_areas import moments, two_areas
from tests.unit.tuning.tables import EQUIPOLE5, TABLES
from validation.step_fits import fit_closed_loop, fit_step

PLANTS_PI = Gains(Kp=0.887, Ti=0.887 / 0.225)
# five equal lags: 1 - y is the tail of a Poisson sum
FIVE_LAGS_T = np.linspace(0.0, 40.0, 2001)
FIVE_LAGS_Y = 1.0 - np.exp(-FIVE_LAGS_T) * sum(FIVE_LAGS_T**k / math.factorial(k) for k in range(5))


def row(method: str) -> dict[str, Any]:
    found: dict[str, Any] = next(r for r in TABLES["table1"]["rows"] if r["method"] == method)
    return found


def test_two_areas_in_closed_form() -> None:
    # of five equal lags: A0 = 5, A1 = 5^6 e^-5 / 5!
    model = two_areas(EQUIPOLE5)
    T = math.e * 5.0**6 * math.exp(-5.0) / 120.0
    assert pytest.approx((1.0, T, 5.0 - T), rel=1e-9) == (model.K, model.T, model.L)
    recomputed = row("Two areas")["recomputed"]
    assert pytest.approx((recomputed["T"], recomputed["tau"]), abs=0.01) == (model.T, model.L)


def area_of_lags(lags: list[float]) -> float:
    """The area A1 of the step response of lags, all different, by partial fractions, in exact enough arithmetic."""
    decimal.getcontext().prec = 80
    exact = [decimal.Decimal(lag) for lag in lags]
    A0 = area = sum(exact, decimal.Decimal(0))
    for i, lag in enumerate(exact):
        others = math.prod((lag - x for j, x in enumerate(exact) if j != i), start=decimal.Decimal(1))
        area -= lag ** len(lags) / others * (1 - (-A0 / lag).exp())
    return float(area)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3, 1e6])
@pytest.mark.parametrize(
    "lags",
    [
        [3.0, 2.5, 2.0, 1.5, 1.0, 0.8],
        [1.0, 1.4, 2.0, 1.1, 0.9, 1.7, 1.25, 2.5],
        [20.0, 3.0, 1.0],
        [1000.0, 700.0, 3.0, 1.0, 0.02, 0.01],
    ],
)
def test_two_areas_of_lags_in_any_unit_of_time(lags: list[float], unit: float) -> None:
    den = np.array([1.0])
    for lag in lags:
        den = np.polymul(den, [unit * lag, 1.0])
    found = two_areas(TransferFunction((-2.0,), tuple(den), 0.5 * unit))
    T = math.e * area_of_lags(lags)
    assert pytest.approx((-2.0, unit * T, unit * (sum(lags) + 0.5 - T)), rel=1e-9) == (found.K, found.T, found.L)


@pytest.mark.parametrize("lag", [1e-6, 1e6])
def test_two_areas_of_eight_equal_lags_in_any_unit_of_time(lag: float) -> None:
    # A1 = 8^9 e^-8 / 8!
    found = two_areas(TransferFunction((1.0,), tuple(np.poly([-1.0] * 8) * lag ** np.arange(8.0, -1.0, -1.0)), 0.0))
    T = math.e * 8.0**9 * math.exp(-8.0) / math.factorial(8)
    assert pytest.approx((lag * T, lag * (8.0 - T)), rel=1e-9) == (found.T, found.L)


# Romasevych et al.: the plants G2, G3, G5 and the moments behind their printed classical settings
@pytest.mark.parametrize(
    ("model", "T", "L"),
    [
        (TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0)), 1.73205, 1.26795),
        (TransferFunction((-0.1, 1.0), (1.0, 3.0, 3.0, 1.0)), 1.72916, 1.37084),
        (SOPDT(K=1.0, T1=0.5, T2=0.5, L=1.0), 0.70711, 1.29289),
    ],
    ids=["G2", "G3", "G5"],
)
def test_moments(model: TransferFunction | SOPDT, T: float, L: float) -> None:
    found = moments(model)
    assert pytest.approx((T, L), abs=6e-6) == (found.T, found.L)


@pytest.mark.parametrize("K", [2.0, -0.3])
@pytest.mark.parametrize("L", [0.0, 1.5])
def test_a_fopdt_model_reduces_to_itself(K: float, L: float) -> None:
    model = FOPDT(K, 4.0, L)
    for reduce in (half_rule, moments, two_areas):
        found = reduce(model)
        assert isinstance(found, FOPDT)
        assert pytest.approx((K, 4.0, L), rel=1e-9, abs=1e-9) == (found.K, found.T, found.L)


def test_an_integrating_model_has_neither_moments_nor_areas() -> None:
    for reduce in (moments, two_areas):
        with pytest.raises(Refused) as refused:
            reduce(Integrating(1.0, 1.0, 2.0))
        assert refused.value.reason is Reason.NOT_SELF_REGULATING


def test_least_squares_on_a_step_of_table_1() -> None:
    recomputed = row("Optimisation on the step response")["recomputed"]
    found = fit_step(FIVE_LAGS_T[:1001], FIVE_LAGS_Y[:1001], 1.0, 0.0, K=1.0)
    assert pytest.approx((recomputed["T"], recomputed["tau"]), abs=0.005) == (found.T, found.L)
    free = fit_step(FIVE_LAGS_T[:1001], FIVE_LAGS_Y[:1001], 1.0, 0.0)

    def cost(model: FOPDT) -> float:
        y = model.K * (1.0 - np.exp(-np.maximum(FIVE_LAGS_T[:1001] - model.L, 0.0) / model.T))
        return float(np.sum((y - FIVE_LAGS_Y[:1001]) ** 2))

    assert cost(free) < cost(found)
    assert cost(found) < min(cost(two_areas(EQUIPOLE5)), cost(moments(EQUIPOLE5)))


@pytest.mark.parametrize("end", [6.0, 60.0])
def test_least_squares_finds_the_model_behind_a_step(end: float) -> None:
    # 6 s is far from rest
    t = np.linspace(0.0, end, 400)
    y = 20.0 - 2.5 * (1.0 - np.exp(-np.maximum(t - 1.7, 0.0) / 5.0))
    found = fit_step(t, y, 2.0, 20.0)
    assert pytest.approx((-1.25, 5.0, 1.7), rel=1e-3) == (found.K, found.T, found.L)


def test_reverse_fit_of_table_1() -> None:
    loop = step_response(EQUIPOLE5, PLANTS_PI, horizon=40.0, dt=0.02)
    found = fit_closed_loop(loop.t, loop.y, PLANTS_PI, 1.0, 0.0, K=1.0)
    fifth = row("Reverse optimisation on closed-loop responses")
    # the optimum is flat: the recomputed T lies 0.8 % beside, with a cost that is higher
    recomputed = fifth["recomputed"]
    assert pytest.approx(recomputed["tau"], abs=0.005) == found.L
    assert pytest.approx(recomputed["T"], rel=0.01) == found.T

    def cost(T: float, L: float) -> float:
        other = step_response(FOPDT(1.0, T, L), PLANTS_PI, horizon=40.0, dt=0.02)
        return float(np.sum((np.interp(loop.t, other.t, other.y) - loop.y) ** 2))

    minimum = cost(found.T, found.L)
    for T, L in ((1.01, 1.0), (0.99, 1.0), (1.0, 1.01), (1.0, 0.99), (1.01, 0.99), (0.99, 1.01)):
        assert minimum < cost(T * found.T, L * found.L)
    assert minimum < cost(fifth["printed"]["T"], fifth["printed"]["tau"])


@pytest.mark.parametrize("gains", [Gains(0.9, 7.5), Gains(0.5, 5.0, b=0.4), Gains(0.8), Gains(1.0, 6.0, 0.8, 0.1)])
def test_reverse_fit_finds_the_model_behind_the_loop(gains: Gains) -> None:
    loop = step_response(FOPDT(2.0, 5.0, 2.5), gains, horizon=60.0, dt=0.05)
    t = np.linspace(0.0, 60.0, 601)
    y = 30.0 - 4.0 * np.interp(t, loop.t, loop.y)
    found = fit_closed_loop(t, y, gains, -4.0, 30.0)
    assert pytest.approx((2.0, 5.0, 2.5), rel=0.003) == (found.K, found.T, found.L)


def test_records_that_are_none() -> None:
    t, y = np.linspace(0.0, 5.0, 100), np.linspace(0.0, 1.0, 100)
    with pytest.raises(Refused, match="must increase"):
        fit_step(t[::-1], y, 1.0, 0.0)
    with pytest.raises(Refused, match="finite"):
        fit_step(t, np.where(t > 2.0, np.nan, y), 1.0, 0.0)
    with pytest.raises(Refused, match="shape"):
        fit_step(t[:5], y[:5], 1.0, 0.0)
    with pytest.raises(Refused) as refused:
        fit_step(t, np.full(100, 3.0), 1.0, 3.0)
    assert refused.value.reason is Reason.NO_RESPONSE
