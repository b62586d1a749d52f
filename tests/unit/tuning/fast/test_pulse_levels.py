"""The levels of the pulses: the models asked, the level on a known plant, PV limits, and a record without a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.tuning.fast.forecast import Past, forecast
from loopwright.tuning.fast.pulses.levels import PulseBounds, candidate_models, last_level, second_level, step_fits
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, TransferFunction
from tests.unit.tuning.fast.test_forecast import TS, simulated

PLANT = TransferFunction((1.0,), (10.0, 1.0), 2.0)
HOT, SLUGGISH = Gains(5.5, 8.0), Gains(0.8, 10.0)
NOISE = 0.01
SIZE = 1.0
FIRST_TURN, SECOND_TURN = 31, 76


def past(gains: Gains, samples: int, moves: list[tuple[int, float]], limit: float = 1e6) -> Past:
    """A record with noise on PV, of which MV knows nothing."""
    sp, pv, mv = simulated(PLANT, gains, moves, samples, limit)
    noisy = pv + NOISE * np.random.default_rng(1).standard_normal(len(pv))
    return Past(TS, sp, noisy, mv, -limit, limit, 1.0, gains)


def up(gains: Gains, limit: float = 1e6) -> Past:
    return past(gains, FIRST_TURN, [(5, SIZE)], limit)


def up_and_down(gains: Gains, limit: float = 1e6) -> Past:
    return past(gains, SECOND_TURN, [(5, SIZE), (FIRST_TURN, -SIZE)], limit)


def true_course(record: Past, level: float) -> float:
    """The largest deviation of PV that the level leads to, by the simulated plant."""
    moves = [(5, SIZE), (FIRST_TURN, -SIZE), (SECOND_TURN, level * SIZE)]
    _, pv, _ = simulated(PLANT, record.gains, moves, SECOND_TURN + 150, 1e6)
    return float(np.abs(pv[SECOND_TURN:]).max())


def test_the_candidates_hold_the_plant_and_have_the_sign_that_the_controller_takes() -> None:
    record = up_and_down(HOT)
    found = candidate_models(record.mv, record.pv, TS, 1.0)
    assert any(isinstance(each, FOPDT) and abs(each.K / each.T - 0.1) < 0.01 for each in found)
    assert candidate_models(record.mv, record.pv, TS, -1.0) == []


def test_the_last_level_is_the_largest_that_keeps_PV_within_bounds_on_the_true_plant() -> None:
    record = up_and_down(HOT)
    full = true_course(record, 1.0)
    bounds = PulseBounds(-0.8 * full, 0.8 * full, NOISE)
    level = last_level(record, 5, SIZE, bounds)
    assert 0.1 < level < 1.0
    assert true_course(record, level) <= 0.8 * full
    assert true_course(record, level + 0.2) > 0.75 * full, "it is not smaller than it has to be"


def test_sluggish_gains_get_full_pulses() -> None:
    bounds = PulseBounds(-1.5, 1.5, NOISE)
    record = past(SLUGGISH, 55, [(5, SIZE)])
    assert record.pv[-1] > 0.2, "so far it has followed when it turns"
    assert second_level(record, 5, SIZE, bounds) == pytest.approx(-1.0)
    assert last_level(up_and_down(SLUGGISH), 5, SIZE, bounds) == pytest.approx(1.0)


def test_a_PV_limit_on_one_side_bounds_the_pulse_on_that_side() -> None:
    record = past(Gains(3.0, 8.0), 36, [(5, SIZE)])
    wide, narrow = (second_level(record, 5, SIZE, PulseBounds(low, 3.0, NOISE)) for low in (-3.0, -0.6))
    assert abs(narrow) < abs(wide)


def test_MV_bounds_a_level_too() -> None:
    record, bounds = up_and_down(SLUGGISH), PulseBounds(-3.0, 3.0, NOISE)
    level = last_level(replace(record, high=0.4), 5, SIZE, bounds)
    assert 0.0 < level < last_level(record, 5, SIZE, bounds)
    _, _, mv = simulated(PLANT, SLUGGISH, [(5, SIZE), (FIRST_TURN, -SIZE), (SECOND_TURN, level * SIZE)], 200, 1e6)
    assert mv[SECOND_TURN:].max() <= 0.4


def test_a_record_too_short_for_a_model_gets_half_a_pulse() -> None:
    record = up(HOT)
    short = replace(record, sp=record.sp[:8], pv=record.pv[:8], mv=record.mv[:8])
    assert last_level(short, 5, SIZE, PulseBounds(-1.5, 1.5, NOISE)) == 0.5


def test_a_step_home_fits_where_the_true_plant_keeps_MV_within_its_limits() -> None:
    record, new = up_and_down(SLUGGISH), Gains(3.0, 8.0)
    asked = forecast(PLANT, record, new, np.array([0.0]), 100).mv
    largest = float(np.abs(asked).max()) + 2.0 * NOISE * new.Kp
    for limit, fits in ((1.05 * largest, True), (0.95 * largest, False)):
        limited = replace(record, low=-limit, high=limit)
        assert step_fits(limited, [PLANT], new, 0.0, NOISE, 100) is fits
