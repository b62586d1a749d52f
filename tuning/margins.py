"""Stability margins of a loop and the ultimate point of a plant, with exact dead time.

A dense logarithmic grid finds the crossings and the peak, a local search refines each. Loops are taken with the sign
that makes them negative feedback (the controller's direct or reverse action), so models of negative gain need no care.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from tuning.gains import Gains
from tuning.models import Complexes, Model, Reals, time_constants
from tuning.reasons import Reason, Refused

POINTS_PER_DECADE = 600


@dataclass(frozen=True, slots=True)
class Margins:
    """GM: ratio.  PM_deg: degrees.  Ms: peak of |1/(1+L)|.  Mt: peak of |L/(1+L)|.

    wc: gain crossover, wpc: phase crossover, ws: where Ms is, all rad/s. A margin without its crossing is infinite, its
    frequency NaN. `stable` is the Nyquist count of the loop (the plant itself must be stable); with stable false the
    other figures describe the curve, not a margin.
    """

    GM: float
    PM_deg: float
    Ms: float
    Mt: float
    wc: float
    wpc: float
    ws: float
    stable: bool


def controller_response(gains: Gains, w: Reals) -> Complexes:
    """The feedback path of the ISA controller (set-point weights play no part), at w rad/s."""
    s = 1j * np.asarray(w, dtype=float)
    c = np.ones_like(s)
    if gains.Ti > 0.0:
        c = c + 1.0 / (gains.Ti * s)
    if gains.Td > 0.0:
        c = c + gains.Td * s / (1.0 + gains.Tf * s)
    return np.asarray(gains.Kp * c)


def margins(model: Model, gains: Gains) -> Margins:
    """Margins of the loop of this model and these gains."""
    sign = math.copysign(1.0, model.static_gain)

    def loop(w: Reals) -> Complexes:
        return np.asarray(sign * model.frequency_response(w) * controller_response(gains, w))

    w = _grid(model, gains)
    L = loop(w)
    one_plus = np.abs(1.0 + L)
    ws, least = _least(lambda x: float(abs(1.0 + loop(np.array([x]))[0])), w, int(np.argmin(one_plus)))
    closed = np.abs(L) / one_plus
    _, mt = _least(
        lambda x: -float(abs(loop(np.array([x]))[0] / (1.0 + loop(np.array([x]))[0]))), w, int(np.argmax(closed))
    )

    wpc, inverse_gm = math.nan, 0.0
    for x in _crossings(lambda v: loop(v).imag, w, L.imag, (L.real < 0.0)):
        size = float(abs(loop(np.array([x]))[0]))
        if size > inverse_gm:
            wpc, inverse_gm = x, size

    wc, pm = math.nan, math.inf
    for x in _crossings(lambda v: np.log(np.abs(loop(v))), w, np.log(np.abs(L)), np.ones(w.shape, dtype=bool)):
        here = float(np.degrees(np.angle(-loop(np.array([x]))[0])))
        if abs(here) < abs(pm):
            wc, pm = x, abs(here)

    return Margins(
        GM=1.0 / inverse_gm if inverse_gm > 0.0 else math.inf,
        PM_deg=pm,
        Ms=1.0 / least if least > 0.0 else math.inf,
        Mt=-mt,
        wc=wc,
        wpc=wpc,
        ws=ws,
        stable=_stable(L, model.L > 0.0),
    )


def ultimate_point(model: Model) -> tuple[float, float]:
    """(Ku, Pu): the gain, positive, at which a P loop just oscillates, and the period of it in s."""
    found = margins(model, Gains(Kp=1.0))
    if not math.isfinite(found.GM):
        raise Refused(Reason.CANNOT_OSCILLATE, "the model's phase never reaches -180 degrees")
    return found.GM, 2.0 * math.pi / found.wpc


def _grid(model: Model, gains: Gains) -> Reals:
    """From well below the slowest to well above the fastest corner of the loop."""
    corners = [float(1.0 / x) for x in time_constants(model)]
    corners += [float(x) for x in np.abs(np.roots(model.num)) if x > 0.0]
    corners += [1.0 / x for x in (gains.Ti, gains.Td, gains.Tf, model.L) if x > 0.0]
    low, high = 1e-3 * min(corners), 1e2 * max(corners)
    points = int(POINTS_PER_DECADE * math.log10(high / low)) + 1
    return np.asarray(np.geomspace(low, high, points))


def _crossings(f: Callable[[Reals], Reals], w: Reals, values: Reals, wanted: NDArray[np.bool_]) -> list[float]:
    """Zeros of f between grid points that are both wanted."""
    keep = wanted[:-1] & wanted[1:]
    at = np.flatnonzero((np.sign(values[:-1]) * np.sign(values[1:]) <= 0.0) & keep)
    # beyond a few dozen turns of the dead time the loop gain has long decayed: the first crossings decide
    return [
        float(brentq(lambda x: float(f(np.array([x]))[0]), w[i], w[i + 1], xtol=1e-12 * float(w[i]), rtol=1e-12))
        for i in at[:40]
        if values[i] != values[i + 1]
    ]


def _least(f: Callable[[float], float], w: Reals, at: int) -> tuple[float, float]:
    """The least value of f near the grid point `at`: (where, value)."""
    if at in (0, len(w) - 1):
        return float(w[at]), f(float(w[at]))
    found = minimize_scalar(f, bounds=(w[at - 1], w[at + 1]), method="bounded", options={"xatol": 1e-7 * float(w[at])})
    return float(found.x), float(found.fun)


def _stable(L: Complexes, dead_time: bool) -> bool:
    """Nyquist for a stable plant and at most one integrator: 1+L ends on the branch of the angle it started from."""
    if dead_time and abs(L[-1]) >= 1.0:
        return False
    turned = np.unwrap(np.angle(1.0 + L))
    # a dead time leaves the end anywhere within a right angle; a whole turn too many is far from that
    return bool(abs(turned[-1]) < 0.75 * math.pi)
