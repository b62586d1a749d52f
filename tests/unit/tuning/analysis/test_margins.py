"""Margins and ultimate points against the paper's tables and, without dead time, against python-control."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest

from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.tables import EQUIPOLE5, GOLDEN, MODELS, TABLES, table4_model, transfer_function

# Table 1: one controller, designed for the full plant, on five reduced models of it
PLANTS_PI = Gains(Kp=0.887, Ti=0.887 / 0.225)


@pytest.mark.parametrize("row", TABLES["table1"]["rows"], ids=lambda r: r["method"])
def test_table_1(row: dict[str, Any]) -> None:
    p, recomputed = row["printed"], row["recomputed"]
    model = FOPDT(p["k"], p["T"], row.get("settled", p)["tau"])
    found = margins(model, PLANTS_PI)
    assert pytest.approx(recomputed["GM"], rel=0.005) == found.GM
    assert found.PM_deg == pytest.approx(recomputed["PM"], abs=0.3)


@pytest.mark.parametrize("row", TABLES["table2"]["rows"], ids=lambda r: r["model"])
def test_table_2(row: dict[str, Any]) -> None:
    p, recomputed = row["printed"], row["recomputed"]
    found = margins(EQUIPOLE5, Gains(Kp=p["kp"], Ti=p["kp"] / p["ki"]))
    assert pytest.approx(recomputed["GM"], rel=0.005) == found.GM
    assert found.PM_deg == pytest.approx(recomputed["PM"], abs=0.3)
    assert found.Ms == pytest.approx(recomputed["Ms"], rel=0.005)


@pytest.mark.parametrize("row", TABLES["table4"]["rows"], ids=lambda r: f"{r['model']} {r['method']}")
def test_table_4(row: dict[str, Any]) -> None:
    gains = row["recomputed"]
    found = margins(table4_model(row["model"]), Gains(Kp=gains["Kp"], Ti=gains["Ti"]))
    assert found.stable
    assert pytest.approx(gains["GM"], rel=0.005) == found.GM
    assert found.PM_deg == pytest.approx(gains["PM"], abs=0.3)
    if "Ms" in gains:
        assert found.Ms == pytest.approx(gains["Ms"], rel=0.005)
    # the print itself: exact for ZN-2, within the optimum's own tolerance for the optimised PI
    assert pytest.approx(row["printed"]["GM"], rel=0.005 if row["method"] == "ZN-2" else 0.015) == found.GM
    assert found.PM_deg == pytest.approx(row["printed"]["PM"], abs=0.4)


@pytest.mark.parametrize("entry", MODELS, ids=lambda m: str(m["id"]))
def test_ultimate_points_of_the_50_models(entry: dict[str, Any]) -> None:
    model = transfer_function(entry)
    Ku, Pu = ultimate_point(model)
    assert pytest.approx(entry["computed"]["Ku"], rel=0.001) == Ku
    assert pytest.approx(entry["computed"]["Pu"], rel=0.001) == Pu
    assert margins(model, Gains(Kp=0.99 * Ku)).stable
    assert not margins(model, Gains(Kp=1.01 * Ku)).stable


def test_ultimate_point_of_equal_lags() -> None:
    # five equal lags meet at 36 degrees each: w = tan 36, Ku = 1/cos^5 36
    Ku, Pu = ultimate_point(EQUIPOLE5)
    assert pytest.approx(math.cos(math.radians(36.0)) ** -5, rel=1e-6) == Ku
    assert pytest.approx(2.0 * math.pi / math.tan(math.radians(36.0)), rel=1e-6) == Pu
    assert pytest.approx(GOLDEN["equipole5"]["Ku"], rel=0.001) == Ku


@pytest.mark.parametrize("row", GOLDEN["formula2_on_exact_fopdt"]["rows"], ids=lambda r: f"d={r[0]}")
def test_ultimate_points_of_fopdt(row: list[float]) -> None:
    Ku, Pu = ultimate_point(FOPDT(2.0, 10.0, 10.0 * row[0]))
    assert 2.0 * Ku == pytest.approx(row[1], rel=0.001)
    assert Pu / (10.0 * row[0]) == pytest.approx(row[2], rel=0.001)


def test_an_integral_loop_with_dead_time_in_closed_form() -> None:
    # the PI cancels the lag: loop 0.5*exp(-s)/s, so wc = 0.5, PM = 90 deg - 0.5 rad, GM = pi
    found = margins(FOPDT(1.0, 4.0, 1.0), Gains(Kp=2.0, Ti=4.0))
    assert found.wgc == pytest.approx(0.5, rel=1e-6)
    assert found.PM_deg == pytest.approx(90.0 - math.degrees(0.5), abs=1e-4)
    assert pytest.approx(math.pi, rel=1e-6) == found.GM
    assert found.wpc == pytest.approx(math.pi / 2.0, rel=1e-6)


def test_the_sign_of_the_gain_is_the_action_of_the_controller() -> None:
    gains = Gains(Kp=0.9, Ti=7.5)
    assert margins(FOPDT(-2.0, 5.0, 2.5), gains) == margins(FOPDT(2.0, 5.0, 2.5), gains)


@pytest.mark.parametrize("K", [2.0, 200.0, 1e5])
def test_a_lag_without_dead_time_in_closed_form(K: float) -> None:
    # K above 100 crosses beyond a hundred times the corner of the lag
    found = margins(FOPDT(1.0, 100.0, 0.0), Gains(K))
    wc = math.sqrt(K * K - 1.0) / 100.0
    assert found.wgc == pytest.approx(wc, rel=1e-9)
    assert found.PM_deg == pytest.approx(180.0 - math.degrees(math.atan(100.0 * wc)), rel=1e-9)
    assert found.bandwidth is not None and found.bandwidth > wc
    assert found.Ms == 1.0 and found.GM is None and found.stable


@pytest.mark.parametrize("K", [1e3, 1e5, 1e9])
def test_two_lags_without_dead_time_in_closed_form(K: float) -> None:
    # closed loop: (x^2 + 2x)/(x^2 + 2x + 1 + K) for x = 10 s, a peak of about sqrt(K)/2
    found = margins(SOPDT(K=1.0, T1=10.0, T2=10.0, L=0.0), Gains(K))
    wc = math.sqrt(K - 1.0) / 10.0
    assert found.wgc == pytest.approx(wc, rel=1e-9)
    assert found.PM_deg == pytest.approx(180.0 - 2.0 * math.degrees(math.atan(10.0 * wc)), abs=1e-6)
    v = np.linspace(K - 10.0, K + 10.0, 200_001)
    peak = float(np.max(np.sqrt((v * v + 4.0 * v) / ((1.0 + K - v) ** 2 + 4.0 * v)))) if K < 1e6 else math.sqrt(K) / 2.0
    assert found.Ms == pytest.approx(peak, rel=1e-3)


@pytest.mark.parametrize("model", [FOPDT(1.0, 10.0, 0.0), Integrating(0.1, 0.0), SOPDT(1.0, 10.0, 2.0, 0.0)])
@pytest.mark.parametrize("Kp", [0.01, 1.0, 50.0])
def test_no_sensitivity_stays_below_its_limit(model: Any, Kp: float) -> None:
    """The sensitivity of a loop that passes no jump on ends at 1."""
    assert margins(model, Gains(Kp, 10.0)).Ms >= 1.0


# (10 s + 1)/(0.1 s + 1) exp(-20 s): the gain rises to 100, where the dead time turns thousands of times
LEAD = TransferFunction((10.0, 1.0), (0.1, 1.0), 20.0)


def test_the_ultimate_gain_of_a_plant_whose_gain_rises_with_frequency() -> None:
    Ku, _ = ultimate_point(LEAD)
    assert pytest.approx(0.01, rel=1e-3) == Ku
    assert margins(LEAD, Gains(0.999 * Ku)).stable
    assert not margins(LEAD, Gains(1.001 * Ku)).stable


def test_the_margins_of_a_plant_whose_gain_rises_with_frequency() -> None:
    found = margins(LEAD, Gains(0.0099))
    assert found.stable
    assert pytest.approx(1.0 / 0.99, rel=1e-3) == found.GM
    assert found.Ms == pytest.approx(1.0 / (1.0 - 0.99), rel=1e-6)
    assert found.Mt == pytest.approx(0.99 / (1.0 - 0.99), rel=1e-6)


def test_a_peak_between_two_turns_of_the_dead_time() -> None:
    """At the frequency where |L| peaks the dead time turns by far more than a turn between two points of the grid."""
    num = (456.2888784408331, -521.9964348631026, 37192.937532627744)
    den = (1.0, 70.2718154765495, 2866.0848938997624, 16127.390414744712)
    model, gains = TransferFunction(num, den, 74.75706292657354), Gains(0.1299614634492863)
    found = margins(model, gains)
    w = np.linspace(40.0, 70.0, 1_000_001)
    peak = float(np.max(1.0 / np.abs(1.0 + gains.Kp * model.frequency_response(w))))
    assert found.stable and found.Ms == pytest.approx(peak, rel=1e-3)


@pytest.mark.parametrize("zeta", [1e-3, 1e-4, 1e-5])
def test_a_mode_narrower_than_the_grid(zeta: float) -> None:
    """An integrating plant with a resonance: its phase turns by half a turn within a part zeta of the frequency."""
    model = TransferFunction((1.0,), (1.0 / 7.3**2, 2.0 * zeta / 7.3, 1.0, 0.0), 0.04)
    w = 7.3 * (1.0 + 20.0 * zeta * np.linspace(-1.0, 1.0, 400_001))
    L = model.frequency_response(w)
    at = np.flatnonzero(np.diff(np.sign(L.imag)))
    Ku, Pu = ultimate_point(model)
    assert pytest.approx(1.0 / np.abs(L[at[0]]), rel=1e-4) == Ku
    assert 2.0 * math.pi / Pu == pytest.approx(w[at[0]], rel=1e-6)
    assert margins(model, Gains(0.99 * Ku)).stable and not margins(model, Gains(1.01 * Ku)).stable
    peak = float(np.max(np.abs(0.8 * Ku * L / (1.0 + 0.8 * Ku * L))))
    assert margins(model, Gains(0.8 * Ku)).Mt == pytest.approx(peak, rel=1e-4)


def test_a_plant_without_ultimate_point_is_refused() -> None:
    with pytest.raises(Refused) as refused:
        ultimate_point(TransferFunction((1.0,), (2.0, 3.0, 1.0)))
    assert refused.value.reason is Reason.CANNOT_OSCILLATE


def test_against_python_control_without_dead_time() -> None:
    checked = 0
    for entry in MODELS:
        model = TransferFunction(tuple(entry["num"]), tuple(entry["den"]))
        gains = Gains(Kp=0.8, Ti=4.0, Td=0.5, Tf=0.05)
        found = margins(model, gains)
        s = control.tf("s")
        c = gains.Kp * (1.0 + 1.0 / (gains.Ti * s) + gains.Td * s / (gains.Tf * s + 1.0))
        loop = control.tf(list(model.num), list(model.den)) * c
        assert found.stable == bool(np.all(control.feedback(loop, 1).poles().real < 0.0)), entry["id"]
        if not found.stable:
            continue
        gm, pm, sm, *_ = control.stability_margins(loop)
        assert found.PM_deg == pytest.approx(pm, abs=0.01), entry["id"]
        # their sm leaves out the ends of the axis, where a bi-proper loop may come nearest
        nearest = float(np.min(np.abs(1.0 + loop(1j * np.geomspace(1e-4, 1e5, 20_000)))))
        assert 1.0 / found.Ms == pytest.approx(nearest, rel=0.001), entry["id"]
        if math.isfinite(sm):
            assert 1.0 / found.Ms <= sm * 1.001, entry["id"]
        assert (found.GM is None) == math.isinf(gm), entry["id"]
        if found.GM is not None:
            assert pytest.approx(gm, rel=0.001) == found.GM, entry["id"]
        checked += 1
    assert checked > 20


@pytest.mark.parametrize(
    "make",
    [
        lambda: FOPDT(0.0, 1.0, 1.0),
        lambda: FOPDT(1.0, -1.0, 1.0),
        lambda: FOPDT(1.0, 1.0, math.nan),
        lambda: TransferFunction((1.0, 1.0, 1.0), (1.0, 1.0)),
        lambda: TransferFunction((1.0,), (1.0, 0.0, 0.0)),
        lambda: TransferFunction((1.0,), (2.0,)),
    ],
)
def test_what_is_not_a_model(make: Any) -> None:
    with pytest.raises(ValueError):
        make()
