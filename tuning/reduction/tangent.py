"""The tangent at the steepest point of a step response gives the L and T of the rules made on the reaction curve."""

from __future__ import annotations

import math

from loopwright.tuning.models import FOPDT, SOPDT
from loopwright.tuning.reasons import Reason, Refused


def tangent(model: SOPDT) -> FOPDT:
    """The FOPDT model of the tangent, which meets zero at L and the final value at L + T.

    With real T1 > T2 the steepest point is at t = T1 T2 ln(T1/T2)/(T1 - T2) after the dead time, T = T1 exp(t/T1), and
    the remaining area, T1 + T2, gives L. Source: I. A. Polishchuk, 2023, its comparison methods. Raises Refused,
    OUTSIDE_RANGE, for complex poles, whose step response is not S-shaped.
    """
    T1, T2 = model.T1, model.T2
    if math.isnan(T1):
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"the poles are complex (zeta = {model.zeta:.4g}): a rule made on the reaction curve needs zeta >= 1",
        )
    x = T1 / T2 - 1.0
    # ln(1 + x)/x by log1p: it goes to 1 smoothly as the lags become equal
    t = T1 * (math.log1p(x) / x if x > 0.0 else 1.0)
    T = T1 * math.exp(t / T1)
    return FOPDT(model.K, T, model.L + t + T1 + T2 - T)
