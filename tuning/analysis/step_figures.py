"""The figures that engineers read from a step response."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.tuning.models import Reals


@dataclass(frozen=True, slots=True)
class StepFigures:
    """The figures of a response to a set-point step or to a load disturbance.

    overshoot_pct: the overshoot, percent of the final change, not below 0; 0 for a load disturbance.
    settling_s: the time from the step (dead time included) until PV stays within `band` of its final value, s; None if
    the record ends before that.
    band: the settling band, PV units.
    rise_s: the time from 10 to 90 % of the final change, s; None if 90 % is never reached, or for a load disturbance.
    peak: the largest change of PV in the direction of the step, PV units.

    The error e is the set-point less PV over the record. A lasting offset (a loop without integral action) makes the
    integrals grow with the record.
    IAE, ISE, ITAE, ITSE: the integrals of |e| (PV units * s), e^2, t|e| and t*e^2.
    MIE: the mean of |e| until PV has settled, PV units.

    The change u of MV has these figures, which are None where no MV was given.
    MIC: the mean of |u| until PV has settled, MV units.
    effort: the integral of (u - its final value)^2, MV units^2 * s.
    TV: the total variation, counted from before the step, MV units.
    peak_u: the largest |u|, MV units.

    MIE and MIC are those of Romasevych et al., PI-controller tuning optimization via PSO-based technique (there with a
    band of 5 %). A loop that does not settle within the record counts as settled at its end.
    """

    overshoot_pct: float
    settling_s: float | None
    band: float
    rise_s: float | None
    IAE: float
    ISE: float
    ITAE: float
    ITSE: float
    MIE: float
    peak: float
    MIC: float | None = None
    effort: float | None = None
    TV: float | None = None
    peak_u: float | None = None


def response_figures(
    t: Reals, y: Reals, u: Reals | None, *, final: float, reference: float, band: float, final_u: float = 0.0
) -> StepFigures:
    """The figures of a response that begins with the step at t = 0. A time at which a signal jumps is there twice.

    t, y, u: time (s), change of PV (PV units) and change of MV (MV units) or None, shape (N,).
    final, final_u: the final values of y and u; final is 0 for a load disturbance.
    reference: the set-point's change, PV units.
    band: the settling band, PV units.
    """
    error = reference - y
    size, squared = np.abs(error), error * error
    # of the trapezoidal rule
    weights = np.zeros(len(t))
    half = 0.5 * np.diff(t)
    weights[:-1] += half
    weights[1:] += half
    settling = _settling(t, np.abs(y - final), band)
    until = float(t[-1]) if settling is None or settling <= 0.0 else settling
    peak = float(np.max(y))
    return StepFigures(
        overshoot_pct=max(0.0, 100.0 * (peak / final - 1.0)) if final else 0.0,
        settling_s=settling,
        band=band,
        rise_s=_rise(t, y / final) if final else None,
        IAE=float(np.sum(weights * size)),
        ISE=float(np.sum(weights * squared)),
        ITAE=float(np.sum(weights * t * size)),
        ITSE=float(np.sum(weights * t * squared)),
        MIE=_mean_until(t, size, until),
        peak=peak,
        MIC=None if u is None else _mean_until(t, np.abs(u), until),
        effort=None if u is None else float(np.sum(weights * (u - final_u) ** 2)),
        TV=None if u is None else abs(float(u[0])) + float(np.sum(np.abs(np.diff(u)))),
        peak_u=None if u is None else float(np.max(np.abs(u))),
    )


def _settling(t: Reals, distance: Reals, band: float) -> float | None:
    """The time at which the distance to the final value falls into the band for good, s; None if it does not."""
    outside = np.flatnonzero(distance > band)
    if not len(outside):
        return 0.0
    i = int(outside[-1])
    if i == len(t) - 1:
        return None
    a, b = float(distance[i]), float(distance[i + 1])
    return float(t[i] + (t[i + 1] - t[i]) * (a - band) / (a - b))


def _rise(t: Reals, y: Reals) -> float | None:
    """The time from 10 to 90 % of one, s; None if 90 % is not reached."""
    at = []
    for level in (0.1, 0.9):
        above = y >= level
        i = int(np.argmax(above))
        if not above[i]:
            return None
        at.append(float(t[0]) if i == 0 else float(np.interp(level, y[i - 1 : i + 1], t[i - 1 : i + 1])))
    return at[1] - at[0]


def _mean_until(t: Reals, values: Reals, end: float) -> float:
    last = int(np.searchsorted(t, end, side="right"))
    kept, at = values[:last], t[:last]
    area = float(np.trapezoid(kept, at))
    if last < len(t):
        there = float(np.interp(end, t[last - 1 : last + 1], values[last - 1 : last + 1]))
        area += 0.5 * (float(kept[-1]) + there) * (end - float(at[-1]))
    return area / end
