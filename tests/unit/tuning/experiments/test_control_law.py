"""The laws in closed form, and beside the controller's own algorithm."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.controller.pid import Parameters, Pid
from loopwright.tuning.experiments.control_law import ControlLaw, LawDifference, alternatives
from loopwright.tuning.gains import Gains

TS = 0.1
STEP, FLAT = np.ones(50), np.zeros(50)
PI = Gains(2.0, 5.0)
PID = Gains(2.0, 5.0, 0.5, 0.05, 0.7, 0.2)


def law(kind: LawDifference, gains: Gains, size: float = 1.0) -> ControlLaw:
    found = next(each for each in alternatives(gains, TS) if each.kind is kind).law(gains, size)
    assert found is not None
    return found


def test_a_pi_answers_a_step_of_the_set_point_with_a_jump_and_a_ramp() -> None:
    u = ControlLaw(PI).output(STEP, FLAT, TS, reverse=True)
    assert u == pytest.approx(2.0 + 2.0 * TS / 5.0 * np.arange(50))


def test_a_direct_action_changes_all_signs() -> None:
    sp, pv = np.random.default_rng(1).normal(size=(2, 50))
    assert ControlLaw(PID).output(sp, pv, TS, False) == pytest.approx(-ControlLaw(PID).output(sp, pv, TS, True))


def test_without_an_integral_time_there_is_no_integral() -> None:
    assert ControlLaw(Gains(2.0)).output(STEP, FLAT, TS, True) == pytest.approx(2.0 * STEP)


def test_a_filter_answers_as_a_lag_does() -> None:
    pv = np.append(0.0, np.ones(49))
    u = ControlLaw(Gains(1.0), 0.4).output(np.zeros(50), pv, TS, True)
    assert -u == pytest.approx(1.0 - 0.8 ** np.arange(50))
    assert ControlLaw(Gains(1.0), 0.4).poles(TS) == pytest.approx([0.8])


@pytest.mark.parametrize("reverse", [True, False])
@pytest.mark.parametrize("gains", [PI, PID, Gains(3.0), Gains(1.0, 4.0, 1.0)])
def test_it_is_the_law_of_the_controller(gains: Gains, reverse: bool) -> None:
    sp, pv = np.random.default_rng(2).normal(size=(2, 80))
    pid = Pid(TS, Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c), reverse)
    pid.rebase(sp[0], pv[0], 0.0)
    mv = np.array([pid.step(s, y, -1e9, 1e9) for s, y in zip(sp, pv, strict=True)])
    u = ControlLaw(gains).output(sp, pv, TS, reverse)
    assert mv - mv[0] == pytest.approx(u - u[0], abs=1e-9)


def test_the_parallel_form_does_not_multiply_by_the_gain() -> None:
    gains = law(LawDifference.PARALLEL, PID).gains
    assert (gains.Kp / gains.Ti, gains.Kp * gains.Td) == pytest.approx((1.0 / 5.0, 0.5))
    assert (gains.b, gains.c) == (0.7, 0.2)


def test_the_series_form_multiplies_two_first_orders() -> None:
    found = law(LawDifference.SERIES, PID).gains
    s = 1j * np.geomspace(0.01, 100.0, 20)
    isa = found.Kp * (1.0 + 1.0 / (found.Ti * s) + found.Td * s / (1.0 + found.Tf * s))
    assert isa == pytest.approx(2.0 * (1.0 + 1.0 / (5.0 * s)) * (1.0 + 0.5 * s) / (1.0 + 0.05 * s))


def test_a_pi_has_none_of_the_laws_of_a_derivative() -> None:
    none = [each.kind for each in alternatives(PI, TS) if each.law(PI, 1.0) is None]
    assert none == [LawDifference.SERIES, LawDifference.NO_DERIVATIVE_FILTER, LawDifference.DERIVATIVE_ON_ERROR]


@pytest.mark.parametrize("gains", [PI, PID])
def test_each_law_with_a_size_is_the_said_one_at_its_neutral_size(gains: Gains) -> None:
    for each in alternatives(gains, TS):
        if each.sizes and (found := each.law(gains, each.neutral)) is not None:
            assert found == ControlLaw(gains), each.kind
