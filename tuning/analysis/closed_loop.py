"""A closed loop in state space, and its response to a unit step, with exact dead time.

Plant and controller without the dead time are one linear system. Its input, the measured PV, comes back a dead time
later: PV over the next dead time follows from PV over the last one (method of steps). The system is discretised exactly
for an input that is linear between the steps. A dead time is a whole number of steps, so every jump and kink of the
response falls between two blocks, where it causes no error. A loop without dead time is discretised exactly as a whole.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import toeplitz

from loopwright.tuning.analysis.exponential import exponentials
from loopwright.tuning.analysis.stability import open_loop
from loopwright.tuning.analysis.state_space import StateSpace, canonical_form
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals, monic, sign, time_constants

SMALL_BLOCK = 100
"""Number of states of a block up to which all blocks come from powers of one matrix instead of one convolution each."""


class ClosedLoop:
    """The loop as x' = a x + b*y(measured), PV before the dead time = c x + d*y(measured).

    The last state is the unit step itself, which is constant. load: True for a load disturbance, False for a set-point
    step. Raises Refused as `open_loop`.
    """

    def __init__(self, model: Model, gains: Gains, load: bool) -> None:
        g = gains
        open_loop(model, g)  # refuses what is no loop
        plant = _plant(model)
        A, B, C, D = plant.a, plant.b, plant.c, plant.d
        n = len(B)
        filtered = g.Td > 0.0 and g.Tf > 0.0
        order = n + 3
        integral, lag, one = n, n + 1, n + 2
        setpoint, extra = (0.0, 1.0) if load else (1.0, 0.0)
        kd = g.Kp * g.Td / g.Tf if filtered else 0.0
        # u = by_state x + by_y y(measured)
        by_state, by_y = np.zeros(order), -g.Kp - kd
        by_state[integral], by_state[lag] = 1.0, -kd
        by_state[one] = (g.Kp * g.b + kd * g.c) * setpoint
        into = by_state.copy()
        into[one] += extra
        self.a, self.b = np.zeros((order, order)), np.zeros(order)
        self.a[:n, :n] = A
        self.a[:n] += np.outer(B, into)
        self.b[:n] = B * by_y
        self.c, self.d = np.zeros(order), D * by_y
        self.c[:n] = C
        self.c += D * into
        if g.Ti > 0.0:
            self.a[integral, one], self.b[integral] = g.Kp / g.Ti * setpoint, -g.Kp / g.Ti
        if filtered:
            self.a[lag, lag], self.a[lag, one], self.b[lag] = -1.0 / g.Tf, g.c * setpoint / g.Tf, -1.0 / g.Tf
        elif g.Td > 0.0:
            # the plant's state less B*k*(c*r - y) has no derivative in its equation (D = 0: see open_loop)
            k, moved = g.Kp * g.Td, A @ B
            self.a[:n, one] += moved * k * g.c * setpoint
            self.b[:n] -= moved * k
            self.c[one] += float(C @ B) * k * g.c * setpoint
            self.d -= float(C @ B) * k

    def immediate(self, steps: int, dt: float) -> Reals:
        """PV of a loop without dead time: one block of steps + 1 samples, shape (1, steps + 1). dt: s."""
        closed = self.c / (1.0 - self.d)
        (advance,) = exponentials((self.a + np.outer(self.b, closed))[None] * dt)
        start = np.zeros(len(self.b))
        start[-1] = 1.0
        return np.asarray(closed @ _powers(advance, start, steps + 1))[None, :]

    def delayed(self, steps: int, delay: int, dt: float) -> Reals:
        """PV of a loop with dead time in blocks of one dead time, shape (blocks, delay + 1).

        Both ends of a block belong to it. delay: the dead time, in steps. dt: s.
        """
        order = len(self.b)
        augmented = np.zeros((order + 2, order + 2))
        augmented[:order, :order] = self.a * dt
        augmented[:order, order] = self.b * dt
        augmented[order, order + 1] = 1.0
        (full,) = exponentials(augmented[None])
        a = full[:order, :order]
        b1 = full[:order, order + 1]
        b0 = full[:order, order] - b1
        # what the input at one sample has done k steps later
        spread0, spread1 = _powers(a, b0, delay), _powers(a, b1, delay + 1)
        free = _powers(a.T, self.c, delay + 1).T
        kernel = self.c @ spread1
        begun = kernel.copy()
        kernel[0] += self.d
        kernel[1:] += self.c @ spread0
        # the state at the block's end
        ends = np.zeros((order, delay + 1))
        ends[:, :-1] += spread0[:, ::-1]
        ends[:, 1:] += spread1[:, delay - 1 :: -1] if delay > 1 else spread1[:, :1]
        whole = np.linalg.matrix_power(a, delay)
        blocks = math.ceil(steps / delay)
        state = np.zeros(order)
        state[-1] = 1.0
        if delay + 1 + order <= SMALL_BLOCK:
            driven = toeplitz(kernel, np.zeros(delay + 1))
            driven[:, 0] -= begun
            advance = np.block([[driven, free], [ends, whole]])
            return np.ascontiguousarray(_powers(advance, np.append(np.zeros(delay + 1), state), blocks)[: delay + 1].T)
        y = np.zeros((blocks, delay + 1))
        length = next_fast_len(2 * delay + 1, real=True)
        spectrum = np.fft.rfft(kernel, length)
        for k in range(1, blocks):
            last = y[k - 1]
            driven = np.fft.irfft(np.fft.rfft(last, length) * spectrum, length)[: delay + 1]
            y[k] = free @ state + driven - begun * last[0]
            state = whole @ state + ends @ last
        return y


def _plant(model: Model) -> StateSpace:
    """Returns the state space of the model without dead time and with positive gain, balanced in units of its mean lag;
    time in s."""
    num, den = monic(model)
    lags = time_constants(model)
    unit = float(np.exp(np.mean(np.log(lags)))) if len(lags) else 1.0
    scale = unit ** np.arange(len(den))
    scaled = canonical_form(num * sign(model) * scale, den * scale)
    return StateSpace(scaled.a / unit, scaled.b / unit, scaled.c, scaled.d)


def _powers(a: Reals, x: Reals, count: int) -> Reals:
    """The vectors x, a x, a^2 x, ... as columns, shape (len(x), count), computed by doubling."""
    found = np.empty((len(x), count))
    found[:, 0] = x
    done = 1
    while done < count:
        more = min(done, count - done)
        found[:, done : done + more] = a @ found[:, :more]
        done += more
        a = a @ a
    return found
