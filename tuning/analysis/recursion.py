"""A linear recursion, run by scipy's compiled filter.

scipy.signal is imported when a recursion is first run: this import takes as long as all other imports of the command
line together, and most commands run no recursion.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from loopwright.tuning.models import Reals


def recursive(recursion: Reals, u: Reals) -> Reals:
    """The solution y of recursion[0] y[n] + recursion[1] y[n-1] + ... = u[n], at rest before n = 0; u, y: shape
    (N,)."""
    from scipy.signal import lfilter

    return np.asarray(lfilter(np.ones(1), recursion, u))
