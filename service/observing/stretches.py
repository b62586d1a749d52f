"""From rows of the history to evenly sampled stretches of normal operation. Pure.

A stretch ends where samples are missing, the loop is not in automatic, set-point or gains are not known, other gains
take effect, or a test of this service begins.

Bins are brought to means of equal numbers of samples first: see `tuning.identification.means`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.protocol.profile import Mode
from loopwright.service.listening.bins import GAP_BEFORE, GAP_INSIDE, Bins, Rows
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.means import means_alike
from loopwright.tuning.models import Reals
from loopwright.tuning.operation.history import Stretch

NUMBERS = 0xFFFFFFFF
"""The numbers of samples on the bus begin again at 1 after so many."""


@dataclass(frozen=True, slots=True, eq=False)
class HeardStretch:
    """A stretch with the wall time of each of its samples, seconds since 1970 UTC."""

    stretch: Stretch
    at_s: Reals


def heard_stretches(
    rows: Rows, sample_time_s: float, together: int = 1, tests: Sequence[tuple[float, float]] = ()
) -> list[HeardStretch]:
    """The stretches of normal operation of at least two samples, oldest first.

    sample_time_s: the sample time of the controller, s of plant time.
    together: the number of samples that become one of a stretch; rows of twice as many are left out.
    tests: wall times between which the loop was under test.
    """
    bins = rows.bins
    usable = _usable(bins, together, tests)
    begins = np.flatnonzero(usable & (_apart(bins) | ~np.append(False, usable)[:-1]))
    ends = np.append(begins, len(bins))[1:]
    found = []
    for begin, end in zip(begins, ends, strict=True):
        of_part = bins[begin:end][usable[begin:end]]
        gains = Gains(*rows.sets[int(of_part["gains"][0]) - 1])
        if together == 1:
            stretch, at_s = _of_samples(of_part, sample_time_s, gains), of_part["at_s"].astype(np.float64)
        else:
            stretch, at_s = _of_bins(of_part, sample_time_s, together, gains)
        if len(stretch.sp) > 1:
            found.append(HeardStretch(stretch, at_s))
    return found


def _usable(bins: Bins, together: int, tests: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    usable = (bins["mode"] == Mode.AUTOMATIC) & (bins["gains"] > 0) & (bins["count"] < 2 * together)
    usable &= (bins["gap"] & GAP_INSIDE) == 0
    for name in ("sp", "pv_mean", "mv_mean"):
        usable &= np.isfinite(bins[name])
    for begin, end in tests:
        usable &= (bins["until_s"] < begin) | (bins["at_s"] > end)
    return np.asarray(usable, dtype=np.bool_)


def _apart(bins: Bins) -> NDArray[np.bool_]:
    """Whether something is between a row and the one before: missing samples, or other gains."""
    missing = (np.diff(bins["n"].astype(np.int64)) - bins["count"][:-1]) % NUMBERS
    apart = (missing != 0) | (bins["gains"][1:] != bins["gains"][:-1])
    found = np.append(True, apart)[: len(bins)] | ((bins["gap"] & GAP_BEFORE) != 0)
    return np.asarray(found, dtype=np.bool_)


def _of_samples(bins: Bins, Ts: float, gains: Gains) -> Stretch:
    mv, pv, sp = (_decimals(bins[name]) for name in ("mv_mean", "pv_mean", "sp"))
    return Stretch(float(bins["at_s"][0]), Ts, mv, pv, sp, gains)


def _of_bins(bins: Bins, Ts: float, together: int, gains: Gains) -> tuple[Stretch, Reals]:
    """The stretch of means, and its wall times."""
    edges = np.append(0, np.cumsum(bins["count"].astype(np.int64)))
    pv, mv, ends = means_alike(edges, bins["pv_mean"], bins["mv_mean"], together)
    at_s = np.interp(ends, edges, np.append(bins["at_s"], bins["until_s"][-1]))
    sp = _decimals(bins["sp"])[np.searchsorted(edges, ends[1:], side="left") - 1]
    return Stretch(float(at_s[0]), together * Ts, mv, pv, sp[1:], gains, held_s=Ts), at_s[1:-1]


def _decimals(values: NDArray[np.float32]) -> Reals:
    """The shortest decimals that are these float32, so that equal set-points stay equal and steps of PV even."""
    return np.asarray(values.astype(str).astype(np.float64))
