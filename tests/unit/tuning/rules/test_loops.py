"""What a rule is made for, found again in the loop it makes: closed-loop poles, margins, decay."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.special import lambertw

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, Reals
from loopwright.tuning.reasons import Refused
from loopwright.tuning.rules.direct_synthesis import NO_OVERSHOOT_C, STABLE_C, direct_synthesis
from loopwright.tuning.rules.imc import SAFE, UNSTABLE_ZERO
from loopwright.tuning.rules.registry import tune
from tests.unit.tuning.isa import response
from tests.unit.tuning.rules.tables import TABLES, sopdt

W = np.geomspace(1e-4, 1e2, 60_000)


def peak_sensitivity(model: Model, gains: Gains) -> float:
    """Ms on a plain grid, for integrating plants too."""
    loop = np.sign(model.num[-1]) * model.frequency_response(W) * response(gains, 1j * W)
    return float(np.max(1.0 / np.abs(1.0 + loop)))


def closed_loop(model: Model, gains: Gains, delay: tuple[Reals, Reals]) -> Reals:
    """Characteristic polynomial with a rational stand-in (num, den) for the dead time."""
    if gains.Ti > 0.0:
        num, den = gains.Kp * np.array([gains.Ti * gains.Td, gains.Ti, 1.0]), np.array([gains.Ti, 0.0])
    else:
        num, den = gains.Kp * np.array([gains.Td, 1.0]), np.array([1.0])
    num = np.polymul(np.polymul(num, model.num), delay[0])
    return np.polyadd(num, np.polymul(np.polymul(den, model.den), delay[1]))


def pade(L: float, order: int) -> tuple[Reals, Reals]:
    """The diagonal Pade approximation, highest power first."""
    f = math.factorial
    c = [math.comb(order, k) * f(2 * order - k) / f(2 * order) * L**k for k in range(order + 1)]
    return np.array([x * (-1.0) ** k for k, x in enumerate(c)][::-1]), np.array(c[::-1])


@pytest.mark.parametrize("row", TABLES["direct_synthesis"]["loop"], ids=lambda r: f"c={r['c']}")
def test_margins_of_direct_synthesis(row: dict[str, float]) -> None:
    """After the cancellation c alone decides, on any plant."""
    for model in (sopdt("P30"), sopdt("P33"), SOPDT(-2.0, 3.0, 0.4, 1.5), FOPDT(0.5, 3.0, 2.0)):
        found = margins(model, tune("direct-synthesis", model, c=row["c"]).gains)
        assert found.stable
        assert [found.GM, found.Ms] == pytest.approx([row["GM"], row["Ms"]], rel=1e-3)
        assert found.PM_deg == pytest.approx(row["PM_deg"], abs=0.05)


def test_bounds_of_the_direct_synthesis_gain() -> None:
    """1 + c exp(-x)/x = 0 has real roots, x = W(-c), up to 1/e; none with positive real part below pi/2."""
    for c, real in ((0.999 * NO_OVERSHOOT_C, True), (1.001 * NO_OVERSHOOT_C, False)):
        assert bool(lambertw(-c).imag == 0.0) is real
    assert lambertw(-0.999 * STABLE_C).real < 0.0
    assert lambertw(-1.001 * STABLE_C).real > 0.0


def test_the_papers_bound_is_not_safe() -> None:
    """(21) allows c = 1.9."""
    model = sopdt("P31")
    with pytest.raises(Refused, match="unstable; below pi/2"):
        direct_synthesis(model, c=1.9)


RULES = {"eq26": ("imc-pid", {"form": "zero"}), "eq12": ("imc-pid", {"form": "all-pass"}), "eq10": ("imc-pi", {})}


@pytest.mark.parametrize("row", TABLES["imc"]["loop"], ids=lambda r: f"{r['rule']} {r['rho']}")
def test_margins_of_imc(row: dict[str, Any]) -> None:
    """lambda/L alone decides, on any FOPDT."""
    name, options = RULES[row["rule"]]
    for model in (FOPDT(2.0, 7.0, 3.0), FOPDT(-0.1, 100.0, 1.0)):
        if not row["stable"]:
            with pytest.raises(Refused, match="unstable"):
                tune(name, model, lambda_s=row["rho"] * model.L, extrapolate=True, **options)
            continue
        found = margins(model, tune(name, model, lambda_s=row["rho"] * model.L, extrapolate=True, **options).gains)
        assert found.stable
        assert [found.GM, found.Ms] == pytest.approx([row["GM"], row["Ms"]], rel=1e-3)
        assert found.PM_deg == pytest.approx(row["PM_deg"], abs=0.05)


def test_end_of_stability_of_form_zero() -> None:
    model = FOPDT(1.0, 10.0, 1.0)
    found = margins(model, tune("imc-pid", model, lambda_s=1.001 * UNSTABLE_ZERO, extrapolate=True).gains)
    assert found.stable and pytest.approx(1.0, abs=3e-4) == found.GM


@pytest.mark.parametrize(
    ("loop", "name", "model", "options"),
    [
        ("taylor", "imc-pi", FOPDT(1.0, 5.0, 2.0), {}),
        ("taylor", "imc-pid", SOPDT(1.0, 3.0, 0.7, 2.0), {}),
        ("all-pass", "imc-pid", FOPDT(1.0, 5.0, 2.0), {"form": "all-pass"}),
        ("zero", "imc-pid", FOPDT(1.0, 5.0, 2.0), {}),
        ("integrating", "imc-pi", Integrating(1.0, 2.0), {}),
        ("integrating", "imc-pid", Integrating(1.0, 2.0), {}),
        ("zero", "imc-pid", Integrating(1.0, 2.0), {"psi_s": 5.0}),
        ("taylor", "imc-pi", Integrating(1.0, 2.0), {"psi_s": 20.0}),
    ],
)
def test_Ms_at_the_end_of_the_safe_range_of_imc(loop: str, name: str, model: Model, options: dict[str, Any]) -> None:
    minimum = SAFE[loop] * model.L
    assert 1.9 < peak_sensitivity(model, tune(name, model, lambda_s=minimum, **options).gains) < 2.2
    with pytest.raises(Refused, match=f"below {SAFE[loop]:g} L"):
        tune(name, model, lambda_s=0.99 * minimum, **options)
    beyond = tune(name, model, lambda_s=0.99 * minimum, extrapolate=True, **options)
    assert "below" in beyond.notes[0]


@pytest.mark.parametrize(
    ("name", "model", "delay", "cancelled"),
    [
        ("imc-pi", FOPDT(2.0, 5.0, 1.5), "taylor", [-1 / 5.0]),
        ("imc-pi", Integrating(2.0, 1.5), "taylor", [-1 / 4.0]),
        ("imc-pid", SOPDT(K=2.0, T1=5.0, T2=3.0, L=1.5), "taylor", [-1 / 5.0, -1 / 3.0]),
        ("imc-pid", FOPDT(2.0, 5.0, 1.5), "pade", [-1 / 5.0, -2 / 1.5]),
        ("imc-pid", Integrating(2.0, 1.5), "pade", [-1 / 4.0, -2 / 1.5]),
        ("lambda", FOPDT(2.0, 5.0, 1.5), "taylor", [-1 / 5.0]),
        ("lambda", Integrating(2.0, 1.5), "taylor", [-1 / 4.0]),
    ],
)
def test_the_closed_loop_has_the_filters_poles(name: str, model: Model, delay: str, cancelled: list[float]) -> None:
    """With the stand-in of the derivation for the dead time: -1/lambda, beside the poles that were cancelled; for an
    integrating plant -1/lambda twice."""
    stand_in = pade(model.L, 1) if delay == "pade" else (np.array([-model.L, 1.0]), np.array([1.0]))
    gains = tune(name, model, lambda_s=4.0).gains
    poles = np.sort_complex(np.roots(closed_loop(model, gains, stand_in)))
    expected = np.sort_complex(np.array([*cancelled, -0.25], dtype=complex))
    # a double pole comes to half the digits
    np.testing.assert_allclose(poles, expected, atol=1e-6)


@pytest.mark.parametrize("controller", ["p", "pi", "pid"])
@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5, 1.0])
def test_cohen_coon_decays_to_a_quarter(controller: str, ratio: float) -> None:
    """The dominant poles' decay in one period. The rule's formulas are fits: the paper's own aim was 0.25."""
    model = FOPDT(3.0, 2.0, 2.0 * ratio)
    gains = tune("cohen-coon", model, controller=controller).gains
    poles = np.roots(closed_loop(model, gains, pade(model.L, 8)))
    poles = poles[poles.imag > 1e-9]
    slowest = poles[np.argmax(poles.real)]
    decay = math.exp(2.0 * math.pi * slowest.real / slowest.imag)
    assert decay == pytest.approx(0.25, abs=0.04 if controller != "pi" or ratio < 1.0 else 0.1)


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.3, 1.0, 2.0, 5.0, 20.0])
def test_amigo_keeps_Ms_near_1_4(ratio: float) -> None:
    """The PID's design bound is 1.4 on FOPDT plants; the PI is a bound over a batch, and lower on most of them."""
    model = FOPDT(1.0, 1.0, ratio)
    assert margins(model, tune("amigo", model, controller="pid").gains).Ms == pytest.approx(1.42, abs=0.06)
    assert 1.2 < margins(model, tune("amigo", model, controller="pi").gains).Ms < 1.5


