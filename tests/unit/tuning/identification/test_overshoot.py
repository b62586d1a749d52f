"""Formulas (2)-(5) against the print and against exact first-order plants."""

from __future__ import annotations

import pytest

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.identification.overshoot import fopdt_from_overshoot
from loopwright.tuning.models import FOPDT
from tests.unit.tuning.tables import EQUIPOLE5, GOLDEN, ziegler_nichols


@pytest.mark.parametrize("row", GOLDEN["formula2_on_exact_fopdt"]["rows"], ids=lambda r: f"d={r[0]}")
def test_on_exact_plants(row: list[float]) -> None:
    d_true, _, _, overshoot, d, L_ratio, T_ratio, k_ratio = row
    model = FOPDT(3.0, 10.0, 10.0 * d_true)
    gains = ziegler_nichols(*ultimate_point(model))
    figures = step_figures(model, gains)
    assert figures.overshoot_pct == pytest.approx(overshoot, abs=0.5)
    found = fopdt_from_overshoot(gains.Kp, gains.Ti, figures.overshoot_pct)
    # at small L/T the formula divides by a small number: 0.1 points of overshoot are 2 % of d
    rel = 0.01 if d_true > 0.1 else 0.03
    assert found.d == pytest.approx(d, rel=rel)
    assert pytest.approx(L_ratio, rel=0.01) == found.L / model.L
    assert pytest.approx(T_ratio, rel=rel) == found.T / model.T
    assert found.k5 / model.K == pytest.approx(k_ratio, rel=rel)
    if 0.1 <= d_true <= 0.9:
        assert found.d == pytest.approx(d_true, rel=0.02)


def test_on_five_equal_lags() -> None:
    golden = GOLDEN["equipole5"]
    gains = ziegler_nichols(*ultimate_point(EQUIPOLE5))
    figures = step_figures(EQUIPOLE5, gains)
    assert figures.overshoot_pct == pytest.approx(golden["overshoot_pct"], abs=0.5)
    found = fopdt_from_overshoot(gains.Kp, gains.Ti, figures.overshoot_pct)
    assert pytest.approx(2.40, abs=0.005) == found.L
    assert found.d == pytest.approx(golden["d"], rel=0.005)
    assert pytest.approx(golden["T"], rel=0.005) == found.T
    assert found.k5 == pytest.approx(golden["k_formula5"], rel=0.005)


def test_on_the_reactor() -> None:
    found = fopdt_from_overshoot(1.5 * 1.53 / 2.2, 42.31 / 1.2, 10.1)
    assert (found.k5, found.T, found.L) == pytest.approx((1.08, 16.89, 11.75), rel=0.003)


def test_no_overshoot_is_the_end_of_the_formula() -> None:
    assert fopdt_from_overshoot(1.0, 3.0, -0.4).d == pytest.approx(0.985, abs=0.001)


@pytest.mark.parametrize("bad", [(1.0, 3.0, 75.0), (0.0, 3.0, 20.0), (1.0, 0.0, 20.0)])
def test_beyond_the_formula(bad: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError):
        fopdt_from_overshoot(*bad)
