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

from loopwright.tuning.analysis.stability import is_stable, open_loop
from loopwright.tuning.gains import AnyGains, Gains, as_gains
from loopwright.tuning.models import AnyModel, Complexes, Model, Reals, as_model
from loopwright.tuning.reasons import Reason, Refused

POINTS_PER_DECADE = 600
COARSE = 0.1
"""The turn of the dead time between two points of the grid from which the peak may lie between them, rad."""
LIGHT = 0.01
"""The damping ratio of a pole or zero below which the grid is refined about it: its phase turns between few points."""
CROSSINGS = 40
"""The crossings that are looked at: of more, those with the largest gain."""


@dataclass(frozen=True, slots=True)
class Margins:
    """The stability margins of a loop. A margin without its crossover is None, and so is its frequency. The frequencies
    have the names of `control.stability_margins`.

    GM: the gain margin, a ratio: the smallest factor above one that takes a stable loop to its stability limit.
    PM_deg: the phase margin, degrees.
    Ms, Mt: the peaks of |1/(1+L)| and |L/(1+L)|.
    delay_margin_s: the smallest further dead time that takes the loop to its stability limit, s; None for a loop that
    is not stable, or that no dead time makes unstable.
    wgc, wpc: the gain crossover and the phase crossover, rad/s.
    wms: the frequency of the peak Ms, rad/s; the highest one looked at where |1/(1+L)| is largest in the limit.
    bandwidth: the frequency at which |L/(1+L)| first falls to 1/sqrt(2) of its value at rest, rad/s.
    stable: whether the loop is stable, exactly (see `tuning.analysis.stability`). The other figures of an unstable loop
    describe the curve and are no margins.
    """

    GM: float | None
    PM_deg: float | None
    Ms: float
    Mt: float
    delay_margin_s: float | None
    wgc: float | None
    wpc: float | None
    wms: float
    bandwidth: float | None
    stable: bool


def margins(model: AnyModel, gains: AnyGains) -> Margins:
    """The margins of the loop of this model and these gains; Tf = 0 is the ideal derivative.

    Raises Refused, BAD_INPUT: gains out of range, or an ideal derivative on a bi-proper plant. Raises TypeError for
    what is no model or has no gains.
    """
    plant, in_effect = as_model(model), as_gains(gains)
    N, D = open_loop(plant, in_effect)
    stable = is_stable(plant, in_effect)

    def loop(w: Reals) -> Complexes:
        s = 1j * w
        return np.asarray(np.polyval(N, s) / np.polyval(D, s) * np.exp(-plant.L * s))

    def at(w: float) -> complex:
        return complex(loop(np.array([w]))[0])

    w = frequency_grid(plant, N, D)
    L = loop(w)

    def nearness(x: float) -> float:
        return abs(1.0 + at(x))

    ws, minimum = _min(nearness, w, int(np.argmin(np.abs(1.0 + L))))
    turn = _turn(plant, w, L, minimum) if stable else w[:0]
    if len(turn) and np.min(np.abs(1.0 + loop(turn))) < minimum:
        w = np.sort(np.concatenate((w, turn)))
        L = loop(w)
        ws, minimum = _min(nearness, w, int(np.argmin(np.abs(1.0 + L))))
    one_plus = np.abs(1.0 + L)
    closed = np.abs(L) / one_plus
    _, mt = _min(lambda x: -abs(at(x) / (1.0 + at(x))), w, int(np.argmax(closed)))

    wpc, inverse_gm = None, 0.0
    for x in _crossings(lambda v: loop(v).imag, w, L.imag, (L.real < 0.0), np.abs(L)):
        size = abs(at(x))
        # a stable loop may cross beyond -1 as well (conditional stability): less gain, not more, ends it there
        if size > inverse_gm and not (stable and size >= 1.0):
            wpc, inverse_gm = x, size

    wgc, pm, delay = None, None, math.inf
    everywhere = np.ones(w.shape, dtype=bool)
    for x in _crossings(lambda v: np.log(np.abs(loop(v))), w, np.log(np.abs(L)), everywhere, np.abs(L)):
        angle = float(np.angle(-at(x)))
        if pm is None or abs(angle) < math.radians(pm):
            wgc, pm = x, abs(math.degrees(angle))
        # a dead time turns the curve clockwise; farther up a smaller one is enough
        delay = min(delay, angle % (2.0 * math.pi) / x)

    gain, nearest = _at_infinity(plant, N, D)
    if gain >= 1.0:
        delay = 0.0
    return Margins(
        GM=1.0 / inverse_gm if inverse_gm > 0.0 else None,
        PM_deg=pm,
        Ms=1.0 / max(min(minimum, nearest), 1e-12),
        Mt=max(-mt, gain / max(nearest, 1e-12)),
        delay_margin_s=delay if stable and delay < math.inf else None,
        wgc=wgc,
        wpc=wpc,
        wms=ws,
        bandwidth=_bandwidth(loop, w, closed, N, D),
        stable=stable,
    )


@dataclass(frozen=True, slots=True)
class Ultimate:
    """An ultimate point, as measured on the loop, computed from a model, or typed in.

    Ku: the ultimate gain, MV units per PV unit.
    Pu_s: the ultimate period, s.
    """

    Ku: float
    Pu_s: float


