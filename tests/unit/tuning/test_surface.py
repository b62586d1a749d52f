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
