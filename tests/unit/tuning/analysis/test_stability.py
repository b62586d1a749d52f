"""The count of unstable poles against roots, high-order Pade approximants and known limits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import control
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.analysis.stability import is_stable, unstable_poles
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.tables import MODELS, transfer_function

sizes = st.floats(0.05, 20.0)


def poles_by_pade(model: Model, gains: Gains, order: int) -> np.ndarray:
    """Closed-loop poles with the dead time as a Pade approximant of that order, time in dead times."""
    s = control.tf("s")
    L = model.L
    c = gains.Kp * (1.0 + (1.0 / (gains.Ti * s / L) if gains.Ti else 0.0) + gains.Td / L * s / (gains.Tf / L * s + 1.0))

    def scaled(p: tuple[float, ...]) -> list[float]:
        return list(np.asarray(p) * L ** -np.arange(len(p) - 1, -1, -1.0))

    plant = control.tf(scaled(model.num), scaled(model.den)) * control.tf(*control.pade(1.0, order))
    return np.asarray(control.feedback(plant * c, 1).poles())


@settings(max_examples=150, deadline=None)
@given(sizes, sizes, sizes, st.floats(0.3, 2.0), st.sampled_from(["fopdt", "sopdt", "integrating"]))
def test_against_pade(Kp: float, Ti: float, T: float, zeta: float, kind: str) -> None:
    model: Model
    if kind == "fopdt":
        model = FOPDT(1.0, T, 1.0)
    elif kind == "sopdt":
        model = SOPDT(1.0, T, zeta, 1.0)
    else:
        model = Integrating(0.2, 1.0, T)
    gains = Gains(Kp, Ti, 0.2, 0.05)
    poles = poles_by_pade(model, gains, 10)
    # the approximant is right for poles that turn slowly within a dead time
    assume(not np.any((np.abs(poles.real) < 0.02) | ((poles.real > 0.0) & (np.abs(poles) > 8.0))))
    assert unstable_poles(model, gains) == int(np.sum(poles.real > 0.0))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=4), sizes, sizes)
def test_against_roots_without_dead_time(poles: list[float], Kp: float, Ti: float) -> None:
    den = np.poly(poles)
    assume(min(abs(p) for p in poles) > 0.05)
    direction = math.copysign(1.0, den[-1])
    closed = np.roots(np.polyadd(np.polymul(den, [Ti, 0.0]), direction * Kp * np.array([Ti, 1.0])))
    assume(np.min(np.abs(closed.real)) > 1e-6)
    assert unstable_poles(TransferFunction((1.0,), tuple(den)), Gains(Kp, Ti)) == int(np.sum(closed.real > 0.0))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=6), st.floats(-2.0, 2.0), st.booleans())
@example([-1.0, -1.0], 2.0, False)
def test_the_limit_of_lags_far_apart(decades: list[float], dead: float, integrating: bool) -> None:
    den = np.array([1.0])
    for decade in decades:
        den = np.polymul(den, [10.0**decade, 1.0])
    model = TransferFunction((-2.0,), (*den, 0.0) if integrating else tuple(den), 10.0**dead)
    Ku, Pu = ultimate_point(model)
    # the limit by its own equation: the loop at the ultimate frequency is -1/Ku
    at = model.frequency_response(np.array([2.0 * math.pi / Pu]))[0]
    assert at == pytest.approx(1.0 / Ku, rel=1e-6)
    assert is_stable(model, Gains(0.999 * Ku))
    # with a dead time far above the lags further pairs of poles cross the axis at hardly more than Ku
    crossed = sum(gain * 1.001 * Ku > 1.0 for gain in gains_at_180_degrees(decades, 10.0**dead, integrating, 1.0 / Ku))
    assert unstable_poles(model, Gains(1.001 * Ku)) == 2 * crossed


def gains_at_180_degrees(decades: list[float], L: float, integrating: bool, largest: float) -> Iterator[float]:
    """|G| where the phase is an odd multiple of -180 degrees, falling, as far as it is close to the largest."""
    lags = 10.0 ** np.array(decades)

    def beyond(w: float, limit: float) -> float:
        return float(np.sum(np.arctan(lags * w))) + L * w + (0.5 * math.pi if integrating else 0.0) - limit

    for odd in itertools.count(1, 2):
        limit = odd * math.pi
        w = brentq(beyond, 0.0, limit / L, args=(limit,), xtol=1e-300, rtol=1e-14)
        gain = 2.0 / float(np.prod(np.hypot(1.0, lags * w))) / (w if integrating else 1.0)
        if gain < 0.99 * largest:
            return
        assume(abs(gain / largest * 1.001 - 1.0) > 1e-6)
        yield gain


@pytest.mark.parametrize("entry", MODELS, ids=lambda m: str(m["id"]))
def test_the_ultimate_gain_is_the_limit(entry: dict[str, object]) -> None:
    model = transfer_function(entry)
    Ku, _ = ultimate_point(model)
    assert is_stable(model, Gains(0.999 * Ku))
    assert unstable_poles(model, Gains(1.001 * Ku)) == 2


def test_an_integrator_with_dead_time_under_p() -> None:
    # K*Kp*L = pi/2; the next pair follows at 5 pi/2
    model = Integrating(0.5, 2.0)
    assert [unstable_poles(model, Gains(x)) for x in (1.57, 1.58, 7.85, 7.86)] == [0, 2, 2, 4]


def test_an_integrator_under_pi_needs_damping() -> None:
    # 1/s^2-like at low frequency; without dead time any Ti is stable, with a lag T only Ti > T (Routh)
    assert is_stable(Integrating(0.5, 0.0), Gains(2.0, 0.01))
    assert is_stable(Integrating(0.5, 0.0, 3.0), Gains(2.0, 3.01))
    assert not is_stable(Integrating(0.5, 0.0, 3.0), Gains(2.0, 2.99))


@pytest.mark.parametrize(("Kp", "count"), [(0.4, 1), (40.0, 3)])
def test_an_unstable_plant_keeps_its_pole(Kp: float, count: int) -> None:
    # -2*exp(-0.5 s)/(5 s - 1): PV finally rises with MV, and one pole is real and right whatever the gain
    model = TransferFunction((-2.0,), (5.0, -1.0), 0.5)
    assert int(np.sum(poles_by_pade(model, Gains(Kp), 10).real > 0.0)) == count
    assert unstable_poles(model, Gains(Kp)) == count


def test_an_ideal_derivative_with_too_much_gain_has_infinitely_many() -> None:
    # rule (26)-(28) of Mabu Sarif et al.: the gain at high frequency is 0.5/(rho + 0.5)
    model = FOPDT(1.0, 4.0, 1.0)
    assert unstable_poles(model, Gains(1.0, 5.0, 4.1)) is None
    assert not is_stable(model, Gains(1.0, 5.0, 4.1))
    assert unstable_poles(model, Gains(1.0, 5.0, 0.5)) == 0


@pytest.mark.parametrize(
    ("model", "gains"),
    [
        (Integrating(0.2, 0.0, 3.0), Gains(0.5, 30.0)),
        (Integrating(-0.2, 0.0), Gains(0.5, 8.0)),
        (Integrating(0.2, 0.0), Gains(0.5)),
        (SOPDT(2.0, 3.0, 0.3, 0.0), Gains(0.4, 6.0)),
        (TransferFunction((1.0,), tuple(np.poly([-1.0, -1.0, -1.0, -0.2, 0.0]))), Gains(0.02, 60.0, 3.0, 0.3)),
        (FOPDT(2.0, 5.0, 0.0), Gains(1.5, 4.0, 0.5)),
    ],
    ids=["integrator and lag", "double integrator", "one integrator", "resonant", "five poles", "ideal derivative"],
)
def test_margins_against_python_control(model: Model, gains: Gains) -> None:
    s = control.tf("s")
    c = control.tf([gains.Kp], [1.0])
    if gains.Ti:
        c = (
            c * (1.0 + 1.0 / (gains.Ti * s))
            if not gains.Td
            else c * (1.0 + 1.0 / (gains.Ti * s) + gains.Td * s / (gains.Tf * s + 1.0))
        )
    flip = -1.0 if model.num[-1] < 0.0 else 1.0
    loop = flip * control.tf(list(model.num), list(model.den)) * c
    found = margins(model, gains)
    closed = control.feedback(loop, 1)
    assert found.stable == bool(np.all(closed.poles().real < 0.0))
    assert found.stable
    gm, pm, sm, wpc, wc, _ = control.stability_margins(loop)
    assert found.PM_deg == pytest.approx(pm, abs=0.01)
    assert found.wgc == pytest.approx(wc, rel=1e-4)
    if math.isinf(gm) or gm < 1.0:
        assert found.GM is None
    else:
        assert pytest.approx(gm, rel=1e-4) == found.GM
        assert found.wpc == pytest.approx(wpc, rel=1e-4)
    if math.isfinite(sm):
        assert 1.0 / found.Ms == pytest.approx(sm, rel=1e-3)
    assert found.bandwidth == pytest.approx(
        control.bandwidth(closed, dbdrop=20.0 * math.log10(math.sqrt(0.5))), rel=1e-4
    )


def test_conditional_stability_gives_the_upper_margin() -> None:
    # 1/s * PI with three lags: the phase passes -180 degrees below and above the crossover
    model = TransferFunction((1.0,), tuple(np.polymul([1.0, 0.0], np.poly([-0.05, -10.0, -10.0]) / 5.0)))
    gains = Gains(2.0, 15.0, 12.0, 0.01)
    found = margins(model, gains)
    assert found.stable
    assert found.GM is not None and found.GM > 1.0
    assert is_stable(model, Gains(0.999 * found.GM * 2.0, 15.0, 12.0, 0.01))
    assert not is_stable(model, Gains(1.001 * found.GM * 2.0, 15.0, 12.0, 0.01))
    # and less gain does end it too
    assert not is_stable(model, Gains(0.001, 15.0, 12.0, 0.01))


def test_bandwidth_with_dead_time() -> None:
    # the cancelled loop 0.5*exp(-s)/s: where |0.5/(jw*exp(jw) + 0.5)| is 1/sqrt 2, from the loop's own equation
    found = margins(FOPDT(1.0, 4.0, 1.0), Gains(2.0, 4.0)).bandwidth
    assert found is not None
    size = abs(0.5 / (1j * found * np.exp(1j * found) + 0.5))
    assert size == pytest.approx(math.sqrt(0.5), rel=1e-6)
    below = np.linspace(0.01, 0.99, 100) * found
    assert np.all(np.abs(0.5 / (1j * below * np.exp(1j * below) + 0.5)) > math.sqrt(0.5))


def test_a_gain_that_is_none() -> None:
    with pytest.raises(Refused) as refused:
        is_stable(FOPDT(1.0, 1.0, 1.0), Gains(0.0, 1.0))
    assert refused.value.reason is Reason.BAD_INPUT
