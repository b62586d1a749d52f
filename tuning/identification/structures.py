"""Model structures that can be fitted to a record: what is searched for, and what follows from it linearly.

A structure is stable by construction: the coefficients of its denominator are searched as logarithms, which covers two
real poles, a double pole and a complex pair without a distinction of cases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Reals

Plant = FOPDT | SOPDT | Integrating


@dataclass(frozen=True, slots=True)
class Structure:
    """(b_z s^z + ... + b_0) * exp(-L*s) / den(s), den monic with `lags` searched coefficients, times s if integrating.

    Three lags are (s^2 + a1 s + a0)(s + p). feed_through: a part g*exp(-L*s) of MV is in PV at once. The b and g are
    linear, theta = (logs of the searched coefficients, highest power first, p last; L) is not; time in samples.
    """

    name: str
    lags: int
    integrating: bool = False
    zeros: int = 0
    feed_through: bool = False

    @property
    def order(self) -> int:
        return self.lags + self.integrating

    @property
    def searched(self) -> int:
        """How many numbers theta has."""
        return self.lags + 1

    @property
    def inputs(self) -> int:
        """How many linear coefficients belong to the plant's input."""
        return self.zeros + 1 + self.feed_through

    def monic(self, theta: Reals) -> Reals:
        """The denominator without its leading 1, highest power first; of each theta, shape (..., order)."""
        searched = np.exp(theta[..., : self.lags])
        if self.lags == 3:
            a1, a0, p = np.moveaxis(searched, -1, 0)
            return np.stack((a1 + p, a0 + a1 * p, a0 * p), axis=-1)
        if self.integrating:
            return np.concatenate((searched, np.zeros((*searched.shape[:-1], 1))), axis=-1)
        return np.asarray(searched)

    def slowest(self, theta: Reals) -> float:
        """The denominator's last coefficient other than 0."""
        return float(np.append(1.0, self.monic(theta[: self.searched]))[self.lags])

    @property
    def lags_only(self) -> bool:
        """Lags and a dead time, nothing more: what `plant` has a form for."""
        return not (self.zeros or self.feed_through) and self.order <= 2

    def plant(self, theta: Reals, b0: float, Ts: float) -> Plant:
        """The model of these parameters, time in s again; b0 in PV units per MV unit (and sample^order)."""
        L = max(float(theta[self.lags]), 0.0) * Ts
        if self.integrating:
            if not self.lags:
                return Integrating(b0 / Ts, L)
            a = math.exp(theta[0])
            return Integrating(b0 / a / Ts, L, Ts / a)
        if self.lags == 1:
            a = math.exp(theta[0])
            return FOPDT(b0 / a, Ts / a, L)
        a1, a0 = math.exp(theta[0]), math.exp(theta[1])
        return SOPDT(b0 / a0, Ts / math.sqrt(a0), 0.5 * a1 / math.sqrt(a0), L)


FIRST = Structure("fopdt", 1)
SECOND = Structure("sopdt", 2)
INTEGRATOR = Structure("integrating", 0, integrating=True)
LAGGED_INTEGRATOR = Structure("integrating with lag", 1, integrating=True)
INTEGRATOR_WITH_ZERO = Structure("integrating with lag and zero", 1, integrating=True, zeros=1)
SECOND_WITH_ZERO = Structure("sopdt with zero", 2, zeros=1)
FIRST_WITH_FEED_THROUGH = Structure("fopdt with feed-through", 1, feed_through=True)
SECOND_WITH_FEED_THROUGH = Structure("sopdt with zero and feed-through", 2, zeros=1, feed_through=True)
THIRD = Structure("third order", 3)
THIRD_WITH_ZERO = Structure("third order with zero", 3, zeros=1)
THIRD_WITH_ZEROS = Structure("third order with two zeros", 3, zeros=2)
