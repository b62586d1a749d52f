"""The assessment of a setting against loops simulated independently, closed forms and Parseval's theorem."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from loopwright.tuning.analysis.assessment import assess
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.analysis.step_response import step_figures, step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.tables import MODELS as TABLE_MODELS
from tests.unit.tuning.tables import ROOT, transfer_function

LOOPS: dict[str, Any] = json.loads((ROOT / "tests/data/loops-recomputed.json").read_text(encoding="utf-8"))


def plant(row: dict[str, Any]) -> Model:
    if len(row["den"]) == 2 and row["den"][1] == 0.0:
        return Integrating(row["num"][0], row["L"])
    if row["num"][1:] or len(row["den"]) > 3:
        return TransferFunction(tuple(row["num"]), tuple(row["den"]), row["L"])
    if len(row["den"]) == 2:
        return FOPDT(row["num"][0], row["den"][0], row["L"])
    a2, a1, _ = row["den"]
    return SOPDT(row["num"][0], math.sqrt(a2), a1 / (2.0 * math.sqrt(a2)), row["L"])


@pytest.mark.parametrize("row", LOOPS["pid_loops"], ids=lambda r: r["id"])
def test_ideal_pid_with_exact_dead_time(row: dict[str, Any]) -> None:
    model, gains = plant(row), Gains(row["Kp"], row["Ti"], row["Td"], Tf=0.0, c=1.0)
    found = assess(model, gains)
    assert found.stable
    wanted = row["margins"]
    assert pytest.approx(wanted["GM"], rel=1e-3) == found.margins.GM
    assert found.margins.PM_deg == pytest.approx(wanted["PM_deg"], abs=0.01)
    assert found.margins.Ms == pytest.approx(wanted["Ms"], rel=1e-3)
    if "delay_margin_s" in wanted:
        assert found.margins.delay_margin_s == pytest.approx(wanted["delay_margin_s"], rel=1e-4)
    loose = 2.0 if wanted["Ms"] > 3.0 else 1.0
    for load in (False, True):
        wanted = row["load" if load else "setpoint"]
        figures = step_figures(model, gains, horizon=row["horizon_s"], load=load)
        assert pytest.approx(wanted["IAE"], rel=5e-4 * loose) == figures.IAE
        assert pytest.approx(wanted["ISE"], rel=5e-4 * loose) == figures.ISE
        assert pytest.approx(wanted["ITAE"], rel=2e-3 * loose) == figures.ITAE
        if load and "peak" in wanted:
            assert figures.peak == pytest.approx(wanted["peak"], rel=2e-3)
        if not load:
            assert figures.overshoot_pct == pytest.approx(wanted["overshoot_pct"], abs=0.05 * loose)
            assert figures.settling_s == pytest.approx(wanted["ts2"], rel=5e-3)
            within_5 = step_figures(model, gains, horizon=row["horizon_s"], band=0.05).settling_s
            assert within_5 == pytest.approx(wanted["ts5"], rel=5e-3)
            if "rise" in wanted:
                assert figures.rise_s == pytest.approx(wanted["rise"], rel=1e-3)


@pytest.mark.parametrize("row", LOOPS["delay_integrator"], ids=lambda r: f"c={r['c']:.4g}")
def test_the_loop_of_direct_synthesis(row: dict[str, Any]) -> None:
    # the PID cancels both lags: c*exp(-x)/x, x = 3 s
    c, theta = row["c"], 3.0
    found = assess(SOPDT(K=2.0, T1=7.0, T2=4.0, L=theta), Gains(c * 11.0 / (2.0 * theta), 11.0, 28.0 / 11.0, c=1.0))
    m, figures = found.margins, found.setpoint
    assert figures is not None
    assert pytest.approx(math.pi / (2.0 * c), rel=1e-6) == m.GM
    assert m.PM_deg == pytest.approx(90.0 - math.degrees(c), abs=1e-4)
    assert m.wgc == pytest.approx(c / theta, rel=1e-6)
    assert m.delay_margin_s == pytest.approx((math.pi / 2.0 - c) / c * theta, rel=1e-5)
    assert m.Ms == pytest.approx(row["Ms"], rel=1e-4)
    assert pytest.approx(theta * math.cos(c) / (2.0 * c * (1.0 - math.sin(c))), rel=1e-3) == figures.ISE
    assert figures.settling_s == pytest.approx(row["ts2"] * theta, rel=2e-3)
    assert figures.overshoot_pct == pytest.approx(row["overshoot_pct"], abs=0.02)
    assert figures.rise_s == pytest.approx(row["rise_10_90"] * theta, rel=1e-3)
    if c <= 1.0 / math.e:
        assert figures.overshoot_pct == pytest.approx(0.0, abs=1e-6)
        assert pytest.approx(theta / c, rel=1e-3) == figures.IAE
        assert pytest.approx((1.0 - c) * theta**2 / c**2, rel=5e-3) == figures.ITAE


def imc_gains(rule: str, rho: float, model: FOPDT) -> Gains:
    """Rules (9)-(10), (11)-(12), (26)-(28) of Mabu Sarif et al."""
    K, tau, theta = model.K, model.T, model.L
    if rule == "eq10":
        return Gains(tau / (K * theta * (rho + 1.0)), tau)
    wide = theta * (rho + (0.5 if rule == "eq26" else 1.0))
    return Gains((tau + theta / 2.0) / (K * wide), tau + theta / 2.0, tau * theta / (2.0 * tau + theta), c=1.0)


@pytest.mark.parametrize("row", LOOPS["imc_normalised"], ids=lambda r: f"{r['rule']} {r['rho']}")
def test_the_loops_of_imc(row: dict[str, Any]) -> None:
    model = FOPDT(3.0, 5.0, 2.0)
    found = assess(model, imc_gains(row["rule"], row["rho"], model))
    assert found.stable == row["stable"]
    if not found.stable:
        assert found.setpoint is None and found.load is None
        return
    assert found.setpoint is not None
    assert pytest.approx(row["GM"], rel=1e-3) == found.margins.GM
    assert found.margins.PM_deg == pytest.approx(row["PM_deg"], abs=0.02)
    assert found.margins.Ms == pytest.approx(row["Ms"], rel=1e-3)
    assert found.setpoint.overshoot_pct == pytest.approx(row["overshoot_pct"], abs=0.1)
    assert found.setpoint.settling_s == pytest.approx(2.0 * row["ts2"], rel=5e-3)
    assert pytest.approx(2.0 * row["IAE"], rel=2e-3) == found.setpoint.IAE
    assert pytest.approx(2.0 * row["ISE"], rel=2e-3) == found.setpoint.ISE
    assert pytest.approx(4.0 * row["ITAE"], rel=5e-3) == found.setpoint.ITAE


# between each limit found by simulation, lambda > 0.14453 theta for (26)-(28) and c < pi/2
def test_the_limits_of_stability() -> None:
    model = FOPDT(3.0, 5.0, 2.0)
    assert not assess(model, imc_gains("eq26", 0.1445, model)).stable
    assert assess(model, imc_gains("eq26", 0.1446, model)).stable
    for c, stable in ((1.5707, True), (1.5709, False)):
        gains = Gains(c * 5.0 / (3.0 * 2.0), 5.0)
        assert assess(model, gains).stable is stable


def test_the_printed_indices_of_imc() -> None:
    # Mabu Sarif et al., Table 1, IMC-PID, set-point: a step at 1 s, time counted from 0, 250 s, the printed gains
    found = step_figures(FOPDT(100.0, 100.0, 1.0), Gains(0.049, 100.5, 0.5, c=1.0), horizon=249.0)
    assert pytest.approx(20.51, rel=1e-3) == found.IAE
    assert pytest.approx(10.54, rel=5e-3) == found.ISE
    # 2 % below the print, which no reading of the test explains
    assert pytest.approx(439.7, rel=0.025) == found.ITAE + 1.0 * found.IAE


@pytest.mark.parametrize("row", LOOPS["me_pso"], ids=lambda r: r["id"])
def test_mean_error_and_mean_control(row: dict[str, Any]) -> None:
    gains = Gains(row["Kp"], row["Ti_isa"])
    model = plant(row)
    figures = step_figures(model, gains, horizon=row["horizon_s"], band=0.05)
    assert pytest.approx(row["MIE"], abs=1e-3) == figures.MIE
    assert pytest.approx(row["MIC"], abs=3e-3 if row["id"].startswith("G4") else 1e-3) == figures.MIC
    assert figures.overshoot_pct == pytest.approx(row["overshoot_pct"], abs=0.05)
    assert figures.settling_s == pytest.approx(row["ts"], abs=0.01)
    assert assess(model, gains).margins.Ms == pytest.approx(row["Ms"], rel=1e-3)


MODELS: list[Model] = [
    FOPDT(-2.0, 5.0, 2.5),
    SOPDT(1.5, 4.0, 0.4, 1.0),
    Integrating(0.2, 2.0, 3.0),
    TransferFunction((-0.5, 1.0), (6.0, 5.0, 1.0), 0.7),
    TransferFunction((1.0, 4.0), (3.0, 1.0), 0.4),
    SOPDT(1.5, 4.0, 0.4, 0.0),
    Integrating(0.2, 0.0),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{type(m).__name__} {m.L}")
@pytest.mark.parametrize("gains", [Gains(0.25, 9.0), Gains(0.2, 9.0, 1.0, 0.1, c=1.0), Gains(0.2, 9.0, 1.0, 0.1)])
def test_squared_error_by_parseval(model: Model, gains: Gains) -> None:
    """ISE = 1/pi * integral of |E(jw)|^2, from the frequency response alone: no simulation."""
    found = assess(model, gains)
    assert found.setpoint is not None and found.load is not None
    flip = -1.0 if model.num[-1] < 0.0 else 1.0

    def squared(w: float, load: bool) -> float:
        s = 1j * w
        P = flip * complex(model.frequency_response(np.array([w]))[0])
        lag = gains.Td * s / (gains.Tf * s + 1.0)
        C = gains.Kp * (1.0 + 1.0 / (gains.Ti * s) + lag)
        Cr = gains.Kp * (1.0 + 1.0 / (gains.Ti * s) + gains.c * lag)
        E = -P / (1.0 + P * C) if load else 1.0 - P * Cr / (1.0 + P * C)
        return abs(E / s) ** 2

    for load, figures in ((False, found.setpoint), (True, found.load)):
        edges = np.geomspace(1e-4, 1e3, 300)
        area = sum(quad(squared, a, b, args=(load,), epsrel=1e-8)[0] for a, b in pairwise(edges))
        # E(jw) is flat below, 1/w^2 above
        area += edges[0] * squared(float(edges[0]), load) + edges[-1] * squared(float(edges[-1]), load)
        assert pytest.approx(area / math.pi, rel=1e-3) == figures.ISE


@pytest.mark.parametrize("model", MODELS[:2], ids=lambda m: type(m).__name__)
def test_control_figures_of_a_smooth_answer(model: Model) -> None:
    # MV rises from Kp to 1/K without turning back: total variation is what it covers
    gains = Gains(0.02, 5.0)
    found = assess(model, gains).setpoint
    assert found is not None
    assert found.overshoot_pct == pytest.approx(0.0, abs=1e-6)
    assert pytest.approx(1.0 / abs(model.static_gain), rel=1e-3) == found.TV
    assert found.peak_u == pytest.approx(1.0 / abs(model.static_gain), rel=1e-3)


def test_the_effort_of_a_known_answer() -> None:
    # P on a lag without dead time: u - u_end = Kp*k/(1+k)*exp(-(1+k)t/T)
    found = assess(FOPDT(2.0, 5.0, 0.0), Gains(1.5)).setpoint
    assert found is not None
    k, rate = 3.0, 4.0 / 5.0
    swing = 1.5 * k / (1.0 + k)
    assert found.effort == pytest.approx(swing**2 / (2.0 * rate), rel=1e-4)
    assert pytest.approx(1.5 + swing, rel=1e-4) == found.TV
    assert found.settling_s == pytest.approx(-math.log(0.02) / rate, rel=1e-4)


def test_nothing_depends_on_the_units_of_time_and_gain() -> None:
    gains = Gains(0.5, 6.0, 0.8, 0.08, c=1.0)
    one = assess(SOPDT(1.2, 3.0, 0.7, 1.0), gains)
    other = assess(SOPDT(-1.2e-3, 3000.0, 0.7, 1000.0), Gains(500.0, 6000.0, 800.0, 80.0, c=1.0))
    assert one.setpoint is not None and other.setpoint is not None and one.load is not None and other.load is not None
    assert pytest.approx(one.margins.GM, rel=1e-6) == other.margins.GM
    assert other.margins.bandwidth == pytest.approx(one.margins.bandwidth / 1000.0, rel=1e-6)
    assert pytest.approx(1e3 * one.setpoint.IAE, rel=1e-6) == other.setpoint.IAE
    assert pytest.approx(1e6 * one.setpoint.ITSE, rel=1e-6) == other.setpoint.ITSE
    assert pytest.approx(1e3 * one.setpoint.TV, rel=1e-6) == other.setpoint.TV
    assert other.load.peak == pytest.approx(1e-3 * one.load.peak, rel=1e-6)


def test_an_unstable_loop_has_a_verdict_and_no_figures() -> None:
    found = assess(FOPDT(2.0, 5.0, 2.5), Gains(5.0, 2.0))
    assert (found.stable, found.setpoint, found.load) == (False, None, None)
    for call in (step_figures, step_response):
        with pytest.raises(Refused) as refused:
            call(FOPDT(2.0, 5.0, 2.5), Gains(5.0, 2.0))
        assert refused.value.reason is Reason.NOT_ROBUST
    with pytest.raises(Refused, match="beyond all bounds"):
        step_response(FOPDT(2.0, 5.0, 0.5), Gains(50.0, 0.1), horizon=2000.0)


@pytest.mark.parametrize("L", [0.0, 1e-9, 1e-6, 1e-3, 0.1])
def test_a_dead_time_that_does_not_matter(L: float) -> None:
    found = assess(SOPDT(1.0, 100.0, 1.2, L), Gains(0.8, 90.0))
    exact = assess(SOPDT(1.0, 100.0, 1.2, 0.0), Gains(0.8, 90.0))
    assert found.setpoint is not None and exact.setpoint is not None
    assert pytest.approx(exact.setpoint.IAE, rel=3e-3) == found.setpoint.IAE
    assert found.setpoint.overshoot_pct == pytest.approx(exact.setpoint.overshoot_pct, abs=0.2)


@pytest.mark.parametrize("load", [False, True], ids=["set-point", "load"])
@pytest.mark.parametrize("entry", TABLE_MODELS, ids=lambda m: str(m["id"]))
def test_the_default_record_is_long_and_fine_enough(entry: dict[str, Any], load: bool) -> None:
    model = transfer_function(entry)
    Ku, Pu = ultimate_point(model)
    gains = Gains(0.45 * Ku, 0.6 * Pu, 0.1 * Pu, 0.01 * Pu)
    if not assess(model, gains).stable:
        gains = Gains(0.2 * Ku, 1.5 * Pu)
    record = step_response(model, gains, load=load)
    step = float(np.max(np.diff(record.t)))
    found = step_figures(model, gains, load=load)
    finer = step_figures(model, gains, horizon=2.0 * float(record.t[-1]), dt=step / 3.0, load=load)
    assert pytest.approx(finer.IAE, rel=1e-3) == found.IAE
    assert pytest.approx(finer.ISE, rel=1e-3) == found.ISE
    assert found.overshoot_pct == pytest.approx(finer.overshoot_pct, abs=0.1)
    assert found.settling_s == pytest.approx(finer.settling_s, rel=2e-3)


@pytest.mark.parametrize("L", [1e-4, 1e-2, 1.0, 100.0])
def test_dead_times_of_all_sizes_beside_one_lag(L: float) -> None:
    # the direct-synthesis gain: the same curve in dead times, whatever the lag
    c = 6.0 - 4.0 * math.sqrt(2.0)
    found = assess(FOPDT(1.0, 10.0, L), Gains(c * 10.0 / L, 10.0))
    assert found.setpoint is not None and found.load is not None
    assert pytest.approx(L / c, rel=1e-3) == found.setpoint.IAE
    assert found.setpoint.settling_s == pytest.approx(7.4774 * L, rel=2e-3)
    # of the load: Ti/Kp, for an error that does not change sign
    assert pytest.approx(L / c, rel=1e-3) == found.load.IAE


def test_the_band_is_the_callers() -> None:
    model, gains = FOPDT(2.0, 5.0, 2.5), Gains(0.9, 7.5)
    wide, narrow = assess(model, gains, band=0.1), assess(model, gains, band=0.01)
    assert wide.setpoint is not None and narrow.setpoint is not None and narrow.load is not None
    assert (wide.setpoint.band, narrow.setpoint.band) == (0.1, 0.01)
    assert narrow.load.band == pytest.approx(0.01 * narrow.load.peak)
    response = step_response(model, gains, horizon=100.0, dt=0.01)
    for figures in (wide.setpoint, narrow.setpoint):
        assert figures.settling_s is not None
        later = np.abs(response.y - 1.0)[response.t > figures.settling_s + 0.01]
        assert float(np.max(later)) <= figures.band
        just_before = np.interp(figures.settling_s - 0.02, response.t, np.abs(response.y - 1.0))
        assert float(just_before) > figures.band


def test_an_instant_at_which_something_jumps_is_there_twice() -> None:
    # an ideal derivative on a lag of first order: PV jumps by K*Kp*Td/T a dead time after the set-point
    model, gains = FOPDT(2.0, 5.0, 1.5), Gains(0.5, 6.0, 1.0, c=1.0)
    response = step_response(model, gains, horizon=9.0, dt=0.1)
    twice = np.flatnonzero(np.diff(response.t) == 0.0)
    assert response.t[twice[0]] == pytest.approx(1.5)
    assert response.y[twice[0]] == pytest.approx(0.0, abs=1e-12)
    assert response.y[twice[0] + 1] == pytest.approx(2.0 * 0.5 * 1.0 / 5.0, rel=1e-9)
    # until then MV is Kp*(1 + t/Ti) and PV answers K*(1 - exp(-t/T)) to it, the derivative's impulse besides
    assert response.u[5] == pytest.approx(0.5 * (1.0 + response.t[5] / 6.0), rel=1e-9)


def test_gains_that_are_none() -> None:
    jumps = TransferFunction((1.0, 4.0), (3.0, 1.0), 1.0)
    for model, gains in (
        (FOPDT(1.0, 2.0, 1.0), Gains(-1.0, 2.0)),
        (FOPDT(1.0, 2.0, 1.0), Gains(1.0, math.nan)),
        (jumps, Gains(0.1, 2.0, 1.0)),
    ):
        with pytest.raises(Refused) as refused:
            assess(model, gains)
        assert refused.value.reason is Reason.BAD_INPUT
    with pytest.raises(Refused, match="horizon"):
        step_response(FOPDT(1.0, 2.0, 1.0), Gains(0.5, 2.0), horizon=0.0)
