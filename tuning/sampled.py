"""What the states of a linear plant do under an input that is held between the samples, exact for any dead time.

Time is counted in samples. With a dead time L = m + f (m whole, 0 <= f < 1) the plant sees u[k-m-1] for the first f of
a sample and u[k-m] for the rest of it, so in controllable form x' = A x + e_n u(t - L):

    x[k+1] = Phi(1) x[k] + G0 u[k-m] + G1 u[k-m-1]
    G0 = integral of Phi*e_n over 1-f,   G1 = Phi(1-f) * integral of Phi*e_n over f

The states are then sums over one short recursion, run by scipy's compiled filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tuning.models import Reals

_ONE = np.ones(1)


@dataclass(frozen=True, slots=True)
class Pulse:
    """z^-delay * forward(z)/recursion(z), from the held input to each state, in powers of 1/z.

    forward: shape (order + 2, states).  recursion: shape (order + 1,).  delay: whole samples.
    """

    forward: Reals
    recursion: Reals
    delay: int

    def first(self, count: int) -> Pulse:
        """Of the first so many states alone."""
        return Pulse(self.forward[:, :count], self.recursion, self.delay)

    def drive(self, u: Reals) -> Reals:
        """The states under u, 0 before the first sample, as columns, shape (len(u), states)."""
        taps, count = self.forward.shape
        out = np.zeros((len(u), count))
        if self.delay < len(u):
            length = len(u) - self.delay
            # one recursion for all states; what tells them apart is a short sum over its last values
            common = lfilter(_ONE, self.recursion, u[:length])
            last = np.zeros((length, taps - 1))
            for k in range(1, taps):
                last[k:, k - 1] = common[:-k]
            out[self.delay :] = last @ self.forward[1:]
        return out


def states(monic: Reals, L: float, u: Reals, count: int) -> Reals:
    """The first `count` states s^i/den(s)*exp(-L*s)*u, i = 0, 1, ..., as columns, shape (len(u), count).

    monic: den without its leading 1, highest power first, time in samples.  L: dead time in samples, >= 0.
    u: shape (N,), held from its sample to the next, 0 before the first. The states are 0 before it.
    """
    return pulses(monic[None, :], [L], count)[0].drive(u)


def pulses(monics: Reals, dead_times: Sequence[float] | Reals, count: int) -> list[Pulse]:
    """How the first `count` states answer, for each denominator (rows of `monics`) and its dead time, see `states`."""
    many, order = monics.shape
    L = np.asarray(dead_times, dtype=float)
    whole = np.floor(L)
    part = (L - whole)[:, None, None]
    block = np.zeros((many, order + 1, order + 1))
    block[:, : order - 1, 1:order] = np.eye(order - 1)
    block[:, order - 1, :order] = -monics[:, ::-1]
    block[:, order - 1, order] = 1.0
    both = _exponential(np.concatenate((block * (1.0 - part), block * part)))
    late, early = both[:many], both[many:]
    phi = late[:, :order, :order] @ early[:, :order, :order]
    g0 = late[:, :order, order:]
    g1 = late[:, :order, :order] @ early[:, :order, order:]

    recursion = _characteristic(phi)
    answers = np.empty((order + 2, many, order, 1))
    answers[0], answers[1], answers[2] = 0.0, g0, phi @ g0 + g1
    for k in range(3, order + 2):
        answers[k] = phi @ answers[k - 1]
    answers = answers[:, :, :count, 0]
    forward = np.zeros_like(answers)
    for k in range(order + 1):
        forward[k:] += recursion[:, k, None] * answers[: order + 2 - k]
    return [Pulse(forward[:, b], recursion[b], int(whole[b])) for b in range(many)]


def _characteristic(phi: Reals) -> Reals:
    """Coefficients of det(z*I - phi) of each matrix, highest power first (Faddeev and LeVerrier)."""
    many, order = phi.shape[:2]
    found = np.ones((many, order + 1))
    one = np.eye(order)
    carried = np.broadcast_to(one, phi.shape)
    for k in range(1, order + 1):
        product = phi @ carried
        found[:, k] = -np.trace(product, axis1=1, axis2=2) / k
        carried = product + found[:, k, None, None] * one
    return found


def _exponential(matrices: Reals) -> Reals:
    """exp of each small matrix, shape (n, k, k): Taylor's series of the matrix halved often enough, squared back.

    scipy's is no slower on an idle machine, but solves with threads, which on a busy one took 1.4 ms against 0.05 ms.
    """
    size = float(np.abs(matrices).sum(axis=2).max())
    halvings = max(0, math.ceil(math.log2(4.0 * size))) if size > 0.0 else 0
    small = matrices * 0.5**halvings
    one = np.eye(matrices.shape[1])
    # below a quarter the term of degree 13 is under 1e-17
    found = one + small / 12.0
    for k in range(11, 0, -1):
        found = one + small @ found / k
    for _ in range(halvings):
        found = found @ found
    return np.asarray(found)
