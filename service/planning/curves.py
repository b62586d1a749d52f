"""What a loop does on a model, as curves: the one simulation that page, report, API and plots show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from loopwright.service.results import Figures
from loopwright.tuning.analysis.comparison import as_sampled
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.analysis.stability import open_loop
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals, sign
from loopwright.tuning.reasons import Ended

LOAD_PCT = 10.0
"""Size of the load step that pictures and tables show, percent of MV."""
POINTS, NYQUIST_POINTS = 161, 121
_DIGITS = 5
"""Digits of a value, counted from the largest of its curve."""
_SHOWN_SETTLINGS = 1.6
_LARGEST, _SMALLEST = 4.0, 0.08
"""Loop gains between which the Nyquist curve is drawn: the neighbourhood of -1."""


class StepCurve(Figures):
    """PV after a unit step from rest, at times evenly spaced from 0 to horizon_s."""

    horizon_s: float = Field(description="Time of the last value, s; the first is of the time 0", examples=[120.0])
    pv: list[float] = Field(description="Change of PV for a step of 1: of the set-point by 1 PV unit, or of the load "
                            "at the plant's input by 1 % of MV; PV units")  # fmt: skip

    @property
    def t(self) -> Reals:
        """The times of the values, s."""
        return np.linspace(0.0, self.horizon_s, len(self.pv))


class LoopCurves(Figures):
    """What the loop does on the model with the delay of the sampling, as curves: computed, not measured."""

    setpoint: StepCurve = Field(description="After a step of the set-point by 1 PV unit")
    load: StepCurve = Field(description="After a step of the load by 1 % of MV")
    nyquist_re: list[float] = Field(description="Real part of the loop's frequency response around -1, rising w")
    nyquist_im: list[float] = Field(description="Its imaginary part")


Horizons = tuple[float, float]
"""Lengths of the curves after a step of the set-point and of the load, s."""


def horizons(model: Model, candidates: Sequence[Gains | None], sample_time_s: float = 0.0) -> Horizons:
    """Returns lengths within which the loop comes to rest, for the first of these gains that is stable.

    model: with the delay of the sampling in its dead time.
    """
    for gains in candidates:
        if gains is not None and _is_stable(model, realised := as_sampled(gains, sample_time_s)):
            return _settling(model, realised, False), _settling(model, realised, True)
    return 20.0 * (model.L + 1.0), 20.0 * (model.L + 1.0)


def loop_curves(model: Model, gains: Gains, ends: Horizons, sample_time_s: float = 0.0) -> LoopCurves | None:
    """Returns the curves of these gains; None where the loop is not stable.

    model: with the delay of the sampling in its dead time.
    """
    realised = as_sampled(gains, sample_time_s)
    if not _is_stable(model, realised):
        return None
    try:
        setpoint, load = (
            StepCurve(horizon_s=end, pv=_rounded(_step(model, realised, end, is_load)))
            for end, is_load in zip(ends, (False, True), strict=True)
        )
        loop = _nyquist(model, realised)
    except Ended:
        return None
    re, im = _rounded(loop.real), _rounded(loop.imag)
    return LoopCurves(setpoint=setpoint, load=load, nyquist_re=re, nyquist_im=im)


def _is_stable(model: Model, gains: Gains) -> bool:
    try:
        return margins(model, gains).stable
    except Ended:
        return False


def _step(model: Model, gains: Gains, horizon_s: float, load: bool) -> Reals:
    found = step_response(model, gains, horizon_s, load=load)
    turned = sign(model) if load else 1.0  # the response is of a plant of positive gain
    return turned * np.interp(np.linspace(0.0, horizon_s, POINTS), found.t, found.y)


def _settling(model: Model, gains: Gains, load: bool) -> float:
    """Returns a time within which the answer to a step has come to rest, s."""
    found = step_response(model, gains, load=load)
    away = np.abs(found.y - found.y[-1])
    late = np.flatnonzero(away > 0.05 * float(np.max(away, initial=0.0)))
    last = float(found.t[late[-1]]) if len(late) else float(found.t[-1])
    return max(_SHOWN_SETTLINGS * last, 4.0 * model.L, 1e-6)


def _nyquist(model: Model, gains: Gains) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    N, D = open_loop(model, gains)
    corners = np.abs(np.concatenate((np.roots(N), np.roots(D), [1.0 / model.L if model.L > 0.0 else 0.0])))
    corners = corners[corners > 0.0]
    low, high = (float(corners.min()), float(corners.max())) if len(corners) else (1.0, 1.0)
    w = np.geomspace(1e-4 * low, 1e4 * high, 4000)
    size = np.abs(np.polyval(N, 1j * w) / np.polyval(D, 1j * w))
    near = np.flatnonzero((size < _LARGEST) & (size > _SMALLEST))
    if len(near):
        w = np.geomspace(w[near[0]], w[near[-1]], NYQUIST_POINTS)
    s = 1j * w[:NYQUIST_POINTS]
    return np.asarray(np.polyval(N, s) / np.polyval(D, s) * np.exp(-model.L * s))


def _rounded(values: Reals) -> list[float]:
    largest = float(np.max(np.abs(values), initial=0.0))
    if not largest > 0.0:
        return [0.0] * len(values)
    rounded: list[float] = np.round(values, _DIGITS - math.ceil(math.log10(largest))).tolist()
    return rounded