def ultimate_point(model: AnyModel) -> tuple[float, float]:
    """The ultimate point (Ku, Pu): the positive gain at which a P loop just oscillates, and the period in s.

    Raises Refused, CANNOT_OSCILLATE, for a model without an ultimate point.
    """
    found = margins(model, Gains(Kp=1.0))
    if found.GM is None or found.wpc is None:
        raise Refused(Reason.CANNOT_OSCILLATE, "the model's phase never reaches -180 degrees")
    return found.GM, 2.0 * math.pi / found.wpc


def frequency_grid(model: Model, N: Reals, D: Reals) -> Reals:
    """The frequency grid of the loop N/D with the model's dead time, rad/s: from well below the slowest to well above
    the fastest corner, to a decade beyond the gain crossover where a high gain moves that farther up, and dense about
    lightly damped poles and zeros."""
    roots = np.concatenate((np.roots(N), np.roots(D)))
    w, modes = _grid(model, N, D, roots), _modes(roots)
    return np.asarray(np.union1d(w, modes)) if len(modes) else w


def _grid(model: Model, N: Reals, D: Reals, roots: Complexes) -> Reals:
    """The grid without the part about lightly damped poles and zeros. roots: those of N and D."""
    corners = [float(x) for x in np.abs(roots) if x > 0.0]
    kept = np.trim_zeros(D, "b")
    origin = len(D) - len(kept)
    if origin:
        # where the integrating part alone would cross
        corners.append(float(abs(N[-1] / kept[-1]) ** (1.0 / origin)))
    if model.L > 0.0:
        corners.append(1.0 / model.L)
    low, high = 1e-3 * min(corners), 1e2 * max(corners)
    points = int(POINTS_PER_DECADE * math.log10(high / low)) + 1
    w = np.asarray(np.geomspace(low, high, points))
    # where the fastest part alone would cross; the points below stay as they are
    end = 10.0 * float(abs(N[0] / D[0]) ** (1.0 / (len(D) - len(N)))) if len(D) > len(N) else 0.0
    if end <= high:
        return w
    return np.concatenate((w, np.geomspace(high, end, int(POINTS_PER_DECADE * math.log10(end / high)) + 2)[1:]))


def _modes(roots: Complexes) -> Reals:
    """Frequencies about every lightly damped pole and zero, rad/s, between which its phase turns by a degree."""
    found = [np.empty(0)]
    for root in roots:
        width = abs(float(root.real))
        if 0.0 < width < LIGHT * float(root.imag):
            end = math.atan(2.0 * LIGHT * float(root.imag) / width)
            found.append(float(root.imag) + width * np.tan(np.linspace(-end, end, 201)))
    return np.concatenate(found)


def _turn(model: Model, w: Reals, L: Complexes, minimum: float) -> Reals:
    """One turn of the dead time about the frequency where |L| comes nearest to 1, if the dead time turns faster there
    than the grid and may bring L nearer to -1 than `minimum`; else nothing."""
    fast = np.flatnonzero(w * (model.L * math.log(10.0) / POINTS_PER_DECADE) > COARSE)
    distances = np.abs(1.0 - np.abs(L[fast]))
    if not len(fast) or np.min(distances) >= minimum:
        return w[:0]
    return np.asarray(w[fast[np.argmin(distances)]] + np.linspace(-math.pi, math.pi, 100) / model.L)


def _at_infinity(model: Model, N: Reals, D: Reals) -> tuple[float, float]:
    """The limit of |L| at high frequency, and how near L comes to -1 there, which with dead time it does again and
    again."""
    ratio = float(N[0] / D[0]) if len(N) == len(D) else 0.0
    return abs(ratio), abs(1.0 - abs(ratio)) if model.L > 0.0 else abs(1.0 + ratio)


def _bandwidth(loop: Callable[[Reals], Complexes], w: Reals, closed: Reals, N: Reals, D: Reals) -> float | None:
    level = abs(N[-1] / (N[-1] + D[-1])) / math.sqrt(2.0)
    below = np.flatnonzero(closed < level)
    if not len(below) or below[0] == 0:
        return None
    i = int(below[0])

    def excess(x: float) -> float:
        at = complex(loop(np.array([x]))[0])
        return float(abs(at / (1.0 + at)) - level)

    return float(brentq(excess, w[i - 1], w[i], xtol=1e-12 * float(w[i]), rtol=1e-12))


def _crossings(
    f: Callable[[Reals], Reals], w: Reals, values: Reals, wanted: NDArray[np.bool_], sizes: Reals
) -> list[float]:
    """The zeros of f between neighbouring grid points that are both wanted, from the lowest up; of many, those where
    the gain, `sizes`, is largest."""
    keep = wanted[:-1] & wanted[1:]
    at = np.flatnonzero((np.sign(values[:-1]) * np.sign(values[1:]) <= 0.0) & keep)
    if len(at) > CROSSINGS:
        at = np.sort(at[np.argsort(-sizes[at], kind="stable")[:CROSSINGS]])
    return [
        float(brentq(lambda x: float(f(np.array([x]))[0]), w[i], w[i + 1], xtol=1e-12 * float(w[i]), rtol=1e-12))
        for i in at
        if values[i] != values[i + 1]
    ]


def _min(f: Callable[[float], float], w: Reals, at: int) -> tuple[float, float]:
    """The minimum of f near the grid point `at`, as (frequency, value)."""
    if at in (0, len(w) - 1):
        return float(w[at]), f(float(w[at]))
    low, high = float(w[at - 1]), float(w[at + 1])
    xatol = min(1e-7 * float(w[at]), 1e-3 * (high - low))
    found = minimize_scalar(f, bounds=(low, high), method="bounded", options={"xatol": xatol})
    return float(found.x), float(found.fun)
