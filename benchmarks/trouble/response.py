"""A linear plant by its frequency response, and what gains are worth on it: Ms, and stability by Nyquist's criterion.

A rational model with one dead time has an exact stability test (`loopwright.tuning.analysis.stability`); a sum of
paths, a recirculation or a neighbour's loop has none. Here the curve 1 + L(jw) is followed on a grid that is made finer
until no step turns it by more than a fraction of a turn, and its turns are counted (Nyquist 1932).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Complexes, Reals

LOWEST, HIGHEST = 1e-5, 1e3
"""Of the grid, in ultimate frequencies."""
PER_DECADE, PER_TURN = 300, 48
"""Frequencies in a decade, and in a turn of the longest delay up to DELAYS ultimate frequencies."""
DELAYS = 20.0
MAX_TURN = 0.5
"""Radians between two frequencies of the grid."""
ROUNDS = 24
AGREES = 0.1
"""How far from a whole number of poles the count may be."""


@dataclass(frozen=True, slots=True)
class Response:
    """A linear plant of positive static gain.

    at: its frequency response at s = jw (rad/s), of the same shape.  delay_s: the longest of its delays.
    unstable: how many of its own poles are in the right half plane.  integrators: how many are at the origin.
    """

    at: Callable[[Complexes], Complexes]
    delay_s: float = 0.0
    unstable: int = 0
    integrators: int = 0

    def along(self, w: Reals) -> Complexes:
        """At these frequencies, rad/s."""
        return self.at(np.asarray(1j * w, dtype=complex))


def gain(size: float) -> Response:
    """A plant, or a part of one, that multiplies by this."""
    return Response(lambda s: np.full(s.shape, complex(size)))


def delayed(by_s: float) -> Response:
    """A dead time."""
    return Response(lambda s: np.exp(-by_s * s), by_s)


def rational(num: Sequence[float], den: Sequence[float], L: float = 0.0) -> Response:
    """num(s)/den(s) exp(-L s), coefficients from the highest power down."""
    poles = np.roots(den)
    unstable, integrators = int(np.sum(poles.real > 0.0)), int(np.sum(poles == 0.0))
    return Response(lambda s: np.polyval(num, s) / np.polyval(den, s) * np.exp(-L * s), L, unstable, integrators)


def series(*parts: Response) -> Response:
    """One after the other."""

    def at(s: Complexes) -> Complexes:
        product: Complexes = np.ones(s.shape, dtype=complex)
        for part in parts:
            product = product * part.at(s)
        return product

    return Response(
        at,
        sum(each.delay_s for each in parts),
        sum(each.unstable for each in parts),
        sum(each.integrators for each in parts),
    )


def controller(gains: Gains) -> Response:
    """The ISA controller, `loopwright.tuning.gains`."""

    def at(s: Complexes) -> Complexes:
        integral = 1.0 / (gains.Ti * s) if gains.Ti else 0.0
        found: Complexes = gains.Kp * (1.0 + integral + gains.Td * s / (1.0 + gains.Tf * s))
        return found

    return Response(at, integrators=1 if gains.Ti else 0)


@dataclass(frozen=True, slots=True)
class Judged:
    """What gains are worth on a plant. Ms of an unstable loop describes the curve and is no margin."""

    Ms: float
    unstable: int

    @property
    def stable(self) -> bool:
        return self.unstable == 0


def judged(plant: Response, gains: Gains, Pu: float) -> Judged:
    """Pu: an ultimate period of the plant or of one like it, s, which scales the grid.

    Raises ValueError where the turns cannot be counted: a curve through -1 as far as floating point can tell.
    """
    loop = series(plant, controller(gains))
    wu = 2.0 * math.pi / Pu
    w = np.geomspace(LOWEST * wu, HIGHEST * wu, round(PER_DECADE * math.log10(HIGHEST / LOWEST)))
    if plant.delay_s:
        step = 2.0 * math.pi / (PER_TURN * plant.delay_s)
        w = np.union1d(w, np.arange(step, DELAYS * wu, step))
    w, curve = _followed(loop, w)
    turned = float(np.sum(np.angle(curve[1:] / curve[:-1])))
    # a stable loop of a stable plant comes from minus a quarter turn for each integrator to rest
    poles = loop.unstable + (0.5 * math.pi * loop.integrators - turned) / math.pi
    if abs(poles - round(poles)) > AGREES:
        raise ValueError(f"{poles:.3f} unstable poles were counted: the curve is not followed")
    return Judged(1.0 / max(_least(loop, w, int(np.argmin(np.abs(curve)))), 1e-12), round(poles))


def _followed(loop: Response, w: Reals) -> tuple[Reals, Complexes]:
    """The grid, finer where 1 + L turns fast, and 1 + L on it."""
    curve = 1.0 + loop.along(w)
    for _ in range(ROUNDS):
        wide = np.flatnonzero(np.abs(np.angle(curve[1:] / curve[:-1])) > MAX_TURN)
        if not len(wide):
            return w, curve
        between = 0.5 * (w[wide] + w[wide + 1])
        w = np.insert(w, wide + 1, between)
        curve = np.insert(curve, wide + 1, 1.0 + loop.along(between))
    raise ValueError(f"1 + L turns too fast to be followed near {w[wide[0]]:.4g} rad/s")


def _least(loop: Response, w: Reals, at: int) -> float:
    """|1 + L| at its least, near this frequency of the grid."""
    low, high = w[max(at - 1, 0)], w[min(at + 1, len(w) - 1)]

    def size(x: float) -> float:
        return float(abs(1.0 + loop.along(np.array([x]))[0]))

    found = minimize_scalar(size, bounds=(low, high), method="bounded", options={"xatol": 1e-7 * float(high)})
    return min(float(found.fun), size(float(w[at])))
