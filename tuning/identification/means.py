"""Means of PV and MV over equal numbers of samples, such that the plant cannot tell them from samples.

PV and MV are averaged alike. A mean of PV over a bin is the mean at the bin's end of what PV was during the bin's
length. Between the ends of two bins the running mean of MV moves from one value to the other, so half the sum of both
is held meanwhile, and the dead time of the plant stays what it is. Held from its bin on, a mean of MV would come half a
bin late, and the dead time be found half a bin too short.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.models import Reals


def means_alike(
    edges: NDArray[np.int64], pv: NDArray[np.floating], mv: NDArray[np.floating], together: int
) -> tuple[Reals, Reals, Reals]:
    """PV, the MV that is held with it, and the ends of the bins, in samples: one bin end more than there are means of
    MV before half the sum of two is taken.

    edges: the number of samples before each row of PV and MV, and after the last one.
    pv, mv: the means of each row, by interpolation of whose running sums the means of the bins are found. PV of a
    sample is measured as MV begins to be held: its running sum is read half a sample later, so that both are means over
    the same time.
    together: the number of samples of a bin.
    """
    ends: Reals = np.arange(0.0, float(edges[-1]) + 1.0, together)
    of_pv, of_mv = _means(edges, pv, ends + 0.5), _means(edges, mv, ends)
    return of_pv[:-1], 0.5 * (of_mv[1:] + of_mv[:-1]), ends


def _means(edges: NDArray[np.int64], means: NDArray[np.floating], at: Reals) -> Reals:
    """The means between the times `at` of what has these means between the edges; times in samples."""
    whole = np.append(0.0, np.cumsum(means * np.diff(edges).astype(np.float64)))
    return np.asarray(np.diff(np.interp(at, edges, whole)) / np.diff(at))
