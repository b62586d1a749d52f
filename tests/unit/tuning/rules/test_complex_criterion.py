"""The complex criterion against the paper's table, its recomputation and a stepwise simulation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, Reals, TransferFunction
from loopwright.tuning.reasons import Refused
from loopwright.tuning.rules.complex_criterion import DIVERGED, ComplexCriterion, Weighting
from tests.unit.tuning.search_tables import HORIZON_S, ME_PSO, PLANTS

RECOMPUTED: dict[str, dict[str, Any]] = ME_PSO["recomputed"]["table4_at_printed_settings"]
PRINTED: dict[str, dict[str, Any]] = ME_PSO["printed"]["table4"]


def settings(plant: str) -> tuple[Reals, Reals, list[dict[str, Any]]]:
    rows = list(RECOMPUTED[plant].values())
    return np.array([r["Kp"] for r in rows]), np.array([r["Ti"] for r in rows]), rows


@pytest.mark.parametrize("plant", PLANTS)
def test_indices_of_every_row(plant: str) -> None:
    Kp, Ti, rows = settings(plant)
    found = ComplexCriterion(PLANTS[plant], Weighting.ERROR, HORIZON_S[plant]).indices(Kp, Ti)
    assert len(rows) >= 10
    assert pytest.approx(np.array([r["MIE"] for r in rows]), abs=1e-3) == found.MIE
    assert pytest.approx(np.array([r["MIC"] for r in rows]), abs=3e-3 if plant == "G4" else 1e-3) == found.MIC
    assert 100.0 * found.overshoot == pytest.approx(np.array([r["overshoot_pct"] for r in rows]), abs=0.05)
    assert found.settling == pytest.approx(np.array([r["ts"] for r in rows]), abs=0.01)


@pytest.mark.parametrize("plant", ["G1", "G2", "G4", "G5"])
def test_indices_near_the_printed_ones(plant: str) -> None:
    # the paper's integration is coarse; G3 was simulated without its zero's jump, G5's own rows are a dead time short
    names = [n for n, row in PRINTED[plant].items() if row and not (plant == "G5" and n.startswith("ME-PSO"))]
    rows = np.array([PRINTED[plant][n] for n in names])
    found = ComplexCriterion(PLANTS[plant], Weighting.ERROR, HORIZON_S[plant]).indices(
        np.array([RECOMPUTED[plant][n]["Kp"] for n in names]), np.array([RECOMPUTED[plant][n]["Ti"] for n in names])
    )
    assert pytest.approx(rows[:, 2], abs=0.015) == found.MIE
    if plant == "G4":
        assert pytest.approx(rows[:, 3], rel=0.05) == found.MIC
    else:
        assert pytest.approx(rows[:, 3], abs=0.035) == found.MIC
    assert 100.0 * found.overshoot == pytest.approx(rows[:, 4], abs=2.2)
    assert found.settling == pytest.approx(rows[:, 5], abs=0.5)


@pytest.mark.parametrize("weighting", Weighting)
@pytest.mark.parametrize("plant", PLANTS)
def test_criterion_of_every_row(plant: str, weighting: Weighting) -> None:
    Kp, Ti, rows = settings(plant)
    found = ComplexCriterion(PLANTS[plant], weighting, HORIZON_S[plant])(Kp, Ti)
    expected = np.array([r["criterion"][weighting[0].upper()] for r in rows])
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("plant", PLANTS)
def test_sensitivity_is_the_margin_s(plant: str) -> None:
    Kp, Ti, rows = settings(plant)
    found = ComplexCriterion(PLANTS[plant], Weighting.ERROR).sensitivity(Kp, Ti)
    assert found == pytest.approx(np.array([r["Ms"] for r in rows]), rel=3e-3)


@pytest.mark.parametrize(
    ("model", "gains", "horizon"),
    [
        (SOPDT(2.0, 30.0, 0.8, 10.0), Gains(0.4, 40.0), 60.0),
        (SOPDT(-2.0, 30.0, 0.8, 0.02), Gains(1.5, 40.0), 60.0),  # the dead time is shorter than a sample
        (SOPDT(2.0, 30.0, 0.8, 0.0), Gains(1.5, 40.0), 60.0),
        (FOPDT(2.0, 30.0, 10.0), Gains(0.6, 20.0), 70.0),
        (TransferFunction((2.0, 1.0), (6.0, 7.0, 5.0, 1.0), 0.5), Gains(1.0, 3.0), 10.0),
        (Integrating(0.2, 2.0, 3.0), Gains(0.4, 40.0), 20.0),
        (Integrating(0.2, 0.0, 3.0), Gains(0.4, 40.0), 20.0),
        (TransferFunction((1.0, 4.0), (3.0, 1.0)), Gains(0.6, 4.0), 2.0),
    ],
    ids=["dead time", "short", "none", "first order", "zero", "integrating", "integrating, none", "bi-proper"],
)
def test_parts_by_a_stepwise_simulation(model: Model, gains: Gains, horizon: float) -> None:
    # an end in the middle of the answer, so that the terminal derivatives are there too
    criterion = ComplexCriterion(model, Weighting.ERROR, horizon)
    unit, gain = criterion.time_unit_s, criterion.gain_unit
    horizon = criterion.horizon * unit
    found = criterion.indices(*scaled(criterion, gains))
    fine = step_response(model, gains, horizon=horizon, dt=horizon / 20000)
    keep = fine.t <= horizon * (1.0 + 1e-9)
    t, e, u = fine.t[keep], np.abs(1.0 - fine.y[keep]), gain * np.abs(fine.u[keep])
    last = int(np.flatnonzero(e > 0.05)[-1])
    assert found.settling[0] * unit == pytest.approx(t[min(last + 1, len(t) - 1)], abs=2e-3 * horizon)
    assert found.MIE[0] == pytest.approx(np.trapezoid(e[: last + 2], t[: last + 2]) / t[last], rel=2e-3)
    assert found.MIC[0] == pytest.approx(np.trapezoid(u[: last + 2], t[: last + 2]) / t[last], rel=2e-3)
    assert found.overshoot[0] == pytest.approx(max(0.0, fine.y[keep].max() - 1.0), abs=1e-4)
    # derivatives at the end from a polynomial through the last stretch
    order, tail = len(model.den) - 1, t > t[-1] - 0.1 * unit
    series = np.polynomial.Polynomial.fit((t[tail] - t[-1]) / unit, fine.y[keep][tail], 5)
    slopes = sum(abs(series.deriv(i)(0.0)) for i in range(1, order + 1))
    assert found.terminal[0] == pytest.approx(max(0.0, e[-1] - 0.05) + slopes, rel=0.01, abs=1e-6)


def scaled(criterion: ComplexCriterion, gains: Gains) -> tuple[Reals, Reals]:
    kp = gains.Kp * criterion.gain_unit
    return np.array([kp]), np.array([gains.Ti / criterion.time_unit_s / kp])


@pytest.mark.parametrize("model", [FOPDT(1.0, 2.0, 1.0), TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0))])
def test_diverging_loops_are_finite_and_ordered(model: Model) -> None:
    criterion = ComplexCriterion(model, Weighting.ERROR)
    kp, ti = np.array([0.5, 20.0, 60.0, 200.0, 1e4]), np.full(5, 2.0)
    value = criterion(kp, ti)
    assert np.isfinite(value).all()
    assert value[0] < 1e4
    assert (value[1:] > DIVERGED).all()
    assert (np.diff(value) > 0.0).all()
    assert [criterion.stable(k, 2.0) for k in kp] == [True, False, False, False, False]


def test_the_bound_on_Ms_leaves_robust_loops_alone() -> None:
    model = PLANTS["G5"]
    free = ComplexCriterion(model, Weighting.ERROR)
    bound = ComplexCriterion(model, Weighting.ERROR, Ms_max=1.8)
    kp, ti = np.array([0.3, 1.36]), np.array([2.5, 4.6])
    assert [margins(model, Gains(k, k * t)).Ms < 1.8 for k, t in zip(kp, ti, strict=True)] == [True, False]
    before, after = free(kp, ti), bound(kp, ti)
    assert after[0] == before[0]
    assert after[1] > 10.0 * before[1]


@pytest.mark.parametrize(("gain", "time"), [(1.0, 60.0), (-0.02, 0.01)])
def test_scale_of_gain_and_time_plays_no_part(gain: float, time: float) -> None:
    plain = ComplexCriterion(FOPDT(1.0, 2.0, 1.0), Weighting.DURATION)
    other = ComplexCriterion(FOPDT(gain, 2.0 * time, time), Weighting.DURATION)
    kp, ti = np.array([0.5, 1.0]), np.array([2.0, 1.5])
    assert other(kp, ti) == pytest.approx(plain(kp, ti), rel=1e-9)
    assert other.time_unit_s == pytest.approx(2.0 * time)
    assert other.gain_unit == pytest.approx(abs(gain))


def test_a_dead_time_next_to_nothing_changes_next_to_nothing() -> None:
    kp, ti = np.array([0.8, 2.0]), np.array([2.0, 1.5])
    without = ComplexCriterion(SOPDT(1.0, 2.0, 0.7, 0.0), Weighting.ERROR, 40.0)(kp, ti)
    with_it = ComplexCriterion(SOPDT(1.0, 2.0, 0.7, 1e-6), Weighting.ERROR, 40.0)(kp, ti)
    assert with_it == pytest.approx(without, rel=1e-3)


def test_a_bare_integrator_is_refused() -> None:
    with pytest.raises(Refused, match="neither lag nor dead time"):
        ComplexCriterion(Integrating(1.0, 0.0), Weighting.ERROR)


def test_the_horizon_is_whole_dead_times() -> None:
    criterion = ComplexCriterion(FOPDT(1.0, 2.0, 1.5), Weighting.ERROR, 10.0)
    assert criterion.horizon * criterion.time_unit_s == pytest.approx(10.5)
    assert math.isclose(ComplexCriterion(FOPDT(1.0, 2.0, 0.0), Weighting.ERROR, 10.0).horizon, 5.0)