def test_amigo_of_the_literature() -> None:
    """1/(s + 1)^4 as the authors have it, T = 2.9, L = 1.42; an integrator is the limit of large T."""
    model = FOPDT(1.0, 2.9, 1.42)
    pi, pid = (tune("amigo", model, controller=c).gains for c in ("pi", "pid"))
    assert [pi.Kp, pi.Ti] == pytest.approx([0.414, 2.66], abs=0.006)
    assert [pid.Kp, pid.Ti, pid.Td] == pytest.approx([1.12, 2.40, 0.619], abs=0.006)
    assert [pid.b, tune("amigo", FOPDT(1.0, 1.0, 2.0), controller="pid").gains.b] == [0.0, 1.0]
    for controller in ("pi", "pid"):
        limit = tune("amigo", Integrating(0.2, 3.0), controller=controller).gains
        near = tune("amigo", FOPDT(0.2e7, 1e7, 3.0), controller=controller).gains
        assert [limit.Kp, limit.Ti, limit.Td] == pytest.approx([near.Kp, near.Ti, near.Td], rel=1e-4)


@pytest.mark.parametrize("Ms", [1.4, 2.0])
@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 2.0, 5.0])
def test_kappa_tau_loops_are_stable(Ms: float, ratio: float) -> None:
    model = FOPDT(1.0, 1.0, ratio)
    found = margins(model, tune("kappa-tau", model, Ms=Ms).gains)
    assert found.stable
    assert (1.2 < found.Ms < 1.4) if Ms == 1.4 else (1.5 < found.Ms < 2.6)


