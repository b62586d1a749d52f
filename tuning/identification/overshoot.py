"""The FOPDT estimate from the overshoot under a Ziegler-Nichols PI: formulas (2)-(5) of the five-stage procedure.

Source: Stopakevych et al., automatic re-tuning of PI controllers, Problemele Energeticii Regionale. The estimate of L/T
is right to 1.5 % for FOPDT plants with 0.08 <= L/T <= 1; on other plants it serves tuning, not identification.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Estimate:
    """A FOPDT estimate.

    d: the normalised dead time L/T.
    T, L: the time constant and the dead time, s.
    k5: the gain by formula (5), PV units per MV unit, positive.
    """

    d: float
    T: float
    L: float
    k5: float


def fopdt_from_overshoot(Kp: float, Ti: float, overshoot_pct: float) -> Estimate:
    """The FOPDT estimate from a set-point step under a Ziegler-Nichols PI.

    Kp, Ti: the PI in use, MV units per PV unit and s; Ti = Pu/1.2.
    overshoot_pct: the overshoot, percent of the set-point step; it must be below about 74 %, where d reaches zero.
    Raises ValueError for gains that are not positive and for an overshoot beyond the formula.
    """
    if not (math.isfinite(Kp) and math.isfinite(Ti) and Kp > 0.0 and Ti > 0.0):
        raise ValueError(f"Kp and Ti must be positive: {Kp}, {Ti} s")
    sigma = max(overshoot_pct, 0.0)
    d = (44.67 - 0.6015 * sigma) / (45.35 + sigma)
    if not d > 0.0:
        raise ValueError(f"an overshoot of {overshoot_pct:.1f} % is beyond the formula (74 %)")
    L = Ti / 3.0
    return Estimate(d=d, T=L / d, L=L, k5=0.7865 / (Kp * d))
