"""The check never fires for our own controller, names each other law with its size, and says when it cannot tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from loopwright.tuning.experiments.control_law import ControlLaw, LawDifference, alternatives
from loopwright.tuning.experiments.control_record import ControlPiece, ControlRecord
from loopwright.tuning.experiments.controller_check import ControllerCheck, check_controller
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals
from tests.unit.tuning.experiments.driven import TS, Drive, driven, random_drive, recorded

PI = Gains(2.0, 5.0)
PID = Gains(2.0, 4.0, 0.8, 0.08)
SIZES = {
    LawDifference.GAIN: 1.4,
    LawDifference.INTEGRAL_TIME: 0.5,
    LawDifference.PV_FILTER: 0.35,
    LawDifference.SETPOINT_WEIGHT: 0.0,
    LawDifference.DERIVATIVE_ON_ERROR: 1.0,
}


@pytest.mark.parametrize("part", range(6))
def test_it_never_fires_for_our_own_controller(part: int) -> None:
    """Limits of MV and of its rate, gains that take over, relays, lost samples, coarse and frozen PV, ramps."""
    compared = 0
    for seed in range(20 * part, 20 * part + 20):
        drive = random_drive(seed)
        check = check_controller(driven(drive))
        assert check.roundings < 1.0 and check.other is None, (drive, check)
        compared += check.samples
    assert compared > 5000


BY_SETPOINT = (LawDifference.SETPOINT_WEIGHT, LawDifference.DERIVATIVE_ON_ERROR)


@pytest.mark.parametrize(
    ("kind", "rest"),
    [(kind, rest) for kind in LawDifference for rest in (False, True) if not (rest and kind in BY_SETPOINT)],
)
def test_each_other_law_is_named_with_its_size(kind: LawDifference, rest: bool) -> None:
    found = next(each for each in alternatives(PID, TS) if each.kind is kind)
    law = found.law(PID, SIZES.get(kind, 0.0))
    assert law is not None
    check = check_controller(recorded(PID, law, rest))
    assert check.other is not None and not check.exact
    assert check.other.kind is kind
    assert check.other.left < 1e-6 < check.away
    if found.sizes:
        assert check.other.size == pytest.approx(SIZES[kind], abs=1e-5)
        assert check.other.deviation is not None and check.other.deviation < 1e-4
    else:
        assert (check.other.size, check.other.deviation) == (None, None)


def test_the_standard_deviation_of_a_size_covers_what_coarse_values_do() -> None:
    law = ControlLaw(replace(PI, Kp=1.4 * PI.Kp))
    errors = []
    for steps in (0.05, 0.1, 0.2, 0.3):
        other = check_controller(recorded(PI, law, noise=0.03, mv_step=steps)).other
        assert other is not None and other.kind is LawDifference.GAIN and other.size is not None and other.deviation
        errors.append((other.size - 1.4) / other.deviation)
    assert max(map(abs, errors)) < 4.0 and max(map(abs, errors)) > 0.1


def test_coarse_values_of_the_law_as_said_are_no_other_law() -> None:
    for steps in (0.02, 0.1, 0.3):
        check = check_controller(recorded(PI, ControlLaw(PI), noise=0.03, mv_step=steps))
        assert not check.exact and check.other is None
        assert check.usually_away <= 1.2 * check.rounded


def test_an_mv_recorded_a_sample_late_is_the_law_as_said() -> None:
    [piece] = recorded(PI, ControlLaw(PI)).pieces
    late = ControlPiece(PI, piece.sp[1:], piece.pv[1:], piece.mv[:-1])
    check = check_controller(ControlRecord(TS, True, (late,)))
    assert check.away < 1e-9 and check.other is None


def test_a_law_that_is_none_of_them_is_not_given_a_name() -> None:
    [piece] = recorded(PI, ControlLaw(PI)).pieces
    odd = ControlPiece(PI, piece.sp, piece.pv, piece.mv + np.sin(0.9 * np.arange(len(piece.mv))))
    check = check_controller(ControlRecord(TS, True, (odd,)))
    assert check.other is None and check.usually_away > 0.3


def unknown(check: ControllerCheck) -> Reals:
    return np.array([check.gain_error, check.integral_error, check.filter_error_s])


def test_it_says_that_it_cannot_tell() -> None:
    assert np.all(unknown(check_controller(ControlRecord(TS, True, ()))) == math.inf)
    still = check_controller(driven(Drive(PI, noise=0.0, step=0.0)))
    assert still.samples == 0 and still.exact
    assert np.all(unknown(check_controller(driven(Drive(PI)))) < 1e-3)


def test_coarse_pv_at_rest_tells_less_than_a_set_point_that_moves() -> None:
    """An MV in steps, as a foreign device sends it, hides what little the noise of PV moves."""
    rest, moved = (
        check_controller(recorded(PI, ControlLaw(PI), rest, noise=0.01, mv_step=0.1)) for rest in (True, False)
    )
    assert rest.gain_error > 3.0 * moved.gain_error
    assert rest.integral_error > 3.0 * moved.integral_error


def test_several_pieces_under_several_gains_tell_of_one_law() -> None:
    """Under Kp 1 alone the parallel form is that of ISA; the next gains tell."""
    one, two = Gains(1.0, 5.0), Gains(2.0, 5.0)
    parallel = next(each for each in alternatives(one, TS) if each.kind is LawDifference.PARALLEL)
    pieces = []
    for gains in (one, two):
        law = parallel.law(gains, 1.0)
        assert law is not None
        pieces += recorded(gains, law).pieces
    assert check_controller(ControlRecord(TS, True, (pieces[0],))).exact
    other = check_controller(ControlRecord(TS, True, tuple(pieces))).other
    assert other is not None and other.kind is LawDifference.PARALLEL


def test_at_rest_a_weight_of_the_set_point_does_not_show() -> None:
    for kind in BY_SETPOINT:
        law = next(each for each in alternatives(PID, TS) if each.kind is kind).law(PID, SIZES[kind])
        assert law is not None
        assert check_controller(recorded(PID, law, rest=True)).exact