def test_margins_of_simc() -> None:
    """Skogestad's table: GM 3.14, PM 61.4 deg, Ms 1.59 for T <= 8 L; GM 2.96, PM 46.9 deg, Ms 1.70 integrating."""
    model = FOPDT(2.0, 3.0, 1.0)
    found = margins(model, tune("simc", model).gains)
    assert [found.GM, found.PM_deg, found.Ms] == pytest.approx([math.pi, 61.35, 1.590], rel=1e-3)
    integrating = FOPDT(1e7, 1e7, 1.0)
    found = margins(integrating, tune("simc", integrating).gains)
    assert [found.GM, found.PM_deg, found.Ms] == pytest.approx([2.96, 46.9, 1.70], rel=3e-3)
    gains = tune("simc", Integrating(1.0, 1.0)).gains
    assert [gains.Kp, gains.Ti] == pytest.approx([0.5, 8.0])
    assert peak_sensitivity(Integrating(1.0, 1.0), gains) == pytest.approx(1.70, rel=3e-3)


@pytest.mark.parametrize("model", [SOPDT(K=2.0, T1=30.0, T2=4.0, L=1.0), Integrating(2.0, 1.0, 4.0)])
def test_the_pid_of_simc_is_a_pi_and_a_cancelled_lag(model: SOPDT | Integrating) -> None:
    simpler = FOPDT(2.0, 30.0, 1.0) if isinstance(model, SOPDT) else Integrating(2.0, 1.0)
    pi, pid = tune("simc", simpler, tau_c_s=2.0).gains, tune("simc", model, controller="pid", tau_c_s=2.0).gains
    loop = model.frequency_response(W) * response(pid, 1j * W)
    np.testing.assert_allclose(loop, simpler.frequency_response(W) * response(pi, 1j * W), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "options", "ratios"),
    [
        (name, {"controller": controller, **more}, ratios)
        for name, more, ratios in (
            ("zn-step", {}, (0.1, 0.5, 1.0)),
            ("cohen-coon", {}, (0.05, 0.5, 1.0)),
            ("chr", {"aim": "setpoint", "overshoot_pct": 0}, (0.1, 0.5, 1.0)),
            ("chr", {"aim": "setpoint", "overshoot_pct": 20}, (0.1, 0.5, 1.0)),
            ("chr", {"aim": "load", "overshoot_pct": 0}, (0.1, 0.5, 1.0)),
            ("chr", {"aim": "load", "overshoot_pct": 20}, (0.1, 0.5, 1.0)),
            ("zn-ultimate", {}, (0.02, 0.5, 2.0)),
        )
        for controller in ("p", "pi", "pid")
    ],
)
def test_loops_are_stable_over_the_whole_range(name: str, options: dict[str, Any], ratios: tuple[float, ...]) -> None:
    for ratio in ratios:
        model = FOPDT(-2.0, 5.0, 5.0 * ratio)
        found = margins(model, tune(name, model, **options).gains)
        assert found.stable and found.Ms < 4.2


