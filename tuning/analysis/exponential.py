"""The matrix exponential of many small matrices at once."""

from __future__ import annotations

import math

import numpy as np

from loopwright.tuning.models import Reals

_EACH = 3
_COEFFICIENTS = np.array(
    [[1.0 / math.factorial(_EACH * j + i) if i < _EACH or j == 3 else 0.0 for i in range(_EACH + 1)] for j in range(4)]
)
"""The coefficients of Taylor's series to the degree 12; row j belongs to the power 3*j of the matrix, column i to its
power i."""


def exponentials(matrices: Reals) -> Reals:
    """Returns exp of each matrix, shape (p, n, n): Taylor's series of the matrix halved often enough, squared back.

    The series is summed with five products of matrices (M. S. Paterson, L. J. Stockmeyer, SIAM J. Comput. 2, 1973).
    scipy.linalg.expm takes the matrices one by one (28 times as long for a hundred of them), and solves with threads,
    which on a busy machine made one matrix take 1.4 ms instead of 0.05 ms.
    """
    size = float(np.abs(matrices).sum(axis=2).max(initial=0.0))
    halvings = max(0, math.ceil(math.log2(4.0 * size))) if size > 0.0 else 0
    powers = np.empty((_EACH + 1, *matrices.shape))
    powers[0] = np.eye(matrices.shape[1])
    np.multiply(matrices, 0.5**halvings, out=powers[1])
    for i in range(2, _EACH + 1):
        np.matmul(powers[i - 1], powers[1], out=powers[i])
    # below a quarter the term of degree 13 is under 1e-17
    sums = (_COEFFICIENTS @ powers.reshape(_EACH + 1, -1)).reshape(powers.shape)
    found = sums[-1]
    for k in range(len(sums) - 2, -1, -1):
        found = found @ powers[_EACH] + sums[k]
    for _ in range(halvings):
        found = found @ found
    return np.asarray(found)
