"""Skogestad's half rule reduces the number of lags and turns the others into dead time.

The largest lag that is left out is divided: one half is added to the smallest lag that remains, the other half to the
dead time. The smaller lags, and the time constants of zeros in the right half-plane, are added to the dead time. An
integrator counts as the largest lag. Where only the integrator remains, the whole of the largest lag is added to the
dead time, so that the ramp with which the plant answers a step stays where it is.

Source: S. Skogestad, Simple analytic rules for model reduction and PID controller tuning, J. Process Control 13, 2003.
The rule is for real poles. Zeros in the left half-plane are refused here: which lag they cancel is a choice.
"""

from __future__ import annotations

import math
import sys
from typing import Literal

import numpy as np

from loopwright.tuning.models import FOPDT, SOPDT, AnyModel, Complexes, Integrating, Model, TransferFunction, as_model
from loopwright.tuning.reasons import Reason, Refused

REAL, REAL_MAX = 0.01, 0.2
"""A pole p with |Im p|/|p| up to the first is real: the computed roots of a multiple pole form a ring around it. The
ring of n equal lags is as wide as eps^(1/n), so the bound grows from order 7 on, to the second at order 12. The zeta
above which a pair is taken for real lags is 0.99995 up to order 6, 0.999 at order 8 and 0.98 from order 12 on."""


def half_rule(model: AnyModel, order: Literal[1, 2] = 1) -> FOPDT | SOPDT | Integrating:
    """The model reduced to `order` lags, an integrator being one of them; a model with no more lags is returned as it
    is.

    Raises Refused, OUTSIDE_RANGE, for complex or unstable poles and for zeros in the left half-plane.
    """
    model = as_model(model)
    gain, integrates, lags, dead = _parts(model)
    kept = order - 1 if integrates else order
    if len(lags) <= kept and not isinstance(model, TransferFunction):
        return model
    if len(lags) > kept:
        shared = lags[kept]
        dead += (0.5 if kept else 1.0) * shared + sum(lags[kept + 1 :])
        lags = lags[:kept]
        if lags:
            lags[-1] += 0.5 * shared
    if integrates:
        return Integrating(gain, dead, lags[0] if lags else 0.0)
    if len(lags) == 1:
        return FOPDT(gain, lags[0], dead)
    return SOPDT(K=gain, T1=lags[0], T2=lags[1], L=dead)


def exact(model: TransferFunction) -> Model:
    """The same plant as FOPDT, SOPDT or Integrating where it has that form, else the transfer function itself."""
    if len(model.num) > 1 or len(model.den) > 3:
        return model
    a2, a1, a0 = (0.0,) * (3 - len(model.den)) + model.den
    n = model.num[0]
    if a0 == 0.0:
        return Integrating(n / a1, model.L, a2 / a1) if a2 / a1 >= 0.0 else model
    if a2 == 0.0:
        return FOPDT(n / a0, a1 / a0, model.L) if a1 / a0 > 0.0 else model
    if not (a2 / a0 > 0.0 and a1 / a0 > 0.0):
        return model
    T = math.sqrt(a2 / a0)
    return SOPDT(n / a0, T, 0.5 * a1 / a0 / T, model.L)


def _parts(model: Model) -> tuple[float, bool, list[float], float]:
    """The parts of a model: its gain (per s if it integrates), whether it integrates, its lags (s) from the largest
    down, and its dead time (s), to which the time constants of the zeros are added."""
    if isinstance(model, FOPDT):
        return model.K, False, [model.T], model.L
    if isinstance(model, Integrating):
        return model.K, True, [model.T] if model.T > 0.0 else [], model.L
    if isinstance(model, SOPDT):
        if math.isnan(model.T1):
            raise _refused(f"the poles are complex (zeta = {model.zeta:.4g})")
        return model.K, False, [model.T1, model.T2], model.L
    integrates = model.den[-1] == 0.0
    den = np.asarray(model.den[:-1] if integrates else model.den)
    poles = np.roots(den)
    if np.any(poles.real >= 0.0):
        raise _refused("the plant is not stable")
    if np.any(np.abs(poles.imag) > _real(len(poles)) * np.abs(poles)):
        raise _refused("some poles are complex")
    zeros = np.roots(model.num)
    if np.any(zeros.real <= 0.0) or np.any(zeros.imag != 0.0):
        raise _refused("some zeros are complex or in the left half-plane")
    dead = model.L + float(np.sum(1.0 / zeros.real))
    return model.num[-1] / float(den[-1]), integrates, _lags(np.asarray(poles, dtype=np.complex128)), dead


def _real(order: int) -> float:
    """The |Im p|/|p| up to which a pole of a plant of this order is real."""
    return min(max(REAL, 4.0 * math.pow(sys.float_info.epsilon, 1.0 / order)), REAL_MAX)


def _lags(poles: Complexes) -> list[float]:
    """The lags -1/p from the largest down; the computed roots of a multiple pole are replaced by their mean."""
    lags = np.asarray(-1.0 / poles)
    ring = np.zeros(len(lags), dtype=bool)
    # from the top of a ring down: its other roots are at most its diameter away
    for i in sorted(np.flatnonzero(lags.imag > 0.0), key=lambda each: -lags[each].imag / abs(lags[each])):
        near = (np.abs(lags - lags[i]) < 3.0 * max(REAL * np.abs(lags[i]), lags[i].imag)) & ~ring
        if near[i]:
            lags[near] = np.mean(lags[near].real)
            ring |= near
    return sorted((float(x) for x in lags.real), reverse=True)


def _refused(why: str) -> Refused:
    return Refused(
        Reason.OUTSIDE_RANGE,
        f"{why}: the half rule reduces plants with real stable poles and zeros in the right half-plane only",
    )
