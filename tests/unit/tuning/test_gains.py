"""PID forms: the same frequency response, written out here for each form, and there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.tuning.gains import (
    Gains,
    Parallel,
    Series,
    of_parallel,
    of_series,
    to_parallel,
    to_reciprocal,
    to_series,
)
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.isa import response

S = 1j * np.geomspace(1e-4, 1e4, 200)

sizes = st.floats(1e-3, 1e3)
perhaps = st.one_of(st.just(0.0), sizes)
isa = st.builds(Gains, Kp=sizes, Ti=perhaps, Td=perhaps, Tf=perhaps)


def same(gains: Gains, expected: np.ndarray) -> None:
    np.testing.assert_allclose(response(gains, S), expected, rtol=1e-9)


@given(isa)
def test_parallel(gains: Gains) -> None:
    p = to_parallel(gains)
    same(gains, p.Kp + p.Ki / S + p.Kd * S / (1.0 + p.Tf * S))
    back = of_parallel(p)
    assert [back.Kp, back.Ti, back.Td, back.Tf] == pytest.approx([gains.Kp, gains.Ti, gains.Td, gains.Tf], rel=1e-12)


@given(isa)
def test_series(gains: Gains) -> None:
    zeros = np.roots([gains.Ti * (gains.Td + gains.Tf), gains.Ti + gains.Tf, 1.0])
    try:
        s = to_series(gains)
    except Refused as refused:
        assert refused.reason is Reason.OUTSIDE_RANGE
        assert gains.Td > 0.0 and np.all(zeros.imag != 0.0)
        return
    integral = 1.0 + (1.0 / (s.Ti * S) if s.Ti > 0.0 else 0.0)
    same(gains, s.Kp * integral * (1.0 + s.Td * S) / (1.0 + s.Tf * S))
    if gains.Ti > 0.0:
        assert s.Ti >= s.Td
    back = of_series(s)
    assert back.Kp == pytest.approx(gains.Kp, rel=1e-9)
    assert back.Ti == pytest.approx(gains.Ti, rel=1e-9)
    np.testing.assert_allclose(response(back, S), response(gains, S), rtol=1e-8)


def test_the_series_form_ends_at_a_quarter() -> None:
    """Without a filter: real zeros up to Td = Ti/4."""
    s = to_series(Gains(Kp=3.0, Ti=8.0, Td=2.0))
    assert [s.Kp, s.Ti, s.Td] == pytest.approx([1.5, 4.0, 4.0], rel=1e-9)
    with pytest.raises(Refused, match=r"no series form.*Ti >= 4 Td") as caught:
        to_series(Gains(Kp=3.0, Ti=8.0, Td=2.001))
    assert caught.value.reason is Reason.OUTSIDE_RANGE


def test_series_by_hand() -> None:
    """(1 + 1/(6s))(1 + 2s) = 8/6 (1 + 1/(8s) + 1.5 s)."""
    g = of_series(Series(Kp=3.0, Ti=6.0, Td=2.0))
    assert [g.Kp, g.Ti, g.Td] == pytest.approx([4.0, 8.0, 1.5])


@pytest.mark.parametrize(
    "form",
    [
        Series(1.0, 10.0, 0.0, 1.0),
        Series(1.0, 10.0, 1.0, 2.0),
        Series(1.0, 0.0, 1.0, 2.0),
        Series(1.0, 1.0, 1.0, 3.0),
    ],
)
def test_a_series_controller_slower_than_its_terms_has_no_isa_form(form: Series) -> None:
    with pytest.raises(Refused, match="no ISA form") as caught:
        of_series(form)
    assert caught.value.reason is Reason.OUTSIDE_RANGE


def test_the_form_of_the_me_pso_paper() -> None:
    """Its Ti is 1/Ki."""
    r = to_reciprocal(Gains(Kp=1.5, Ti=3.0))
    assert (r.Kp, r.Ti) == (1.5, 2.0)
    same(Gains(Kp=1.5, Ti=3.0), 1.5 + 1.0 / (2.0 * S))


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.nan, math.inf])
def test_no_isa_form_without_a_gain(wrong: float) -> None:
    for convert in (
        lambda: of_parallel(Parallel(wrong, 1.0, 1.0)),
        lambda: of_series(Series(wrong, 1.0, 0.1)),
        lambda: to_series(Gains(wrong, 1.0)),
        lambda: to_parallel(Gains(wrong, 1.0)),
    ):
        with pytest.raises(Refused, match="Kp must be a number > 0") as caught:
            convert()
        assert caught.value.reason is Reason.BAD_INPUT


def test_other_refusals() -> None:
    for gains in (Gains(1.0, 2.0, 0.1), Gains(1.0)):
        with pytest.raises(Refused, match="a PI"):
            to_reciprocal(gains)
    with pytest.raises(Refused, match="Kd must be a number >= 0"):
        of_parallel(Parallel(1.0, 1.0, -1.0))
