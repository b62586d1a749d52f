"""The frequency response of a model, or of a loop, as the curves of Bode and Nyquist, with exact dead time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from loopwright.tuning.analysis.margins import frequency_grid
from loopwright.tuning.analysis.stability import open_loop
from loopwright.tuning.gains import AnyGains, as_gains
from loopwright.tuning.models import AnyModel, Reals, as_model
from loopwright.tuning.reasons import Reason, Refused


class Bode(NamedTuple):
    """A frequency response as magnitude and phase; the names, units and order are those of `control.bode`.

    magnitude: the gain, a ratio, shape (N,).
    phase: the phase, rad, shape (N,), not wrapped: a dead time lets it fall on and on. At low frequency it is between
    -pi (not included) and pi.
    omega: the frequencies, rad/s, shape (N,).
    """

    magnitude: Reals
    phase: Reals
    omega: Reals


class Nyquist(NamedTuple):
    """A frequency response as a curve in the complex plane, for positive frequencies.

    real, imag: the two parts, shape (N,).
    omega: the frequencies, rad/s, shape (N,).
    """

    real: Reals
    imag: Reals
    omega: Reals


def bode(model: AnyModel, gains: AnyGains | None = None, omega: ArrayLike | None = None) -> Bode:
    """The magnitude and phase of a model, or of the open loop of a model with these gains.

    gains: the gains, or a result that has some; None for the model alone. A loop has the sign of negative feedback, as
    in `margins`.
    omega: the frequencies, rad/s, positive; by default those that `margins` looks at.
    Raises Refused, BAD_INPUT: gains as in `margins`, or frequencies that are none. Raises TypeError as `as_model`,
    `as_gains`.
    """
    num, den, L, w = _parts(model, gains, omega)
    s = 1j * w
    phase, start = np.zeros(len(w)), 0.0
    # a sum over zeros and poles needs no unwrapping, however far apart the frequencies are
    for sign, roots in ((1.0, np.roots(num)), (-1.0, np.roots(den))):
        for root in roots:
            phase += sign * np.angle(s - root)
            start += sign * (0.5 * math.pi if root == 0.0 else float(np.angle(-root)))
    quarters = round(start / (0.5 * math.pi)) + (2 if num[0] * den[0] < 0.0 else 0)
    principal = 2 - (2 - quarters) % 4
    phase += 0.5 * math.pi * (principal - round(start / (0.5 * math.pi)))
    return Bode(np.abs(np.polyval(num, s) / np.polyval(den, s)), phase - L * w, w)


def nyquist(model: AnyModel, gains: AnyGains | None = None, omega: ArrayLike | None = None) -> Nyquist:
    """The curve of a model, or of the open loop of a model with these gains; arguments and errors as of `bode`."""
    num, den, L, w = _parts(model, gains, omega)
    s = 1j * w
    curve = np.polyval(num, s) / np.polyval(den, s) * np.exp(-L * s)
    return Nyquist(np.asarray(curve.real), np.asarray(curve.imag), w)


def _parts(model: AnyModel, gains: AnyGains | None, omega: ArrayLike | None) -> tuple[Reals, Reals, float, Reals]:
    """Numerator, denominator, dead time (s) and frequencies (rad/s)."""
    plant = as_model(model)
    if gains is None:
        num, den = np.asarray(plant.num, dtype=float), np.asarray(plant.den, dtype=float)
    else:
        num, den = open_loop(plant, as_gains(gains))
    if omega is None:
        return num, den, plant.L, frequency_grid(plant, num, den)
    try:
        w = np.atleast_1d(np.asarray(omega, dtype=float))
    except (TypeError, ValueError):
        w = np.empty((0, 0))
    if w.ndim != 1 or not np.all(np.isfinite(w) & (w > 0.0)):
        raise Refused(Reason.BAD_INPUT, "omega must be frequencies in rad/s, finite numbers above 0")
    return num, den, plant.L, w
