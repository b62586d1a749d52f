"""`loopwright.tuning` as a notebook uses it."""

from __future__ import annotations

import pydoc
import subprocess
import sys
from dataclasses import replace
from typing import Any

import control
import numpy as np
import pytest
from scipy import signal

from loopwright import tuning
from loopwright.service.inputs.model_json import parse_model
from loopwright.tuning.analysis.stability import is_stable
from tests.unit.tuning.operation.simulated import GAINS as IN_EFFECT
from tests.unit.tuning.operation.simulated import PLANT as OPERATED
from tests.unit.tuning.operation.simulated import operated, periods

PLANT = tuning.FOPDT(K=2.0, T=10.0, L=1.0)


def test_every_name_is_there_and_in_the_help() -> None:
    assert all(getattr(tuning, name) is not None for name in tuning.__all__)
    told = pydoc.plain(pydoc.render_doc(tuning))
    assert all(name in told for name in tuning.__all__)
    assert all(name in (tuning.__doc__ or "") for name in ("tune", "METHODS", "identify", "margins", "as_model"))
    with pytest.raises(AttributeError, match="no attribute 'tuned_by_magic'"):
        tuning.tuned_by_magic  # noqa: B018


def test_a_model_loads_no_rule() -> None:
    code = "import sys; from loopwright.tuning import FOPDT; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "loopwright.tuning.models" in loaded and "loopwright.tuning.rules.registry" not in loaded


def test_tune_says_gains_and_margins() -> None:
    found = tuning.tune(PLANT, "simc")
    # Skogestad 2003, eq. 23 and 24, tau_c = L
    assert (found.gains.Kp, found.gains.Ti) == (pytest.approx(2.5), pytest.approx(8.0))
    assert found.assessment.margins.Ms == tuning.margins(PLANT, found.gains).Ms
    assert str(found).startswith("SIMC: Kp 2.5, Ti 8 s; Ms 1.61")


@pytest.mark.parametrize(
    "system",
    [
        control.TransferFunction([2.0], [10.0, 1.0]),
        control.tf([2.0], [10.0, 1.0]),
        signal.TransferFunction([2.0], [10.0, 1.0]),
        signal.ZerosPolesGain([], [-0.1], 0.2),
        signal.StateSpace([[-0.1]], [[1.0]], [[0.2]], [[0.0]]),
        ([2.0], [10.0, 1.0]),
        tuning.TransferFunction((2.0,), (10.0, 1.0)).to_control(),
    ],
)
def test_models_of_other_libraries_are_tuned(system: tuning.Model) -> None:
    found = tuning.tune(system, "simc", dead_time_s=1.0)
    assert (found.gains.Kp, found.gains.Ti) == (pytest.approx(2.5), pytest.approx(8.0))
    w = np.array([0.01, 0.3])
    assert np.allclose(found.model.frequency_response(w), PLANT.frequency_response(w))


def in_other_states(num: list[float], den: list[float], seed: int) -> Any:
    """The state space of a fraction in states that are random sums of those that control takes."""
    T = np.random.default_rng(seed).standard_normal((len(den) - 1, len(den) - 1))
    return control.similarity_transform(control.ss(control.tf(num, den)), T)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(
    ("num", "den"),
    [
        ([2.0], [100.0, 80.0, 17.0, 1.0]),
        ([1e-8], [100.0, 80.0, 17.0, 1.0]),
        ([-3e6], [100.0, 80.0, 17.0, 1.0]),
        ([0.3], [7.3, 1.0, 0.0]),
        ([0.3], [20.0, 12.0, 1.0, 0.0]),
        # a slow pole, a fast zero and a slow one, each a millionth of the others or a million times as fast
        ([2.0], [1e6, 1e6, 1.0]),
        ([-1e-6, 1.0], [1.0, 1.6, 0.65, 0.05]),
        ([1.0, 1e-6], [1.0, 1.6, 0.65, 0.05]),
        ([1.0, 2.0], [3.0, 1.0]),
    ],
)
def test_a_state_space_has_the_coefficients_of_its_fraction(num: list[float], den: list[float], seed: int) -> None:
    system = in_other_states(num, den, seed)
    for each in (system, signal.StateSpace(system.A, system.B, system.C, system.D)):
        found = tuning.as_model(each, 1.0)
        assert (len(found.num), len(found.den), found.den[-1] == 0.0) == (len(num), len(den), den[-1] == 0.0)
        np.testing.assert_allclose(np.array(found.num) * den[0], num, rtol=1e-4)
        np.testing.assert_allclose(np.array(found.den) * den[0], den, rtol=1e-4)


