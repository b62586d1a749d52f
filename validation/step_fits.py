"""FOPDT models of recorded steps: least squares for an open-loop step and for a closed loop.

Each function takes the record as arrays over t (s) that begin at the step. For records of other shapes see `identify`.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import least_squares

from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Reals
from loopwright.tuning.reasons import Reason, Refused

MIN_SAMPLES = 20
FINE = 4000


def fit_step(t: Reals, y: Reals, step: float, y0: float, K: float | None = None) -> FOPDT:
    """The FOPDT model of an open-loop step by least squares over time; the record need not end at rest.

    t: the times of the samples, s; the step is at t[0].
    y: PV, PV units.
    step: the step of MV, MV units.
    y0: PV at rest before the step, PV units.
    K: a known gain, PV units per MV unit; by default the gain is fitted too.
    Raises Refused: BAD_INPUT, NO_RESPONSE.
    """
    time, change = _checked(t, y, step, y0)
    end = float(time[-1])
    # on a sparse grid the sum of squares has a valley between any two samples that the dead time passes
    fine = np.linspace(0.0, end, max(len(time), FINE))
    wanted = np.interp(fine, time, change / step)

    def gain(T: float, L: float) -> tuple[float, Reals]:
        shape = 1.0 - np.exp(-np.maximum(fine - L, 0.0) / T)
        size = float(shape @ shape)
        k = K if K is not None else float(shape @ wanted) / size if size > 0.0 else 0.0
        return k, np.asarray(k * shape - wanted)

    def cost(start: tuple[float, float]) -> float:
        return float(np.sum(gain(*start)[1] ** 2))

    def difference(x: Reals) -> Reals:
        return gain(math.exp(x[0]), float(x[1]))[1]

    # while the response is not complete many pairs (T, L) fit alike, so the search starts from a coarse grid
    T, L = min(((T, L) for T in end * np.geomspace(0.01, 3.0, 12) for L in end * np.linspace(0.0, 0.6, 13)), key=cost)
    found = least_squares(
        difference,
        [math.log(T), max(L, 1e-3 * end)],
        bounds=([math.log(1e-5 * end), 0.0], [math.log(1e3 * end), end]),
        x_scale=[0.1, 0.1 * end],
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-14,
    )
    T, L = math.exp(float(found.x[0])), float(found.x[1])
    k, _ = gain(T, L)
    if k == 0.0:
        raise Refused(Reason.NO_RESPONSE, "the fitted gain is zero")
    return FOPDT(k, T, L)


def fit_closed_loop(t: Reals, y: Reals, gains: Gains, step: float, y0: float, K: float | None = None) -> FOPDT:
    """The FOPDT model of a set-point step in closed loop under known gains.

    The result is the model whose loop under these gains has the response with the smallest sum of squared differences
    from the record.

    t: the times of the samples, s; the step is at t[0].
    y: PV, PV units.
    gains: the gains in effect.
    step: the set-point step, PV units.
    y0: PV at rest before the step, PV units.
    K: a known gain, PV units per MV unit; by default the gain is fitted too. The model's K is positive, as the record
    does not show the direction of the plant.
    Raises Refused: BAD_INPUT for a record or gains that cannot be used; NO_RESPONSE.

    Source: Stopakevych et al., automatic re-tuning of PI controllers, Problemele Energeticii Regionale (row 5 of
    Table 1, which reproduces with the squares, not with the absolute differences that its text names).
    """
    time, change = _checked(t, y, step, y0)
    share = change / step
    end = float(time[-1])

    def model(logs: Reals) -> FOPDT:
        return FOPDT(K if K is not None else math.exp(logs[2]), math.exp(logs[0]), math.exp(logs[1]))

    def difference(logs: Reals) -> Reals:
        each = model(logs)
        try:
            found = step_response(each, gains, horizon=end, dt=min(end / 1000.0, each.L / 30.0))
        except Refused:
            # an unstable candidate that leaves all bounds
            return np.full(len(time), 1e3)
        return np.clip(np.interp(time, found.t, found.y) - share, -1e3, 1e3)

    def cost(logs: Reals) -> float:
        return float(np.sum(difference(logs) ** 2))

    begun = float(time[int(np.argmax(share > 0.05))])
    known = [] if K is not None else [_static_gain(time, share, gains)]
    start = min(
        (np.log([T, L, *known]) for L in (0.4 * begun, 0.9 * begun) for T in begun * np.array([0.3, 1.0, 3.0, 10.0])),
        key=cost,
    )

    def around(x: Reals) -> Reals:
        # counted from one, so that the relative step of the differences is one of the logarithm
        return difference(start + x - 1.0)

    found = least_squares(
        around, np.ones(len(start)), x_scale=0.1, xtol=1e-8, ftol=1e-10, diff_step=[1e-4] * len(start)
    )
    return model(start + found.x - 1.0)


def _static_gain(time: Reals, share: Reals, gains: Gains) -> float:
    """A first estimate of the gain: with integral action from the integral of the error, which is Ti/(K*Kp); without it
    from the end of the record."""
    if gains.Ti > 0.0:
        area = float(np.trapezoid(1.0 - share, time))
        # from a record that ends too early the area is too small, at worst negative
        return gains.Ti / (gains.Kp * max(area, 0.05 * float(time[-1])))
    ends = min(max(float(np.mean(share[-max(len(share) // 20, 1) :])), 0.01), 0.99 * gains.b)
    return ends / (gains.Kp * (gains.b - ends))


def _checked(t: Reals, y: Reals, step: float, y0: float) -> tuple[Reals, Reals]:
    """The record as (t from 0, change of y). Raises Refused, BAD_INPUT or NO_RESPONSE."""
    time, change = np.asarray(t, dtype=float), np.asarray(y, dtype=float) - y0
    if time.ndim != 1 or time.shape != change.shape or len(time) < MIN_SAMPLES:
        raise Refused(
            Reason.BAD_INPUT,
            f"t has shape {time.shape}, y {change.shape}: equal lengths of {MIN_SAMPLES} samples at least are needed",
        )
    if not (np.isfinite(time).all() and np.isfinite(change).all() and math.isfinite(step) and step != 0.0):
        raise Refused(Reason.BAD_INPUT, f"t, y, y0 and the step must be finite and the step ({step}) not 0")
    if not (np.diff(time) > 0.0).all():
        i = int(np.argmin(np.diff(time)))
        raise Refused(Reason.BAD_INPUT, f"t must increase: {time[i]:g} s is followed by {time[i + 1]:g} s")
    if not np.ptp(change) > 0.0:
        raise Refused(Reason.NO_RESPONSE, "y does not change at all")
    return time - time[0], change
