"""What the states of a linear plant do under an input that is held between the samples, exact for any dead time.

Time is counted in samples. With a dead time L = m + f (m whole, 0 <= f < 1) the plant sees u[k-m-1] for the first f of
a sample and u[k-m] for the rest of it, so in controllable form x' = A x + e_n u(t - L):

    x[k+1] = Phi(1) x[k] + G0 u[k-m] + G1 u[k-m-1]
    G0 = integral of Phi*e_n over 1-f,   G1 = Phi(1-f) * integral of Phi*e_n over f

Each state is then a short recursion, run by scipy's compiled filter.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from tuning.models import Reals


def states(monic: Reals, L: float, u: Reals, count: int) -> Reals:
    """The first `count` states s^i/den(s)*exp(-L*s)*u, i = 0, 1, ..., as columns, shape (len(u), count).

    monic: den without its leading 1, highest power first, time in samples.  L: dead time in samples, >= 0.
    u: shape (N,), held from its sample to the next, 0 before the first. The states are 0 before it.
    """
    order = len(monic)
    m = math.floor(L)
    f = L - m
    block = np.zeros((order + 1, order + 1))
    block[: order - 1, 1:order] = np.eye(order - 1)
    block[order - 1, :order] = -monic[::-1]
    block[order - 1, order] = 1.0
    late, early = _exponential(np.stack((block * (1.0 - f), block * f)))
    phi = late[:order, :order] @ early[:order, :order]
    g0, g1 = late[:order, order], late[:order, :order] @ early[:order, order]

    recursion = _characteristic(phi)
    pulses = np.empty((order + 2, order))
    pulses[0], pulses[1], pulses[2] = 0.0, g0, phi @ g0 + g1
    for k in range(3, order + 2):
        pulses[k] = phi @ pulses[k - 1]
    out = np.zeros((len(u), count))
    if m >= len(u):
        return out
    driven = u[: len(u) - m]
    for i in range(count):
        forward = np.convolve(recursion, pulses[:, i])[: order + 2]
        out[m:, i] = lfilter(forward, recursion, driven)
    return out


def _characteristic(phi: Reals) -> Reals:
    """Coefficients of det(z*I - phi), highest power first (Faddeev and LeVerrier)."""
    order = len(phi)
    found = np.ones(order + 1)
    carried = np.eye(order)
    for k in range(1, order + 1):
        product = phi @ carried
        found[k] = -np.trace(product) / k
        carried = product + found[k] * np.eye(order)
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
