"""What is left of a record after a fit: is it noise?"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc  # scipy.stats takes 0.4 s to import

from loopwright.tuning.models import Reals


def whiteness(residual: Reals, searched: int) -> float:
    """p-value of the Ljung-Box test (1978) on the residual's autocorrelation."""
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
    """By how much the noise varies more in slow averages than white noise of its variance would; at least 1.

    (1 + r)/(1 - r) with the correlation r of neighbours: exact for first-order autoregressive noise.
    """
    variance = float(np.mean(residual**2))
    fast = 0.5 * float(np.mean(np.diff(residual) ** 2))
    return max(1.0, 2.0 * variance / fast - 1.0) if fast > 0.0 else 1.0