def test_chien_hrones_reswick_by_hand() -> None:
    """K = 2, T = 10 s, L = 2 s: a = 0.4."""
    model = FOPDT(2.0, 10.0, 2.0)
    for aim, overshoot, controller, expected in (
        ("setpoint", 0, "p", (0.75, 0.0, 0.0)),
        ("setpoint", 0, "pi", (0.875, 12.0, 0.0)),
        ("setpoint", 20, "p", (1.75, 0.0, 0.0)),
        ("setpoint", 20, "pi", (1.5, 10.0, 0.0)),
        ("load", 0, "p", (0.75, 0.0, 0.0)),
        ("load", 0, "pi", (1.5, 8.0, 0.0)),
        ("load", 20, "p", (1.75, 0.0, 0.0)),
        ("load", 20, "pi", (1.75, 4.6, 0.0)),
    ):
        g = tune("chr", model, aim=aim, overshoot_pct=overshoot, controller=controller).gains
        assert (g.Kp, g.Ti, g.Td) == pytest.approx(expected)


def test_ziegler_nichols_of_an_integrating_plant_is_the_limit() -> None:
    """Slope and apparent dead time are all the rule knows; a lag of the integrating plant delays its ramp."""
    for controller in ("p", "pi", "pid"):
        limit = tune("zn-step", Integrating(0.5, 2.0), controller=controller).gains
        near = tune("zn-step", FOPDT(0.5e6, 1e6, 2.0), controller=controller, extrapolate=True).gains
        assert limit == near
        assert tune("zn-step", Integrating(0.5, 1.5, 0.5), controller=controller).gains == limit


def test_where_a_pid_of_the_ultimate_cycle_ends() -> None:
    for name in ("zn-ultimate", "tyreus-luyben"):
        assert tune(name, FOPDT(1.0, 1.0, 20.0), controller="pi").gains.Kp > 0.0
        with pytest.raises(Refused, match="unstable"):
            tune(name, FOPDT(1.0, 1.0, 20.0), controller="pid")


def test_the_coefficient_of_cohen_coons_variant_is_too_large() -> None:
    """Unstable from L/T = 0.864 by the poles of the closed loop, where the original still decays to a quarter."""
    for ratio, stable in ((0.862, True), (0.865, False)):
        model = FOPDT(1.0, 1.0, ratio)
        kp, tau = 0.9 * (1.0 + 0.92 * ratio) / ratio, ratio / (1.0 + ratio)
        gains = Gains(kp, ratio * (3.3 - 3.0 * tau) / (1.0 + 1.2 * tau))
        poles = np.roots(closed_loop(model, gains, pade(ratio, 8)))
        assert bool(np.all(poles.real < 0.0)) is stable
        if stable:
            found = tune("cohen-coon", model, variant="tau").gains
            assert [found.Kp, found.Ti] == pytest.approx([gains.Kp, gains.Ti])
        else:
            with pytest.raises(Refused, match="variant tau"):
                tune("cohen-coon", model, variant="tau", extrapolate=True)
