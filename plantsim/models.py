"""Exact discretisation of a rational transfer function with dead time behind a zero-order hold.

With a dead time L = q*Ts + f*Ts (q whole, 0 <= f < 1) the input that reaches the plant within one sampling period is
u[n-q-1] for the first f*Ts and u[n-q] for the rest, so

    x[n+1] = A x[n] + B1 u[n-q-1] + B0 u[n-q]
    y[n+1] = C x[n+1] + D u[n-q]

The output is the value just before the sampling instant, so it cannot depend on the controller's answer to that sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm, matrix_balance

Matrix = npt.NDArray[Any]

# A dead time this close (in samples) to a whole number of samples is rounded: 0.3 / 0.1 is not exactly 3 in binary.
_WHOLE = 1e-9


@dataclass(frozen=True, slots=True)
class Sampled:
    """The matrices of the equations at the top of this module; `delay` is q, the whole samples of dead time."""

    A: Matrix
    B1: Matrix
    B0: Matrix
    C: Matrix
    D: float
    delay: int


def state_space(num: Sequence[float], den: Sequence[float]) -> tuple[Matrix, Matrix, Matrix, float]:
    """Returns the balanced controllable form A, B, C, D of num(s)/den(s), coefficients from the highest power down.

    Raises ValueError.
    """
    if not all(math.isfinite(c) for c in (*num, *den)):
        raise ValueError("coefficients of a transfer function must be finite")
    top = np.trim_zeros(np.asarray(num, dtype=float), "f")
    bottom = np.trim_zeros(np.asarray(den, dtype=float), "f")
    if bottom.size == 0:
        raise ValueError("the denominator of a transfer function must not be zero")
    if top.size > bottom.size:
        raise ValueError("a plant must be proper: the numerator's degree exceeds the denominator's")
    order = bottom.size - 1
    monic = bottom / bottom[0]
    padded = np.concatenate((np.zeros(bottom.size - top.size), top)) / bottom[0]
    D = float(padded[0])
    A: Matrix = np.zeros((order, order))
    B: Matrix = np.zeros(order)
    if order:
        A[0] = -monic[1:]
        A[1:, :-1] = np.eye(order - 1)
        B[0] = 1.0
    C = padded[1:] - D * monic[1:]
    if order:
        # Slow and fast poles together make companion matrices badly scaled; balancing costs nothing here.
        A, T = matrix_balance(A, permute=False)
        B = np.linalg.solve(T, B)
        C = C @ T
    return A, B, C, D


def held(A: Matrix, B: Matrix, duration: float) -> tuple[Matrix, Matrix]:
    """Returns the state transition over `duration` s and its response to a constant unit input; A may be singular."""
    order = len(B)
    block = np.zeros((order + 1, order + 1))
    block[:order, :order] = A
    block[:order, order] = B
    step = np.asarray(expm(block * duration), dtype=float)
    return step[:order, :order], step[:order, order]


def split_dead_time(dead_time_s: float, sample_time_s: float) -> tuple[int, float]:
    """Splits a dead time into whole samples and a rest in s. Raises ValueError."""
    if not (dead_time_s >= 0 and math.isfinite(dead_time_s)):
        raise ValueError("dead time must be finite and not negative")
    if not (sample_time_s > 0 and math.isfinite(sample_time_s)):
        raise ValueError("sample time must be finite and positive")
    samples = dead_time_s / sample_time_s
    whole = math.floor(samples + _WHOLE)
    rest = samples - whole
    return whole, rest * sample_time_s if rest > _WHOLE else 0.0


def sampled(num: Sequence[float], den: Sequence[float], dead_time_s: float, sample_time_s: float) -> Sampled:
    """Returns the zero-order-hold equivalent of num(s)/den(s) * exp(-s*dead_time_s), exact also for a fraction of a
    sample.

    Raises ValueError.
    """
    whole, rest = split_dead_time(dead_time_s, sample_time_s)
    A, B, C, D = state_space(num, den)
    after, B0 = held(A, B, sample_time_s - rest)
    before, early = held(A, B, rest)
    return Sampled(A=after @ before, B1=after @ early, B0=B0, C=C, D=D, delay=whole)
