"""Tests of the residual of a fit: whether it is white noise, and by how much slow noise inflates a variance."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc  # scipy.stats takes 0.4 s to import

from loopwright.tuning.models import Reals


def whiteness(residual: Reals, searched: int) -> float:
    """The p-value of the test of Ljung and Box (1978) on the autocorrelation of the residual.

    residual: shape (N,).
    searched: the number of searched parameters, which reduces the degrees of freedom.
    """
    n = len(residual)
    lags = max(searched + 3, min(20, n // 5))
    r = residual - residual.mean()
    power = float(r @ r)
    if power == 0.0:
        return 1.0
    correlations = np.array([float(r[k:] @ r[:-k]) for k in range(1, lags + 1)]) / power
    q = n * (n + 2.0) * float(np.sum(correlations**2 / (n - np.arange(1.0, lags + 1.0))))
    return float(chdtrc(lags - searched, q))


def variance_inflation(residual: Reals) -> float:
    """The variance inflation of slow averages of the residual, against white noise of the same variance; at least 1.

    The inflation is (1 + r)/(1 - r) = 4/d - 1, with the correlation r of neighbours and the Durbin-Watson statistic d;
    it is exact for first-order autoregressive noise.
    """
    variance = float(np.mean(residual**2))
    fast = 0.5 * float(np.mean(np.diff(residual) ** 2))
    return max(1.0, 2.0 * variance / fast - 1.0) if fast > 0.0 else 1.0