LAGS, TANK = [100.0, 80.0, 17.0, 1.0], [7.3, 1.0, 0.0]


@pytest.mark.parametrize(
    ("rule", "den"),
    [*((rule, LAGS) for rule in ("simc", "lambda", "amigo", "robust", "imc-pid")), ("simc", TANK), ("lambda", TANK)],
)
def test_a_state_space_is_tuned_as_its_fraction(rule: str, den: list[float]) -> None:
    expected = tuning.tune(control.tf([2.0], den), rule, dead_time_s=1.0).gains
    for system in (control.ss(control.tf([2.0], den)), in_other_states([2.0], den, 1)):
        found = tuning.tune(system, rule, dead_time_s=1.0).gains
        assert (found.Kp, found.Ti, found.Td) == pytest.approx((expected.Kp, expected.Ti, expected.Td), rel=1e-6)


@pytest.mark.parametrize(
    ("system", "dead_time_s", "why"),
    [
        (control.tf([1.0], [1.0, 0.5], 0.1), 0.0, "discrete time"),
        (control.tf([[[1.0], [1.0]]], [[[1.0, 1.0], [2.0, 1.0]]]), 0.0, "more than one"),
        (control.tf([[[1.0], [2.0, 1.0]]], [[[1.0, 1.0], [1.0, 2.0, 3.0]]]), 0.0, "more than one"),
        (signal.StateSpace(-np.eye(2), np.eye(2), [[0.0, 1.0]], [[0.0, 0.0]]), 0.0, "more than one"),
        (signal.StateSpace(-np.eye(2), [[1.0], [1.0]], np.eye(2), np.zeros((2, 1))), 0.0, "more than one"),
        (PLANT, 2.0, "one too many"),
    ],
)
def test_what_is_no_model_is_refused(system: tuning.Model, dead_time_s: float, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        tuning.as_model(system, dead_time_s)


@pytest.mark.parametrize("thing", ["simc", 3.0, object(), None, [2.0, 10.0, 1.0]])
def test_what_is_nothing_of_the_kind_is_a_type_error(thing: object) -> None:
    with pytest.raises(TypeError, match=r"is no model: give FOPDT\(K, T, L\)"):
        tuning.tune(thing, "simc")


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (lambda: tuning.FOPDT("2", 10.0, 1.0), TypeError, "K must be a number, not '2'"),
        (lambda: tuning.FOPDT(float("nan"), 10.0, 1.0), ValueError, "K must be a finite number, not nan"),
        (lambda: tuning.SOPDT(K=2.0, T1=10.0, T2=0.0, L=1.0), ValueError, "T2 must be more than 0 s, not 0"),
        (lambda: tuning.Integrating(0.0, 1.0), ValueError, "K must not be 0"),
        (lambda: tuning.TransferFunction(["2"], [10.0, 1.0]), TypeError, "num must be coefficients from the highest"),
        (lambda: tuning.TransferFunction([2.0], [10.0, np.inf]), ValueError, "den must have finite coefficients"),
        (lambda: tuning.tune({"K": 2.0, "tau": 10.0, "L": 1.0}), TypeError, "has these quantities; give K, T, L"),
        (lambda: tuning.margins({"K": 2.0, "T": 10.0, "L": 1.0}, {"Kp": 1.0}), TypeError, r"give Gains\(Kp="),
        (lambda: tuning.compare(PLANT, "simc"), TypeError, r"as a list or a dictionary, \[\"simc\""),
        (lambda: tuning.compare(PLANT, {"mine": 3.0}), TypeError, r"give Gains\(Kp="),
        (lambda: tuning.compare(PLANT, ["simc", "magic"]), tuning.Refused, "not 'magic'"),
        (lambda: tuning.tune(PLANT, ["simc"]), tuning.Refused, r"not \['simc'\]"),
        (lambda: tuning.bode(PLANT, omega=["low"]), tuning.Refused, "omega must be frequencies in rad/s"),
        (lambda: tuning.identify([0, 1], ["a", "b"], [0, 1]), tuning.Refused, "u must be a series of numbers"),
        (lambda: tuning.observe([0.0, 1.0], [1.0], [1.0], [1.0], IN_EFFECT), tuning.Refused, "equally long"),
        (lambda: tuning.observe([0.0], [1.0], [1.0], [1.0], IN_EFFECT), tuning.Refused, "at least 100 are needed"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_named_with_what_to_give(make: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        make()


FORMS: list[dict[str, Any]] = [
    {"K": 2.0, "T_s": 10.0, "L_s": 3.0},
    {"K": 2.0, "T1_s": 10.0, "T2_s": 4.0, "L_s": 3.0},
    {"K": 2.0, "T_s": 6.0, "zeta": 0.5, "L_s": 3.0},
    {"K": 0.1, "L_s": 3.0, "integrating": True, "T_s": 5.0},
    {"num": [2.0], "den": [10.0, 1.0], "dead_time_s": 3.0},
    {"num": [2.0], "den": [10.0, 1.0], "L": 3.0},
]


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_model_has_the_names_that_it_has_as_json(form: dict[str, Any]) -> None:
    assert tuning.as_model(form) == parse_model(form)
    assert tuning.as_model({name.removesuffix("_s"): value for name, value in form.items()}) == parse_model(form)


def test_two_lags_show_themselves_as_they_are_made() -> None:
    model = tuning.SOPDT(K=2.0, T1=10.0, T2=4.0, L=3.0)
    assert repr(model) == "SOPDT(K=2, T1=10, T2=4, L=3)" and eval(f"tuning.{model!r}") == model
    assert repr(tuning.SOPDT(2.0, 6.0, 0.5, 3.0)) == "SOPDT(K=2, T=6, zeta=0.5, L=3)"


RATIONAL = [
    ([2.0], [10.0, 1.0]),
    ([-2.0, 1.0], [20.0, 9.0, 1.0]),
    ([-3.0], [4.0, 1.0, 0.0]),
    ([0.2, 1.0], [1.0, 0.02, 1.0]),
    ([1.0], [-5.0, 1.0]),
]


@pytest.mark.parametrize(("num", "den"), RATIONAL)
def test_bode_and_nyquist_are_those_of_python_control(num: list[float], den: list[float]) -> None:
    system = control.tf(num, den)
    magnitude, phase, omega = tuning.bode(system)
    theirs = control.frequency_response(system, omega, squeeze=True)
    np.testing.assert_allclose(magnitude, theirs.magnitude, rtol=1e-9)
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * np.asarray(theirs.phase)), atol=1e-9)
    turned = np.unwrap(np.asarray(theirs.phase)) - phase
    np.testing.assert_allclose(turned, turned[0], atol=1e-6)
    real, imag, _ = tuning.nyquist(system, omega=omega)
    np.testing.assert_allclose(real + 1j * imag, theirs.complex, rtol=1e-9)


def test_the_phase_of_a_dead_time_goes_on_and_on() -> None:
    omega = np.array([0.01, 1.0, 300.0])  # far apart: half of hundred turns between two of them
    found = tuning.bode(PLANT, omega=omega)
    np.testing.assert_allclose(found.phase, -np.arctan(10.0 * omega) - omega, rtol=1e-12)
    gains = tuning.Gains(Kp=2.0, Ti=10.0)  # cancels the lag: 0.4 exp(-s)/s
    loop = tuning.bode(PLANT, gains, omega)
    np.testing.assert_allclose(loop.magnitude, 0.4 / omega)
    np.testing.assert_allclose(loop.phase, -0.5 * np.pi - omega)
    curve = tuning.nyquist(PLANT, gains)
    nearest = np.min(np.hypot(1.0 + curve.real, curve.imag))
    assert tuning.margins(PLANT, gains).Ms == pytest.approx(1.0 / nearest, rel=1e-4)


def test_margins_have_the_names_and_values_of_python_control() -> None:
    plant, gains = control.tf([1.0], [1.0, 3.0, 3.0, 1.0]), tuning.Gains(Kp=1.2, Ti=2.0)
    gm, pm, sm, wpc, wgc, wms = control.stability_margins(plant * control.tf([1.2 * 2.0, 1.2], [2.0, 0.0]))
    found = tuning.margins(plant, gains)
    assert (found.GM, found.PM_deg, 1.0 / found.Ms) == pytest.approx((gm, pm, sm), rel=1e-5)
    assert (found.wpc, found.wgc, found.wms) == pytest.approx((wpc, wgc, wms), rel=1e-4)


@pytest.mark.parametrize(
    ("model", "gains"),
    [
        (PLANT, tuning.Gains(Kp=2.0, Ti=10.0)),
        # crosses 1 thrice: the smallest phase margin is at the lowest, the least dead time at the highest crossover
        (tuning.TransferFunction((0.1,), (1.0, 0.02, 1.0, 0.0)), tuning.Gains(Kp=0.18)),
        (tuning.TransferFunction((1.0, 0.4, 1.0), (1.0, 0.4, 4.0, 0.0)), tuning.Gains(Kp=3.0)),
    ],
    ids=["dead time", "a light resonance", "a zero and a pole pair"],
)
def test_the_delay_margin_is_where_the_loop_becomes_unstable(model: tuning.Model, gains: tuning.Gains) -> None:
    margin = tuning.margins(model, gains).delay_margin_s
    assert margin is not None
    for part, stable in ((0.0, True), (0.5, True), (0.999, True), (1.001, False)):
        later = tuning.TransferFunction(model.num, model.den, model.L + part * margin)
        assert is_stable(later, gains) is stable, part


def test_methods_and_named_gains_in_one_table() -> None:
    robust, present = tuning.tune(PLANT, "fast", Ms=1.3), tuning.Gains(Kp=1.0, Ti=5.0)
    given = {"present": present, "robust": robust, "wild": tuning.Gains(50.0, 1.0), "simc": "simc", "cc": "kappa-tau"}
    found = tuning.compare(tuning.FOPDT(K=2.0, T=10.0, L=0.5), given)
    assert [row.name for row in found.rows] == list(given)
    expected = tuning.assess(found.model, robust)
    row = found["robust"]
    assert expected.setpoint and expected.load and row.gains == robust.gains
    assert (row.Ms, row.IAE_setpoint, row.IAE_load) == (expected.margins.Ms, expected.setpoint.IAE, expected.load.IAE)
    assert found["simc"].gains == tuning.tune(found.model, "simc").gains
    assert found["wild"].note == "the loop would be unstable" and found["wild"].Ms is None
    assert found["cc"].gains is None and found["cc"].note.startswith("outside_range: L/T = 0.05")
    text, shown = repr(found), found._repr_html_()
    assert (
        f"{row.Ms:.3g}" in text
        and "cc: outside_range" in text
        and "<svg" in shown
        and f"<td>{row.Ms:.3g}</td>" in shown
    )
    with pytest.raises(KeyError, match="there are present, robust"):
        found["amigo"]


def test_a_record_of_normal_operation_gives_a_model_and_gains() -> None:
    moves = {periods(10 + 8 * k): 1.0 if k % 2 == 0 else -1.0 for k in range(4)}
    heard = operated(moves, periods(44))
    t = heard.t_s + heard.Ts * np.arange(len(heard.pv))
    found = tuning.observe(t, heard.sp, heard.pv, heard.mv, IN_EFFECT, Ms=1.3)
    assert found.reason is None, found.detail
    assert tuning.margins(OPERATED, found).Ms == pytest.approx(1.3, abs=0.05)
    assert tuning.tune(found, "simc").gains.Kp == pytest.approx(tuning.tune(OPERATED, "simc").gains.Kp, rel=0.1)
    assert str(found).startswith(f"{found.gains}; Ms 1.3") and "<td>proposed</td>" in found._repr_html_()
    still = tuning.observe(t[:500], heard.sp[:500], heard.pv[:500], heard.mv[:500], IN_EFFECT)
    assert still.gains is None and "no set-point change" in str(still)
    with pytest.raises(TypeError, match="this Observed has no model: no gains, uncertain"):
        tuning.tune(still)


def test_to_control_and_back() -> None:
    model = tuning.TransferFunction((1.0, 2.0), (20.0, 9.0, 1.0))
    assert tuning.TransferFunction.from_control(model.to_control()) == model
    assert tuning.TransferFunction.from_control(model.to_control(), 3.0).L == 3.0
    late = tuning.TransferFunction((2.0,), (10.0, 1.0), 1.0)
    with pytest.raises(ValueError, match="give pade_order for that of 1 s"):
        late.to_control()
    w = np.array([0.01, 0.3])
    assert np.allclose(late.to_control(pade_order=5)(1j * w), late.frequency_response(w), atol=1e-6)


def test_results_show_themselves_in_a_notebook() -> None:
    found = tuning.tune(PLANT, "imc-pid")
    shown = found._repr_html_()
    assert f"<td>{found.gains.Kp:.4g}</td>" in shown and "<svg" in shown and "filtered with Tf" in shown
    t = np.arange(0.0, 100.0, 0.5)
    u = np.where(t < 5.0, 0.0, 1.0)
    y = np.where(t < 6.0, 0.0, 2.0 * (1.0 - np.exp(-(t - 6.0) / 10.0)))
    record = tuning.identify(t, u, y)
    shown = record._repr_html_()
    assert "<th>standard error</th>" in shown and "The model explains the record." in shown and "<svg" in shown
    dots, line = record.plot().axes[0].lines
    assert np.array_equal(dots.get_ydata(), y) and np.allclose(line.get_ydata(), y, atol=1e-3)
    assert str(record).startswith("K 2 ± ")


def test_without_matplotlib_a_notebook_shows_the_table_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    shown = tuning.tune(PLANT, "simc")._repr_html_()
    assert "<table>" in shown and "<svg" not in shown


def test_an_unknown_method_is_refused_with_those_that_are() -> None:
    with pytest.raises(tuning.Refused, match=r"method must be one of .*simc"):
        tuning.tune(PLANT, "magic")


def test_it_draws_itself() -> None:
    found = tuning.tune(PLANT, "simc")
    pv, load = (axes.lines[0] for axes in found.plot().axes[:2])
    response = tuning.step_response(PLANT, found.gains)
    assert np.array_equal(pv.get_ydata(), response.y) and len(load.get_ydata())
    assert (found._repr_png_() or b"").startswith(b"\x89PNG")


def test_a_loop_that_is_not_stable_has_no_picture() -> None:
    too_much = tuning.Gains(Kp=100.0, Ti=1.0)
    found = replace(tuning.tune(PLANT), gains=too_much, assessment=tuning.assess(PLANT, too_much))
    assert not found.assessment.stable and "unstable" in str(found)
    with pytest.raises(tuning.Refused, match="no response to draw"):
        found.plot()
    assert found._repr_png_() is None
