"""Gains in the forms of faceplates, against the laws that the forms name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from loopwright.service.offline.controller_forms import BadForm, ControllerForm, Faceplate
from loopwright.tuning.gains import Gains

S = 1j * np.logspace(-3, 1, 30)
PV_SPAN, MV_SPAN = 200.0, 50.0
LAWS: dict[ControllerForm, Callable[[float, float, float, float], np.ndarray]] = {
    ControllerForm.ISA: lambda a, b, c, unit: a * (1 + 1 / (b * unit * S) + c * unit * S),
    ControllerForm.PARALLEL: lambda a, b, c, unit: a + b / (unit * S) + c * unit * S,
    ControllerForm.SERIES: lambda a, b, c, unit: a * (1 + 1 / (b * unit * S)) * (1 + c * unit * S),
    ControllerForm.PB: lambda a, b, c, unit: 100 / a * (1 + 1 / (b * unit * S) + c * unit * S),
    ControllerForm.REPEATS: lambda a, b, c, unit: a * (1 + b / (60.0 * S) + c * unit * S),
}
"""The transfer function of each form with its three numbers and the seconds of its unit of time."""


@pytest.mark.parametrize("minutes", [False, True])
@pytest.mark.parametrize("form", ControllerForm)
def test_the_numbers_are_those_of_the_same_controller(form: ControllerForm, minutes: bool) -> None:
    gains = Gains(1.5, 40.0, 5.0)
    numbers = Faceplate(form, PV_SPAN, MV_SPAN, minutes).numbers(gains)
    assert numbers is not None
    isa = 1.5 * PV_SPAN / MV_SPAN * (1 + 1 / (40.0 * S) + 5.0 * S)
    np.testing.assert_allclose(LAWS[form](*numbers, 60.0 if minutes else 1.0), isa, rtol=1e-12)


def test_without_integral_action() -> None:
    assert Faceplate(ControllerForm.REPEATS).numbers(Gains(2.0)) == (2.0, 0.0, 0.0)
    assert Faceplate(ControllerForm.PARALLEL).numbers(Gains(2.0)) == (2.0, 0.0, 0.0)


def test_the_series_form_needs_real_zeros() -> None:
    assert Faceplate(ControllerForm.SERIES).numbers(Gains(2.0, 10.0, 2.6)) is None


@pytest.mark.parametrize("span", [0.0, -1.0, float("inf"), float("nan")])
def test_spans_that_are_none(span: float) -> None:
    with pytest.raises(BadForm, match="--pv-span"):
        Faceplate(pv_span=span)
    with pytest.raises(BadForm, match="--mv-span"):
        Faceplate(mv_span=span)
