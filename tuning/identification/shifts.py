"""Sums of products of columns with responses that are shifted by whole samples: all shifts of many plants at once."""

from __future__ import annotations

import numpy as np
from scipy.fft import next_fast_len

from loopwright.tuning.models import Reals

SAMPLES_TOGETHER = 2**15
"""Number of samples of the responses of many plants that are evaluated at once: the cache of a processor holds them."""


def shifted_products(fixed: Reals, shifted: Reals) -> Reals:
    """The sums over k of fixed[q, k]*shifted[i, k-m] for m = 0 ... N-1 for each plant, by one convolution: shape
    (plants, rows of fixed, rows of shifted, N).

    fixed, shifted: shape (plants, rows, N), that of one plant for all where there is only one.
    """
    length = fixed.shape[-1]
    size = next_fast_len(2 * length, real=True)
    spectrum = np.fft.rfft(fixed, size)[:, :, None] * np.fft.rfft(shifted, size).conj()[:, None]
    return np.asarray(np.fft.irfft(spectrum, size)[..., :length])


def products_within(rows: Reals) -> Reals:
    """The sums of rows[i, k]*rows[j, k] over the first 1, 2, ... N samples for each plant, shape (plants, rows, rows,
    N): what is shifted beyond the end does not count.

    rows: shape (plants, rows, N).
    """
    return np.asarray(np.cumsum(rows[:, :, None] * rows[:, None], axis=-1))
