"""The states of a linear plant under an input that is held between the samples, exact for any dead time.

Time is counted in samples. With a dead time L = m + f (m whole, 0 <= f < 1) the plant sees u[k-m-1] for the first f of
a sample and u[k-m] for the rest of it, so in controllable form x' = A x + e_n u(t - L):

    x[k+1] = Phi(1) x[k] + G0 u[k-m] + G1 u[k-m-1]
    G0 = integral of Phi*e_n over 1-f,   G1 = Phi(1-f) * integral of Phi*e_n over f

The states are then sums over one short recursion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from loopwright.tuning.analysis.exponential import exponentials
from loopwright.tuning.analysis.recursion import recursive
from loopwright.tuning.models import Reals


@dataclass(frozen=True, slots=True, eq=False)
class Pulses:
    """The pulse transfer functions z^-delay * forward(z)/recursion(z) from the held input to each state, of several
    plants, in powers of 1/z.

    forward: the numerators, shape (plants, order + 2, states).
    recursion: the denominators, shape (plants, order + 1).
    delay: the delays in whole samples, shape (plants,).
    """

    forward: Reals
    recursion: Reals
    delay: NDArray[np.int64]

    def of(self, which: slice) -> Pulses:
        """The pulse transfer functions of some of the plants."""
        return Pulses(self.forward[which], self.recursion[which], self.delay[which])

    def summed(self, weights: Reals) -> Pulses:
        """The pulse transfer functions to weighted sums of the first states.

        weights: shape (plants, first states, sums).
        """
        return Pulses(self.forward[:, :, : weights.shape[1]] @ weights, self.recursion, self.delay)

    def drive(self, u: Reals, count: int | None = None) -> Reals:
        """The first `count` states under u, 0 before the first sample, shape (plants, *u.shape, states).

        u: shape (N,), or (records, N) for several records, each with a start of its own.
        """
        forward = np.ascontiguousarray(self.forward[:, :0:-1, :count])  # a held input never acts at its own sample
        forward = forward.reshape(len(forward), *(1,) * (u.ndim - 1), *forward.shape[1:])
        taps, samples = forward.shape[-2], u.shape[-1]
        # one recursion for all states of a plant; what tells them apart is a short sum over its last values
        common = np.zeros((len(forward), *u.shape[:-1], samples + taps - 1))
        for row, recursion, delay in zip(common, self.recursion, self.delay.tolist(), strict=True):
            if (length := samples - 1 - delay) > 0:
                row[..., row.shape[-1] - length :] = recursive(recursion, u[..., :length])
        # row n is common[n : n + taps], without a copy
        strides = (*common.strides, common.strides[-1])
        windows = as_strided(common, (*common.shape[:-1], samples, taps), strides, writeable=False)
        return np.asarray(windows @ forward)


def states(monic: Reals, L: float, u: Reals, count: int) -> Reals:
    """The first `count` states s^i/den(s)*exp(-L*s)*u, i = 0, 1, ..., as columns, shape (len(u), count).

    monic: den without its leading 1, highest power first, time in samples.  L: dead time in samples, >= 0.
    u: shape (N,), held from its sample to the next, 0 before the first. The states are 0 before it.
    """
    return np.asarray(pulses(monic[None, :], [L], count).drive(u)[0])


def pulses(monics: Reals, dead_times: Sequence[float] | Reals, count: int) -> Pulses:
    """The pulse transfer functions of the first `count` states for each denominator (a row of `monics`) and its dead
    time, see `states`."""
    many, order = monics.shape
    L = np.asarray(dead_times, dtype=float)
    whole = np.floor(L)
    part = (L - whole)[:, None, None]
    block = np.zeros((many, order + 1, order + 1))
    block[:, : order - 1, 1:order] = np.eye(order - 1)
    block[:, order - 1, :order] = -monics[:, ::-1]
    block[:, order - 1, order] = 1.0
    both = exponentials(np.concatenate((block * (1.0 - part), block * part)))
    late, early = both[:many], both[many:]
    phi = late[:, :order, :order] @ early[:, :order, :order]
    g0 = late[:, :order, order:]
    g1 = late[:, :order, :order] @ early[:, :order, order:]

    recursion = _characteristic(phi) if order > 3 else _short_characteristic(phi, np.exp(-monics[:, 0]))
    answers = np.empty((many, order + 2, order))
    answers[:, 0], answers[:, 1], answers[:, 2] = 0.0, g0[:, :, 0], (phi @ g0 + g1)[:, :, 0]
    for k in range(3, order + 2):
        answers[:, k] = (phi @ answers[:, k - 1, :, None])[:, :, 0]
    answers = answers[:, :, :count]
    forward = answers.copy()
    for k in range(1, order + 1):
        forward[:, k:] += recursion[:, k, None, None] * answers[:, : order + 2 - k]
    return Pulses(forward, recursion, whole.astype(np.int64))


def _characteristic(phi: Reals) -> Reals:
    """The coefficients of det(z*I - phi) of each matrix, highest power first, by the method of Faddeev and
    LeVerrier."""
    many, order = phi.shape[:2]
    found = np.ones((many, order + 1))
    one = np.eye(order)
    carried = np.broadcast_to(one, phi.shape)
    for k in range(1, order + 1):
        product = phi @ carried
        found[:, k] = -product.trace(axis1=1, axis2=2) / k
        carried = product + found[:, k, None, None] * one
    return found


def _short_characteristic(phi: Reals, det: Reals) -> Reals:
    """As `_characteristic` of order 1 to 3, in a third of the time: det has the determinants, shape (matrices,), which
    are exp(-sum of the rates) by Liouville's formula."""
    many, order = phi.shape[:2]
    found = np.ones((many, order + 1))
    if order > 1:
        trace = np.einsum("bii->b", phi)
        found[:, 1] = -trace
        if order > 2:
            found[:, 2] = 0.5 * (trace**2 - np.einsum("bij,bji->b", phi, phi))
    found[:, order] = (-1.0) ** order * det
    return found
