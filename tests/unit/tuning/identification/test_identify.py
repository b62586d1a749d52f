"""Models from records of the devices' own simulator and controller: what is found, and how well it is known."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from loopwright.tuning.identification.identify import Identified, identify
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning import recordings
from tests.unit.tuning.recordings import (
    COMPLEX_POLES,
    EQUAL_LAGS,
    FIRST_MOVE,
    FIRST_ORDER,
    FIVE_LAGS,
    INTEGRATES,
    INTEGRATES_WITH_LAG,
    INVERSE_RESPONSE,
    NEGATIVE,
    PROMPT,
    TWO_LAGS,
    Loop,
    closed_loop,
    moves,
    open_loop,
    step,
)

CASES = {
    "first order": (FIRST_ORDER, FOPDT(2.0, 10.0, 2.03)),
    "negative gain": (NEGATIVE, FOPDT(-1.5, 8.0, 2.0)),
    "no dead time": (PROMPT, FOPDT(1.0, 5.0, 0.0)),
    "two lags": (TWO_LAGS, SOPDT(K=2.0, T1=10.0, T2=5.0, L=1.04)),
    "equal lags": (EQUAL_LAGS, SOPDT(2.0, 5.0, 1.0, 1.0)),
    "complex poles": (COMPLEX_POLES, SOPDT(1.0, 3.0, 0.3, 1.77)),
    "integrates": (INTEGRATES, Integrating(0.1, 1.0)),
    "integrates with lag": (INTEGRATES_WITH_LAG, Integrating(0.1, 1.23, 3.0)),
}
RECORDS = ["step", "moves", "set-point", "relay"]


def recorded(loop: Loop, how: str, samples: int = 600, **more: Any) -> tuple[recordings.Reals, ...]:
    if how in ("step", "moves"):
        return open_loop(loop, step(samples) if how == "step" else moves(samples), **more)
    return closed_loop(loop, relay=how == "relay", samples=samples, **more)


def deviations(found: Identified, true: FOPDT | SOPDT | Integrating) -> dict[str, float]:
    """In standard errors."""
    return {
        name: (getattr(found.model, name) - getattr(true, name)) / error
        for name, error in found.standard_errors.items()
    }


@pytest.mark.parametrize("how", RECORDS)
@pytest.mark.parametrize("case", CASES)
def test_without_noise_the_plant_itself_is_found(case: str, how: str) -> None:
    loop, true = CASES[case]
    found = identify(*recorded(loop, how))
    assert type(found.model) is type(true)
    for name in found.standard_errors:
        assert getattr(found.model, name) == pytest.approx(getattr(true, name), rel=1e-6, abs=1e-6), name
    assert found.fit_pct > 99.999 and found.explained
    assert found.candidates[0].at_rest
    assert not any("poorly" in note or "white" in note for note in found.notes)


@pytest.mark.parametrize("how", RECORDS)
@pytest.mark.parametrize("case", CASES)
def test_with_one_percent_noise_the_plant_is_within_its_standard_errors(case: str, how: str) -> None:
    loop, true = CASES[case]
    span = float(np.ptp(recorded(loop, how)[2]))
    found = identify(*recorded(loop, how, noise=0.01 * span))
    assert type(found.model) is type(true)
    assert set(found.standard_errors) == {"K", "T", "zeta", "L"} & {*true.__slots__} - (
        {"T"} if true.T == 0.0 else set()
    )
    for name, value in deviations(found, true).items():
        assert abs(value) < 4.0, (name, found.model)
    assert found.explained
    assert found.noise_std == pytest.approx(0.01 * span, rel=0.12)
    assert 100.0 - found.r2_pct == pytest.approx(100.0 * (1.0 - found.fit_pct / 100.0) ** 2)


@pytest.mark.parametrize("how", ["step", "set-point"])
def test_standard_errors_are_the_scatter_over_many_records(how: str) -> None:
    true = FOPDT(2.0, 10.0, 2.03)
    scatter, orders = [], Counter[type]()
    for seed in range(30):
        found = identify(*recorded(FIRST_ORDER, how, noise=0.02, seed=seed, samples=300))
        orders[type(found.model)] += 1
        if isinstance(found.model, FOPDT):
            scatter.append(list(deviations(found, true).values()))
    # one parameter too many is rarely worth ln(N) to the noise
    assert orders[FOPDT] >= 26
    assert np.std(scatter, axis=0) == pytest.approx(1.0, abs=0.35)
    assert np.abs(np.mean(scatter, axis=0)).max() < 0.75


def test_coloured_noise_is_told_and_widens_the_standard_errors() -> None:
    scatter = []
    for seed in range(12):
        t, u, y = open_loop(FIRST_ORDER, step(300))
        white = np.random.default_rng(seed).normal(scale=0.012, size=len(y) + 50)
        found = identify(t, u, y + lfilter([1.0], [1.0, -0.8], white)[50:])
        assert not found.explained and any("not white" in note for note in found.notes)
        scatter.append((found.model.K - 2.0) / found.standard_errors["K"])
    assert np.std(scatter) == pytest.approx(1.0, abs=0.6)


@pytest.mark.parametrize("resolution", [0.005, 0.02, 0.05])
def test_rounded_pv(resolution: float) -> None:
    t, u, y = open_loop(FIRST_ORDER, step())
    found = identify(t, u, np.round(y / resolution) * resolution)
    assert isinstance(found.model, FOPDT) and found.explained
    assert pytest.approx(2.0, rel=0.01) == found.model.K
    assert pytest.approx(10.0, rel=0.01) == found.model.T
    assert pytest.approx(2.03, abs=0.05) == found.model.L
    assert any("steps" in note for note in found.notes) == (resolution > 0.04)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("case", ["first order", "complex poles", "integrates"])
def test_a_record_cut_out_of_a_longer_one_does_not_start_at_rest(case: str, noise: float) -> None:
    loop, true = CASES[case]
    t, u, y = open_loop(loop, moves(), noise=noise)
    found = identify(t[100:], u[100:], y[100:])
    assert any("not at rest" in note for note in found.notes)
    assert type(found.model) is type(true)
    for name, error in found.standard_errors.items():
        assert getattr(found.model, name) == pytest.approx(getattr(true, name), abs=4.0 * error + 1e-6), name


def test_a_record_that_begins_with_the_move() -> None:
    t, u, y = open_loop(FIRST_ORDER, step())
    late = slice(FIRST_MOVE, None)
    found = identify(t[late], u[late], y[late], u_before=recordings.MV)
    assert isinstance(found.model, FOPDT)
    assert pytest.approx((2.0, 10.0, 2.03), rel=1e-6) == (found.model.K, found.model.T, found.model.L)
    with pytest.raises(Refused, match="u_before"):
        identify(t[late], u[late], y[late])


@pytest.mark.parametrize("how", ["step", "moves", "set-point"])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_with_lags_only_an_inverse_response_is_said_to_be_outside(how: str, noise: float) -> None:
    found = identify(*recorded(INVERSE_RESPONSE, how, noise=noise), lags_only=True)
    assert isinstance(found.model, SOPDT)
    assert not found.explained and found.whiteness < 1e-3
    assert any("not white" in note for note in found.notes)
    assert any("inverse response" in note for note in found.notes)


@pytest.mark.parametrize("how", RECORDS)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_an_inverse_response_is_found(how: str, noise: float) -> None:
    found = identify(*recorded(INVERSE_RESPONSE, how, noise=noise))
    assert isinstance(found.model, TransferFunction) and found.explained and not found.loads
    if len(found.parameters) == 5:
        for (name, value), true in zip(found.parameters.items(), (-2.0, 1.0, 20.0, 9.0, 1.0), strict=True):
            assert value == pytest.approx(true, abs=4.0 * found.standard_errors[name] + 1e-4), name
    else:
        assert any("nearly as well" in note and "sopdt with zero" in note for note in found.notes)


@pytest.mark.parametrize("how", ["set-point", "relay"])
@pytest.mark.parametrize("loop", [FIRST_ORDER, TWO_LAGS, INVERSE_RESPONSE, INTEGRATES_WITH_LAG])
def test_a_load_in_closed_loop_is_found(loop: Loop, how: str) -> None:
    found = identify(*recorded(loop, how, noise=0.01, load=0.3, load_at=350))
    assert found.explained
    (load,) = found.loads
    assert load.t_s == pytest.approx(35.0, rel=0.1) and load.size == pytest.approx(0.3, rel=0.1)
    # the gain at the frequencies that a loop decides by
    w = np.geomspace(0.2, 0.5, 9)
    true = TransferFunction(loop.num, loop.den, loop.L)
    assert found.model.frequency_response(w) == pytest.approx(true.frequency_response(w), rel=0.1)


def test_with_lags_only_more_of_them_than_two_leave_a_residual_that_is_not_white() -> None:
    found = identify(*recorded(FIVE_LAGS, "step", noise=0.002), lags_only=True)
    assert isinstance(found.model, SOPDT) and not found.explained
    assert any("not white" in note for note in found.notes)
    assert found.fit_pct > 98.0


def test_a_slow_plant_is_known_by_its_slope_only() -> None:
    slow = Loop((20.0,), (1000.0, 1.0), 2.0, 1.0, 10.0)
    found = identify(*open_loop(slow, step(300), noise=0.005))
    if isinstance(found.model, FOPDT):
        slope = found.model.K / found.model.T
        assert any("K/T" in note for note in found.notes)
    else:
        assert isinstance(found.model, Integrating)
        slope = found.model.K
    assert slope == pytest.approx(0.02, rel=0.03)
    assert pytest.approx(2.0, abs=0.3) == found.model.L


@pytest.mark.parametrize(("time_unit", "mv_unit", "pv_unit"), [(60.0, 1.0, 1.0), (1.0, -4.0, 1.0), (1e-3, 0.02, -1e3)])
def test_units_only_scale_the_answer(time_unit: float, mv_unit: float, pv_unit: float) -> None:
    t, u, y = open_loop(COMPLEX_POLES, moves(300), noise=0.01)
    plain = identify(t, u, y)
    found = identify(time_unit * t + 1e3, mv_unit * u + 7.0, pv_unit * y - 3.0)
    assert isinstance(plain.model, SOPDT) and isinstance(found.model, SOPDT)
    gain = pv_unit / mv_unit
    scales = {"K": gain, "T": time_unit, "L": time_unit, "zeta": 1.0}
    for name, scale in scales.items():
        assert getattr(found.model, name) == pytest.approx(scale * getattr(plain.model, name), rel=1e-5)
        assert found.standard_errors[name] == pytest.approx(abs(scale) * plain.standard_errors[name], rel=1e-3)
    assert found.fit_pct == pytest.approx(plain.fit_pct)


def test_what_is_modelled_and_what_was_tried_is_shown() -> None:
    t, u, y = open_loop(FIRST_ORDER, step(), noise=0.01)
    found = identify(t, u, y)
    clean = open_loop(FIRST_ORDER, step())[2]
    assert found.fitted == pytest.approx(clean, abs=0.02)
    assert found.fit_pct == pytest.approx(
        100.0 * (1.0 - float(np.linalg.norm(y - found.fitted) / np.linalg.norm(y - y.mean())))
    )
    assert {each.structure for each in found.candidates} == {"fopdt", "sopdt", "integrating", "integrating with lag"}
    assert [each.bic for each in found.candidates] == sorted(each.bic for each in found.candidates)
    assert [each.structure for each in found.candidates if each.chosen] == ["fopdt"]
    assert all(math.isfinite(each.bic) and math.isfinite(each.rms) for each in found.candidates)


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_is_not_taken_for_a_response(seed: int) -> None:
    y = 20.0 + np.random.default_rng(seed).normal(size=300)
    with pytest.raises(Refused) as caught:
        identify(np.arange(300) * 0.1, moves(300) if seed % 2 else step(300), y)
    assert caught.value.reason is Reason.NO_RESPONSE
    assert "visible" in caught.value.detail


@pytest.mark.parametrize("seed", range(5))
def test_a_response_four_times_the_noise_is_known_as_well_as_is_said(seed: int) -> None:
    found = identify(*open_loop(FIRST_ORDER, step(), noise=0.5, seed=seed))
    assert isinstance(found.model, FOPDT)
    assert abs(found.model.K - 2.0) < 4.0 * found.standard_errors["K"] < 0.4
    assert any("noise is 2" in note for note in found.notes)


@pytest.mark.parametrize("seed", range(5))
def test_a_response_below_the_noise_is_refused(seed: int) -> None:
    with pytest.raises(Refused) as caught:
        identify(*open_loop(FIRST_ORDER, step(), noise=2.0, seed=seed))
    assert caught.value.reason in (Reason.NOISE_TOO_HIGH, Reason.NO_RESPONSE)


def test_a_frozen_pv() -> None:
    with pytest.raises(Refused, match="PV is constant at 5") as caught:
        identify(np.arange(100.0), step(100), np.full(100, 5.0))
    assert caught.value.reason is Reason.NO_RESPONSE


T, U, Y = open_loop(FIRST_ORDER, step(200))


def changed(values: recordings.Reals, at: int, value: float) -> recordings.Reals:
    answer = values.copy()
    answer[at] = value
    return answer


@pytest.mark.parametrize(
    ("t", "u", "y", "words"),
    [
        (T, U, Y[:-1], "equally long"),
        (T[:19], U[:19], Y[:19], "too few samples: 19; at least 20"),
        (T, U, changed(Y, 7, math.nan), "y must be finite everywhere; sample 7 is nan"),
        (T, changed(U, 8, math.inf), Y, "u must be finite everywhere; sample 8"),
        (changed(T, 9, T[8]), U, Y, "t must increase; sample 9"),
        (T[::-1], U, Y, "t must increase; sample 1"),
        (np.where(T > 5.0, T + 0.2, T), U, Y, "gap in t: 0.3 s before sample 51 where 0.1 s is usual"),
        (changed(T, 30, T[30] + 0.03), U, Y, "evenly spaced"),
        (T, np.full(200, 3.0), Y, "input is constant at 3"),
        (T, changed(np.full(200, 3.0), 195, 4.0), Y, "only 4 samples follow the first move"),
        (T, ["a"] * 200, Y, "u must be a series of numbers"),
        (T, np.ones((200, 2)), Y, "u must be one series"),
    ],
)
def test_bad_records_are_refused_with_the_place(t: Any, u: Any, y: Any, words: str) -> None:
    with pytest.raises(Refused) as caught:
        identify(t, u, y)
    assert caught.value.reason is Reason.BAD_INPUT
    assert words in caught.value.detail


def test_a_bad_value_before_the_record() -> None:
    with pytest.raises(Refused, match="u_before"):
        identify(T, U, Y, u_before=math.nan)


def test_time_stamps_may_jitter_a_little() -> None:
    jitter = np.random.default_rng(1).uniform(-0.005, 0.005, len(T))
    found = identify(T + jitter, U, Y)
    assert isinstance(found.model, FOPDT)
    assert pytest.approx(10.0, rel=1e-3) == found.model.T


def test_six_hundred_samples_take_well_under_a_second() -> None:
    record = open_loop(TWO_LAGS, moves(), noise=0.01)
    identify(*record)
    start = time.process_time()
    identify(*record)
    assert time.process_time() - start < 1.0
