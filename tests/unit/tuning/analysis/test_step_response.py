"""Step figures against the paper's tables, closed forms and, without dead time, python-control."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.analysis.step_response import step_figures, step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, TransferFunction
from tests.unit.tuning.tables import EQUIPOLE5, MODELS, TABLES, table4_model, transfer_function, ziegler_nichols


@pytest.mark.parametrize("row", TABLES["table2"]["rows"], ids=lambda r: r["model"])
def test_table_2(row: dict[str, Any]) -> None:
    p, recomputed = row["printed"], row["recomputed"]
    found = step_figures(EQUIPOLE5, Gains(Kp=p["kp"], Ti=p["kp"] / p["ki"]))
    assert found.settling_s == pytest.approx(p["ST"], rel=0.02)
    assert found.overshoot_pct == pytest.approx(row.get("settled", p)["OV"], abs=0.5)
    assert found.rise_s == pytest.approx(recomputed["RT"], rel=0.02)


@pytest.mark.parametrize("row", TABLES["table4"]["rows"], ids=lambda r: f"{r['model']} {r['method']}")
def test_table_4(row: dict[str, Any]) -> None:
    gains = row["recomputed"]
    found = step_figures(table4_model(row["model"]), Gains(Kp=gains["Kp"], Ti=gains["Ti"]))
    assert found.overshoot_pct == pytest.approx(row["printed"]["OV"], abs=0.5)
    # two printed settling times hang on the record's length and on a peak that touches the band: the settled values
    assert found.settling_s == pytest.approx(gains["ST"], rel=0.02)


@pytest.mark.parametrize("entry", MODELS, ids=lambda m: str(m["id"]))
def test_finer_steps_change_nothing(entry: dict[str, Any]) -> None:
    model = transfer_function(entry)
    gains = ziegler_nichols(*ultimate_point(model))
    coarse, fine = step_figures(model, gains), step_figures(model, gains, dt=model.L / 300.0)
    assert coarse.overshoot_pct == pytest.approx(fine.overshoot_pct, abs=0.05)
    assert pytest.approx(fine.IAE, rel=0.001) == coarse.IAE
    assert coarse.settling_s == pytest.approx(fine.settling_s, rel=0.005)


def test_integral_of_a_load_step_is_Ti_over_Kp() -> None:
    # integral of e = (1/Kp)*Ti for a unit load; the error does not change sign here, so IAE is the same
    gains = Gains(Kp=0.3, Ti=5.5)
    assert pytest.approx(gains.Ti / gains.Kp, rel=0.001) == step_figures(FOPDT(2.0, 5.0, 2.0), gains, load=True).IAE


def test_the_first_dead_times_in_closed_form() -> None:
    # P control of a pure lag with dead time: nothing, then K*Kp*(1 - exp(-(t-L)/T)) until the answer comes back
    model, gains = FOPDT(2.0, 5.0, 2.0), Gains(Kp=0.8)
    response = step_response(model, gains, horizon=4.0)
    expected = np.where(response.t < 2.0, 0.0, 1.6 * (1.0 - np.exp(-(response.t - 2.0) / 5.0)))
    assert response.y == pytest.approx(expected, abs=1e-9)
    assert response.u == pytest.approx(0.8 * (1.0 - expected), abs=1e-9)


def test_p_control_is_measured_against_its_own_final_value() -> None:
    found = step_figures(FOPDT(2.0, 5.0, 1.0), Gains(Kp=1.0))
    assert found.overshoot_pct < 10.0
    assert found.settling_s is not None


def test_negative_gain_gives_the_same_figures() -> None:
    gains = Gains(Kp=0.9, Ti=7.5)
    assert step_figures(FOPDT(-2.0, 5.0, 2.5), gains) == step_figures(FOPDT(2.0, 5.0, 2.5), gains)


@pytest.mark.parametrize("gains", [Gains(0.6, 4.0), Gains(0.6, 4.0, 0.8, 0.1), Gains(0.6, 4.0, 0.8, 0.1, 0.7, 0.3)])
@pytest.mark.parametrize(
    "model",
    [
        EQUIPOLE5,
        TransferFunction((1.0, 4.0), (3.0, 1.0)),
        TransferFunction((1.0, 9.0, 18.0, 11.0, 2.0), (3.0, 18.0, 34.0, 27.0, 9.0, 1.0)),
        TransferFunction((2.0,), tuple(np.poly([-1.0, -2.0, -0.3, -4.0, -10.0, -0.1]))),
    ],
    ids=["equal lags", "bi-proper", "fifth order", "six lags apart"],
)
def test_against_python_control_without_dead_time(model: TransferFunction, gains: Gains) -> None:
    s = control.tf("s")
    integral = 1.0 / (gains.Ti * s)
    derivative = gains.Td * s / (gains.Tf * s + 1.0)
    plant = control.ss(control.tf(list(model.num), list(model.den)))
    inner = control.feedback(plant, control.ss(gains.Kp * (1.0 + integral + derivative)))
    assert np.all(inner.poles().real < 0.0)
    closed = inner * control.ss(gains.Kp * (gains.b + integral + gains.c * derivative))
    ours = step_response(model, gains, horizon=40.0, dt=0.005)
    theirs = control.step_response(closed, ours.t)
    assert ours.y == pytest.approx(theirs.outputs, abs=1e-3)


def test_derivative_with_dead_time_against_a_high_pade() -> None:
    model, gains = FOPDT(2.0, 5.0, 1.0), Gains(1.2, 5.0, 0.3, 0.05)
    s = control.tf("s")
    num, den = control.pade(1.0, 8)
    plant = control.tf([2.0], [5.0, 1.0]) * control.tf(num, den)
    pi = gains.Kp * (1.0 + 1.0 / (gains.Ti * s))
    feedback = control.ss(pi + gains.Kp * gains.Td * s / (gains.Tf * s + 1.0))
    closed = control.ss(plant) * control.ss(pi) * control.feedback(1.0, control.ss(plant) * feedback)
    ours = step_response(model, gains, horizon=20.0, dt=0.005)
    theirs = control.step_response(closed, ours.t).outputs
    # an approximant rings before the answer comes; after two dead times it has calmed down
    late = ours.t > 2.0
    assert ours.y[late] == pytest.approx(theirs[late], abs=2e-3)
