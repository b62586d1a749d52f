"""The IAE after a unit set-point step and a unit load disturbance is computed from one impulse response of the loop.

The plant behind a zero-order hold is exact for any dead time. The continuous controller is discretised at the step of
the simulation, and the mean delay of that step, half a step, is subtracted from the dead time. With z^-1 as variable
and F the filter of the derivative,

    C = Kp*((1 + z^-1)/2*h/Ti + 1 - z^-1 + N*(1 - z^-1)^2/F) / (1 - z^-1),   F = 1 - exp(-h*N/Td)*z^-1

the error after a set-point step (b = 1, derivative on PV alone) and PV after a load disturbance are the impulse
responses of (A*F + z^-m*B*Cd)/D and z^-m*B*F/D, where D = A*F*(1 - z^-1) + z^-m*B*(...): the step cancels the
integrator.

The set-point acts through b*Kp as a load disturbance of that size would, so the error after a set-point step is

    e_b = e_1 + (1 - b)*Kp*y_load

for every set-point weight b, from the same two responses. Its IAE is convex in b and piecewise linear, so the best b is
a weighted median (`LoopResponses.best_weight`).
Sources: M. Araki, H. Taguchi, Two-degree-of-freedom PID controllers, Int. J. Control, Automation, and Systems 1(4),
2003, for the weights; P. Bloomfield, W. L. Steiger, Least Absolute Deviations, 1983, for the weighted median.
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
NEGLIGIBLE = 1e-9
"""Size of the error and of Kp*y_load, as a fraction of a set-point step, that counts as zero."""
ENOUGH = 2500
"""Number of times from which the best set-point weight is found; of a longer response, which ends in a slow tail, every
second, third .. time is taken."""
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

    def __call__(self, Kp: float, Ti: float, Td: float, N: float, b: float = 1.0) -> Cost:
        """The cost of these gains; the loop must be stable. Ti, Td: s. N: the derivative filter is Td/N."""
        return self.responses(Kp, Ti, Td, N).cost(b)

    def responses(self, Kp: float, Ti: float, Td: float, N: float) -> LoopResponses:
        """The responses of the loop with these gains, which must be stable, see `__call__`."""
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
        after_step, after_load = np.convolve(error, common)[:steps], np.convolve(BF, common)[:steps]
        # what has died away no longer counts, and its denormal numbers are slow to compute with
        left = np.flatnonzero((np.abs(after_step) > NEGLIGIBLE) | (np.abs(after_load) > NEGLIGIBLE / Kp))
        end = int(left[-1]) + 1 if len(left) else 1
        return LoopResponses(h, Kp, after_step[:end], after_load[:end], Ti, Td, N)


@dataclass(frozen=True, slots=True, eq=False)
class LoopResponses:
    """The two step responses of one loop, from which those for every set-point weight b follow.

    h: the step of the simulation, s.
    Kp: the gain, MV units per PV unit.
    error: the error after a unit set-point step with b = 1, shape (samples,).
    load: PV after a unit load disturbance at the plant's input, PV units per MV unit, shape (samples,).
    Ti, Td, N: the times of the controller, s, and the filter Td/N of its derivative.
    """

    h: float
    Kp: float
    error: Reals
    load: Reals
    Ti: float = math.inf
    Td: float = 0.0
    N: float = 10.0

    def cost(self, b: float) -> Cost:
        """The two IAE for this set-point weight."""
        error = self.error if b == 1.0 else self.error + (1.0 - b) * self.Kp * self.load
        return Cost(self.h * float(np.abs(error).sum()), self.h * float(np.abs(self.load).sum()))

    def best_weight(self, low: float, high: float, overshoot: float | None = None) -> float | None:
        """The set-point weight from low to high with the least IAE after a set-point step.

        overshoot: the largest permitted overshoot as a fraction of the step, None for no bound; the weights that keep
        it form one interval, because the overshoot is convex in b too.
        Returns None where no weight from low to high keeps the overshoot.
        """
        room = self.overshoot_room(low, high, overshoot)
        return None if room is None else self.weight_within(*room)

    def overshoot_room(self, low: float, high: float, overshoot: float | None) -> tuple[float, float] | None:
        """The smallest and the largest x = 1 - b, for b from low to high, that keep the overshoot, see `best_weight`;
        None where none does."""
        minimum, maximum = 1.0 - high, 1.0 - low
        if overshoot is not None:
            by = self.Kp * self.load  # the error moves by this for each unit that b is below one
            room = self.error + overshoot  # room + x*by >= 0 at every time
            up, down = by > NEGLIGIBLE, by < -NEGLIGIBLE
            if float(room[~(up | down)].min(initial=0.0)) < 0.0:
                return None
            minimum = max(minimum, float((-room[up] / by[up]).max(initial=-math.inf)))
            maximum = min(maximum, float((-room[down] / by[down]).min(initial=math.inf)))
            if minimum > maximum:
                return None
        return minimum, maximum

    def weight_within(self, minimum: float, maximum: float) -> float:
        """The set-point weight b with the least IAE after a set-point step, for 1 - b from minimum to maximum."""
        every = slice(None, None, 1 + len(self.load) // ENOUGH)
        return 1.0 - _minimise_absolutes(self.error[every], self.Kp * self.load[every], minimum, maximum)


def _minimise_absolutes(y: Reals, by: Reals, low: float, high: float) -> float:
    """The x from low to high that minimises sum(|y + x*by|): the weighted median of -y/by, moved into the interval."""
    for end, upwards in ((low, 1.0), (high, -1.0)):
        left = y + end * by
        if upwards * float((by * np.sign(left)).sum()) + float(np.abs(by[left == 0.0]).sum()) >= 0.0:
            return end  # the sum does not fall towards the inside
    there = np.abs(by) > NEGLIGIBLE
    at, weight = -y[there] / by[there], np.abs(by[there])
    order = np.argsort(at)
    summed = np.cumsum(weight[order])
    return min(max(float(at[order[np.searchsorted(summed, 0.5 * summed[-1])]]), low), high)


def _sum(a: Reals, b: Reals) -> Reals:
    """The sum of two polynomials in 1/z."""
    if len(a) < len(b):
        a, b = b, a
    total = a.copy()
    total[: len(b)] += b
    return total
