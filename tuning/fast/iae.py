"""The IAE after a unit set-point step and a unit load disturbance is computed from one impulse response of the loop.

The plant behind a zero-order hold is exact for any dead time. The continuous controller is discretised at the step of
the simulation, and the mean delay of that step, half a step, is subtracted from the dead time. With z^-1 as variable
and F the filter of the derivative,

    C = Kp*((1 + z^-1)/2*h/Ti + 1 - z^-1 + N*(1 - z^-1)^2/F) / (1 - z^-1),   F = 1 - exp(-h*N/Td)*z^-1

the error after a set-point step (derivative on PV alone) and PV after a load disturbance are the impulse responses of
(A*F + z^-m*B*Cd)/D and z^-m*B*F/D, where D = A*F*(1 - z^-1) + z^-m*B*(...): the step cancels the integrator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.analysis.recursion import recursive
from loopwright.tuning.analysis.zero_order_hold import pulses
from loopwright.tuning.models import Model, Reals

STEPS_PER_PERIOD = 80
PERIODS, INTEGRAL_TIMES = 20.0, 15.0
MAX_STEPS = 40_000
_DIFFERENCE = np.array([1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Cost:
    """The two IAE of one loop.

    setpoint: the IAE after a unit set-point step, s.
    load: the IAE after a unit load disturbance at the plant's input, PV units * s per MV unit.
    """

    setpoint: float
    load: float


class LoopCost:
    """The IAE of loops on one model of positive gain. period: the ultimate period of that model, s."""

    def __init__(self, model: Model, period: float) -> None:
        self.h = h = period / STEPS_PER_PERIOD
        self.period = period
        den = np.asarray(model.den) / model.den[0]
        order = len(den) - 1
        num = np.concatenate((np.zeros(order + 1 - len(model.num)), model.num)) / model.den[0]
        direct, num = float(num[0]), num - num[0] * den
        in_steps = den * h ** np.arange(order + 1.0)
        pulse = pulses(in_steps[None, 1:], [max(model.L / h - 0.5, 0.0)], order)
        recursion = pulse.recursion[0]
        # the i-th state is s^i/den with s counted in steps
        weights = num[:0:-1] * h ** (order - np.arange(order))
        B = pulse.forward[0] @ weights
        if direct:
            B = np.append(B, 0.0)[: order + 2] + direct * np.concatenate(([0.0], recursion))
        self._A, self._B = recursion, np.concatenate((np.zeros(int(pulse.delay[0])), B))

    def __call__(self, Kp: float, Ti: float, Td: float, N: float) -> Cost:
        """The cost of these gains; the loop must be stable. Ti, Td: s. N: the derivative filter is Td/N."""
        h = self.h
        filtered = np.array([1.0, -math.exp(-h * N / Td)]) if Td > 0.0 else np.ones(1)
        proportional = np.array([1.0 + 0.5 * h / Ti, -1.0 + 0.5 * h / Ti])
        derived = N * np.array([1.0, -2.0, 1.0]) if Td > 0.0 else np.zeros(1)
        forward = Kp * _sum(np.convolve(proportional, filtered), derived)
        AF = np.convolve(self._A, filtered)
        D = _sum(np.convolve(AF, _DIFFERENCE), np.convolve(self._B, forward))
        steps = min(MAX_STEPS, int((PERIODS * self.period + INTEGRAL_TIMES * Ti) / h))
        pulse = np.zeros(steps)
        pulse[0] = 1.0
        common = recursive(D, pulse)
        BF = np.convolve(self._B, filtered)
        error = AF
        if Td > 0.0:
            error = _sum(AF, Kp * N * np.convolve(self._B, _DIFFERENCE))
        return Cost(self._integral(error, common), self._integral(BF, common))

    def _integral(self, forward: Reals, common: Reals) -> float:
        return self.h * float(np.abs(np.convolve(forward, common)[: len(common)]).sum())


def _sum(a: Reals, b: Reals) -> Reals:
    """The sum of two polynomials in 1/z."""
    if len(a) < len(b):
        a, b = b, a
    total = a.copy()
    total[: len(b)] += b
    return total
