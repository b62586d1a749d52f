"""The stability of a loop is decided by the number of its unstable poles, which is exact for any dead time.

The method is the direct method of Walton and Marshall (IEE Proc. D 134, 1987). Without dead time the poles are roots of
a polynomial. As the dead time grows from zero, poles cross the imaginary axis only at the loop's gain crossovers, in a
direction that the slope of |D(jw)|^2 - |N(jw)|^2 gives. The method needs no frequency grid, and poles of the plant at
the origin or in the right half plane need no special case.
"""

from __future__ import annotations

import math

import numpy as np

from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals, sign
from loopwright.tuning.reasons import Reason, Refused

ON_AXIS = 1e-9
"""A root this near to the imaginary axis, relative to its size, counts as unstable."""


def open_loop(model: Model, gains: Gains) -> tuple[Reals, Reals]:
    """The open loop N/D without its dead time, as (N, D): coefficients from the highest power down, positive static
    gain.

    gains: the gains; Tf = 0 is the ideal derivative.
    Raises Refused, BAD_INPUT: an ideal derivative on a bi-proper plant (N would be of higher degree than D), or gains
    out of range.
    """
    g = gains
    if not (np.isfinite([g.Kp, g.Ti, g.Td, g.Tf]).all() and g.Kp > 0.0 and min(g.Ti, g.Td, g.Tf) >= 0.0):
        raise Refused(
            Reason.BAD_INPUT,
            f"Kp = {g.Kp}, Ti = {g.Ti} s, Td = {g.Td} s, Tf = {g.Tf} s: Kp must be positive, the times not negative",
        )
    # from the lowest power up: the filter, then the controller's two polynomials
    lag = [1.0, g.Tf] if g.Td > 0.0 and g.Tf > 0.0 else [1.0]
    derived = [1.0, g.Td + (g.Tf if g.Td > 0.0 else 0.0)] if g.Td > 0.0 else [1.0]
    num, den = derived, lag
    if g.Ti > 0.0:
        num, den = np.convolve(derived, [0.0, g.Ti]).tolist(), [0.0, *(g.Ti * c for c in lag)]
        for power, c in enumerate(lag):
            num[power] += c
    N = np.convolve(model.num, num[::-1]) * (g.Kp * sign(model))
    D = np.convolve(model.den, den[::-1])
    if len(N) > len(D):
        raise Refused(
            Reason.BAD_INPUT,
            f"Td = {g.Td:g} s without a filter on a plant that passes jumps on: give Tf > 0 or Td = 0",
        )
    return N, D


def unstable_poles(model: Model, gains: Gains) -> int | None:
    """The number of poles of the closed loop that are not in the open left half plane; None for infinitely many.

    There are infinitely many if the loop gain stays above one at high frequency (dead time with an ideal derivative).
    """
    N, D = open_loop(model, gains)
    L = model.L
    if len(N) == len(D):
        if L > 0.0 and abs(N[0]) >= abs(D[0]):
            return None
        if L == 0.0 and N[0] + D[0] == 0.0:
            return None
    # frequency in units that keep the coefficients comparable
    unit = _scale(D)
    N, D = N * unit ** np.arange(len(N) - 1, -1, -1.0), D * unit ** np.arange(len(D) - 1, -1, -1.0)
    N, D = N / np.max(np.abs(D)), D / np.max(np.abs(D))
    roots = np.roots(np.polyadd(D, N))
    count = int(np.sum(roots.real > -ON_AXIS * np.abs(roots)))
    if L == 0.0:
        return count
    W = np.polysub(_squared_size(D), _squared_size(N))
    slope = np.polyder(W)
    for x in np.roots(W):
        if abs(x.imag) > 1e-7 * abs(x) or x.real <= 0.0:
            continue
        w = math.sqrt(x.real)
        jw = 1j * w
        first = float(np.angle(-np.polyval(N, jw) / np.polyval(D, jw))) % (2.0 * math.pi)
        turns = w * unit * L - first
        if turns >= 0.0:
            count += 2 * int(np.sign(np.polyval(slope, x.real))) * (math.floor(turns / (2.0 * math.pi)) + 1)
    return count


def is_stable(model: Model, gains: Gains) -> bool:
    """Whether every pole of the closed loop is in the open left half plane."""
    return unstable_poles(model, gains) == 0


def _scale(D: Reals) -> float:
    """The geometric mean of the poles that are not at the origin, rad/s; 1 if there are none."""
    sizes = np.abs(np.roots(D))
    sizes = sizes[sizes > 0.0]
    return float(np.exp(np.mean(np.log(sizes)))) if len(sizes) else 1.0


def _squared_size(p: Reals) -> Reals:
    """|p(jw)|^2 as a polynomial in w^2, from the highest power down."""
    mirrored = p * (-1.0) ** np.arange(len(p) - 1, -1, -1)
    even = np.polymul(p, mirrored)[::2]
    return np.asarray(even * (-1.0) ** np.arange(len(even) - 1, -1, -1))
