"""Criterion (7) and its minimum against the paper, golden values and a plain simulation of the same criterion."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.rules.robust_pi import UNSTABLE, Criterion, optimise
from tests.unit.tuning.tables import GOLDEN, TABLES, table4_model


def plain_criterion(model: FOPDT, gains: Gains, horizon: float) -> float:
    """The same sum by stepping each corner through time, Ms by search: slow, independent."""
    worst = 0.0
    for k, t, dead in product((0.8, 1.2), repeat=3):
        corner = FOPDT(k * model.K, t * model.T, dead * model.L)
        r = step_response(corner, gains, horizon, dt=min(corner.L, corner.T) / 200.0)
        inside = r.t <= horizon
        itae = float(np.trapezoid((r.t * np.abs(1.0 - r.y))[inside], r.t[inside]))
        J = 10.0 * itae + max(0.0, float(r.y.max()) - 1.0) + 10.0 * margins(corner, gains).Ms
        worst = max(worst, J)
    return worst


@pytest.mark.parametrize("d", [0.05, 0.2, 0.5, 1.0, 3.0])
def test_the_fast_criterion_is_the_plain_one(d: float) -> None:
    model, gains = FOPDT(2.0, 5.0, 5.0 * d), optimise(FOPDT(2.0, 5.0, 5.0 * d)).gains
    horizon = 10.0 * (model.T + model.L)
    for near in (gains, Gains(0.7 * gains.Kp, gains.Ti), Gains(gains.Kp, 1.3 * gains.Ti)):
        fast = Criterion(model, horizon, scale_free=False)(near.Kp, near.Ti)
        assert fast == pytest.approx(plain_criterion(model, near, horizon), rel=0.002)


@pytest.mark.parametrize("row", GOLDEN["stage5_J"]["rows"], ids=lambda r: f"tau={r['tau']}")
def test_golden_J(row: dict[str, float]) -> None:
    J = Criterion(FOPDT(row["k"], row["T"], row["tau"]), 40.0)(row["Kp"], row["Ti"])
    assert pytest.approx(row["J"], rel=0.003) == J


@pytest.mark.parametrize(("i", "name"), [(0, "P1"), (1, "P2"), (2, "P3")])
def test_table_4(i: int, name: str) -> None:
    printed = next(r for r in TABLES["table4"]["rows"] if r["model"] == name and r["method"] == "opt")
    implied = printed["implied_by_printed_margins"]
    found = optimise(table4_model(name), horizon_s=40.0)
    assert found.gains.Kp == pytest.approx(implied["Kp"], rel=0.015)
    assert found.gains.Ti == pytest.approx(implied["Ti"], rel=0.005)
    assert pytest.approx(GOLDEN["stage5_J"]["minimum"][i], rel=0.003) == found.J

    found = optimise(table4_model(name))
    golden = TABLES["table4"]["recomputed_long_horizon"][i]
    assert found.gains.Kp == pytest.approx(implied["Kp"], rel=0.04)
    assert found.gains.Ti == pytest.approx(implied["Ti"], rel=0.04)
    assert found.gains.Kp == pytest.approx(golden["Kp"], rel=0.005)
    assert found.gains.Ti == pytest.approx(golden["Ti"], rel=0.005)


@pytest.mark.parametrize("row", TABLES["table5"]["rows"], ids=lambda r: f"model {r['model']}")
def test_table_5(row: dict[str, Any]) -> None:
    estimated, expected = row["printed"]["estimated"], row["recomputed"]["opt_from_estimated"]
    found = optimise(FOPDT(estimated["k"], estimated["T"], row["settled"]["tau"]), scale_free=False)
    assert found.gains.Kp == pytest.approx(expected["Kp"], rel=0.01)
    assert found.gains.Ti == pytest.approx(expected["Ti"], rel=0.01)
    assert found.gains.Kp == pytest.approx(row["printed"]["opt"]["Kp"], rel=0.05)
    assert found.gains.Ti == pytest.approx(row["printed"]["opt"]["Ti"], rel=0.03)


def test_reactor() -> None:
    # printed 0.75 and 19.17 s
    found = optimise(FOPDT(1.08, 16.89, 11.75))
    assert (found.gains.Kp, found.gains.Ti) == pytest.approx((0.7505, 19.15), rel=0.005)


@pytest.mark.parametrize(("k", "golden"), [(1.0, "opt_with_k1"), (0.948, "opt_with_k5")])
def test_five_equal_lags(k: float, golden: str) -> None:
    found = optimise(FOPDT(k, 3.796, 2.402), scale_free=False)
    assert found.gains.Kp == pytest.approx(GOLDEN["equipole5"][golden]["Kp"], rel=0.005)
    assert found.gains.Ti == pytest.approx(GOLDEN["equipole5"][golden]["Ti"], rel=0.005)


@pytest.mark.parametrize("row", GOLDEN["stage5_time_scale"]["rows"], ids=lambda r: f"T={r[0]}")
def test_the_printed_criterion_depends_on_the_time_unit(row: list[float]) -> None:
    T, kkd, ti, Ms = row
    model = FOPDT(1.0, T, 0.5 * T)
    found = optimise(model, scale_free=False)
    assert found.gains.Kp * 0.5 == pytest.approx(kkd, rel=0.015)
    assert found.gains.Ti / T == pytest.approx(ti, rel=0.015)
    assert margins(model, found.gains).Ms == pytest.approx(Ms, abs=0.015)


def test_the_scale_free_criterion_does_not() -> None:
    reference = optimise(FOPDT(1.0, 5.0, 2.5), scale_free=False).gains
    for T in (0.002, 0.1, 4.9):
        found = optimise(FOPDT(1.0, T, 0.5 * T)).gains
        assert found.Kp == pytest.approx(reference.Kp, rel=0.005)
        assert found.Ti / T == pytest.approx(reference.Ti / 5.0, rel=0.005)


@pytest.mark.parametrize("start", [Gains(0.05, 0.5), Gains(3.0, 50.0), Gains(30.0, 0.3), Gains(1.0)])
def test_any_start_leads_to_the_same_pi(start: Gains) -> None:
    best = optimise(FOPDT(2.0, 5.0, 2.5))
    found = optimise(FOPDT(2.0, 5.0, 2.5), start=start)
    assert pytest.approx(best.J, rel=0.005) == found.J


def test_negative_gain() -> None:
    assert optimise(FOPDT(-2.0, 5.0, 2.5)) == optimise(FOPDT(2.0, 5.0, 2.5))


def test_instability_is_graded() -> None:
    criterion = Criterion(FOPDT(2.0, 5.0, 2.5), 75.0)
    J = [criterion(Kp, 5.35) for Kp in (0.5, 1.5, 2.0, 4.0, 8.0)]
    assert J[0] < UNSTABLE < J[1] < J[2] < J[3] < J[4]


def test_without_dead_time_there_is_no_limit_to_the_gain() -> None:
    with pytest.raises(ValueError):
        Criterion(FOPDT(2.0, 5.0, 0.0), 50.0)
