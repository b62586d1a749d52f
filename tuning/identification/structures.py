"""The model structures that can be fitted to a record, with their searched and their linear parameters.

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
    """A structure (b_z s^z + ... + b_0) * exp(-L*s) / den(s).

    The denominator den is monic with `lags` searched coefficients, times s if the plant integrates; that of three lags
    is (s^2 + a1 s + a0)(s + p). The b and g are linear parameters. The searched ones are theta = (logarithms of the
    searched coefficients, highest power first, p last; L); time is in samples.

    name: the name of the structure.
    lags: the number of lags, 0 to 3.
    integrating: True for a pole at the origin.
    zeros: the number of zeros z.
    feed_through: True for a part g*exp(-L*s) of the transfer function, by which PV jumps with MV.
    """

    name: str
    lags: int
    integrating: bool = False
    zeros: int = 0
    feed_through: bool = False

    @property
    def order(self) -> int:
        """The degree of the denominator."""
        return self.lags + self.integrating

    @property
    def searched(self) -> int:
        """The number of searched parameters, the length of theta."""
        return self.lags + 1

    @property
    def inputs(self) -> int:
        """The number of linear coefficients that belong to the plant's input."""
        return self.zeros + 1 + self.feed_through

    def monic(self, theta: Reals) -> Reals:
        """The denominator of each theta without its leading 1, highest power first, shape (..., order)."""
        searched = np.exp(theta[..., : self.lags])
        if self.lags == 3:
            a1, a0, p = np.moveaxis(searched, -1, 0)
            return np.stack((a1 + p, a0 + a1 * p, a0 * p), axis=-1)
        if self.integrating:
            return np.concatenate((searched, np.zeros((*searched.shape[:-1], 1))), axis=-1)
        return np.asarray(searched)

    def slowest(self, theta: Reals) -> float:
        """The last coefficient of the denominator that is not 0."""
        return float(np.append(1.0, self.monic(theta[: self.searched]))[self.lags])

    @property
    def lags_only(self) -> bool:
        """Whether the structure has lags and a dead time only, at most second order, so that `plant` has a form for
        it."""
        return not (self.zeros or self.feed_through) and self.order <= 2

    def plant(self, theta: Reals, b0: float, Ts: float) -> Plant:
        """The model of these parameters with time in s.

        b0: the numerator, PV units per MV unit and sample^order.
        Ts: the sample time, s.
        """
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
