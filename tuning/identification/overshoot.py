"""FOPDT estimate from the overshoot under a Ziegler-Nichols PI: formulas (2)-(5) of the five-stage procedure.

Source: Stopakevych et al., automatic re-tuning of PI controllers, Problemele Energeticii Regionale. Right to 1.5 % in
L/T for FOPDT plants with 0.08 <= L/T <= 1; on plants of other shapes it serves tuning, not identification.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Estimate:
    """d = L/T.  T, L: s.  k5: gain by formula (5), PV units per MV unit, positive."""

    d: float
    T: float
    L: float
    k5: float


def fopdt_from_overshoot(Kp: float, Ti: float, overshoot_pct: float) -> Estimate:
    """From the PI in use (Ti = Pu/1.2, s) and the overshoot it gave, in percent of the set-point step.

    Below about 74 % overshoot only: there d reaches zero and the formula ends.
    """
    if not (math.isfinite(Kp) and math.isfinite(Ti) and Kp > 0.0 and Ti > 0.0):
        raise ValueError(f"Kp and Ti must be positive: {Kp}, {Ti} s")
    sigma = max(overshoot_pct, 0.0)
    d = (44.67 - 0.6015 * sigma) / (45.35 + sigma)
    if not d > 0.0:
        raise ValueError(f"an overshoot of {overshoot_pct:.1f} % is beyond the formula (74 %)")
    L = Ti / 3.0
    return Estimate(d=d, T=L / d, L=L, k5=0.7865 / (Kp * d))
