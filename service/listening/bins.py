"""Rows of the history of a loop: bins of consecutive samples with the extremes and means of PV and MV. Pure.

A sample is a bin of one. Times are wall time, seconds since 1970 UTC. What is not known is NaN, in `mode` UNKNOWN_MODE,
and in `gains` 0; `gains` otherwise counts the sets of gains that come with the rows, from 1. A bin knows set-point,
mode and gains only where all its samples do, and then has those of the last sample.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bins = NDArray[np.void]
GainSet = tuple[float, ...]
"""Kp, Ti, Td, Tf, b, c, in ISA form."""

UNKNOWN_MODE = -1
GAP_BEFORE, GAP_INSIDE = 1, 2
"""Flags of a bin: samples are missing before its first one, or between two of its own."""
BIN = np.dtype(
    [
        ("at_s", "<f8"), ("until_s", "<f8"), ("n", "<u4"), ("count", "<u4"),
        ("pv_min", "<f4"), ("pv_max", "<f4"), ("pv_mean", "<f4"),
        ("mv_min", "<f4"), ("mv_max", "<f4"), ("mv_mean", "<f4"),
        ("sp", "<f4"), ("gains", "<u2"), ("mode", "i1"), ("gap", "u1"),
    ]
)  # fmt: skip
"""at_s, until_s: times of the first and the last sample. n: number of the first sample on the bus."""
SAMPLE = np.dtype(
    [
        ("at_s", "<f8"), ("n", "<u4"), ("pv", "<f4"), ("mv", "<f4"), ("sp", "<f4"), ("gains", "<u2"), ("mode", "i1"),
        ("gap", "u1"),
    ]
)  # fmt: skip


def of_samples(samples: Bins) -> Bins:
    """Returns each sample as a bin of its own."""
    bins = np.empty(len(samples), BIN)
    bins["count"] = 1
    bins["until_s"] = samples["at_s"]
    for name in ("at_s", "n", "sp", "gains", "mode", "gap"):
        bins[name] = samples[name]
    for signal in ("pv", "mv"):
        for kind in ("min", "max", "mean"):
            bins[f"{signal}_{kind}"] = samples[signal]
    return bins


def merged(bins: Bins, starts: Sequence[int] | NDArray[np.intp]) -> Bins:
    """Returns a bin for each stretch of bins; a stretch ends where the next one starts, and the first starts at 0."""
    starts = np.asarray(starts, dtype=np.intp)
    result = bins[starts].copy()
    ends = np.append(starts[1:], len(bins)) - 1
    last = bins[ends]
    result["until_s"] = last["until_s"]
    counts = bins["count"].astype(np.float64)
    result["count"] = np.add.reduceat(bins["count"], starts)
    for signal in ("pv", "mv"):
        result[f"{signal}_min"] = np.fmin.reduceat(bins[f"{signal}_min"], starts)
        result[f"{signal}_max"] = np.fmax.reduceat(bins[f"{signal}_max"], starts)
        sums = np.add.reduceat(bins[f"{signal}_mean"] * counts, starts)
        result[f"{signal}_mean"] = sums / result["count"]
    result["sp"] = np.where(np.logical_or.reduceat(np.isnan(bins["sp"]), starts), np.float32(np.nan), last["sp"])
    result["mode"] = np.where(np.minimum.reduceat(bins["mode"], starts) < 0, UNKNOWN_MODE, last["mode"])
    result["gains"] = np.where(np.minimum.reduceat(bins["gains"], starts) == 0, 0, last["gains"])
    inside = bins["gap"].copy()
    inside[starts] &= GAP_INSIDE  # a gap before the first bin of a stretch stays before it
    within = np.bitwise_or.reduceat(inside, starts) != 0
    result["gap"] = (bins["gap"][starts] & GAP_BEFORE) | np.where(within, GAP_INSIDE, 0)
    return result


def between(bins: Bins, from_s: float, to_s: float) -> Bins:
    """Returns the bins that have samples in this time."""
    return bins[(bins["until_s"] >= from_s) & (bins["at_s"] <= to_s)]


def thinned(bins: Bins, from_s: float, to_s: float, points: int) -> Bins:
    """Returns at most `points` bins: those of equal parts of this time, where there are more."""
    if len(bins) <= points:
        return bins
    part = np.clip((bins["at_s"] - from_s) * (points / (to_s - from_s)), 0, points - 1).astype(np.int64)
    return merged(bins, np.flatnonzero(np.diff(part, prepend=-1)))


def shortest_gap_s(count: int, from_s: float, to_s: float, points: int) -> float:
    """Returns how long a gap has to be to be told beside so many bins, s: they are thinned to `points`, and shorter
    ones are told by the flag of a bin alone."""
    return (to_s - from_s) / points if count > points else 0.0


def gaps(bins: Bins, from_s: float, to_s: float) -> tuple[tuple[float, float], ...]:
    """Returns the times in which samples are missing, as far as they touch this time: from the last sample before to
    the first one after; minus infinity for a gap before the first bin. Of a gap inside a bin it is only known that it
    lies in the bin's time."""
    found: list[tuple[float, float]] = []
    for n in np.flatnonzero(bins["gap"]).tolist():
        at_s, until_s, gap = (bins[name][n].item() for name in ("at_s", "until_s", "gap"))
        found += [(bins["until_s"][n - 1].item() if n else -math.inf, at_s)] if gap & GAP_BEFORE else []
        found += [(at_s, until_s)] if gap & GAP_INSIDE else []
    return tuple((begin, end) for begin, end in found if end >= from_s and begin <= to_s)


@dataclass(frozen=True)
class Rows:
    """Bins with the sets of gains that they count, and the gaps between their samples."""

    bins: Bins = field(default_factory=lambda: np.empty(0, BIN))
    sets: tuple[GainSet, ...] = ()
    gaps: tuple[tuple[float, float], ...] = ()


def with_sets(bins: Bins, known: dict[int, GainSet]) -> tuple[Bins, tuple[GainSet, ...]]:
    """Returns the bins with their gains counted anew, and the sets that occur, each once; a set that is no longer
    known is 0."""
    bins = bins.copy()
    sets: dict[GainSet, int] = {}
    numbers = np.unique(bins["gains"])
    new = [sets.setdefault(known[n], len(sets) + 1) if n in known else 0 for n in numbers.tolist()]
    bins["gains"] = np.asarray(new, dtype=np.uint16)[np.searchsorted(numbers, bins["gains"])] if len(bins) else 0
    return bins, tuple(sets)


def joined(parts: Sequence[Rows]) -> Rows:
    """Returns the rows of all parts, which follow each other in time."""
    known: dict[int, GainSet] = {}
    bins = []
    for part in parts:
        offset = len(known)
        known |= {offset + n: each for n, each in enumerate(part.sets, 1)}
        shifted = part.bins.copy()
        shifted["gains"] += np.where(shifted["gains"] > 0, offset, 0).astype(np.uint16)
        bins.append(shifted)
    whole, sets = with_sets(np.concatenate([np.empty(0, BIN), *bins]), known)
    return Rows(whole, sets, tuple(gap for part in parts for gap in part.gaps))


def decimals(bins: Bins, name: str) -> list[float | None]:
    """Returns the shortest decimals that are these float32, as the samples of a job have them; None for no number."""
    values: list[float] = bins[name].astype(str).astype(np.float64).tolist()
    return [value if math.isfinite(value) else None for value in values]


def packed(rows: Rows) -> bytes:
    """Returns bins and sets as a compressed block: column by column, then the sets, zlib."""
    columns: list[Any] = [np.ascontiguousarray(rows.bins[name]).tobytes() for name in BIN.names or ()]
    sets = np.asarray(rows.sets, dtype="<f8").tobytes()
    return zlib.compress(b"".join([*columns, sets]), 1)


def unpacked(data: bytes, count: int) -> Rows:
    """Returns the rows of a block of this number of bins, without their gaps."""
    raw = zlib.decompress(data)
    bins, at = np.empty(count, BIN), 0
    for name in BIN.names or ():
        kind = BIN[name]
        bins[name] = np.frombuffer(raw, kind, count, at)
        at += count * kind.itemsize
    sets = np.frombuffer(raw, "<f8", offset=at).reshape(-1, 6)
    return Rows(bins, tuple(tuple(each) for each in sets.tolist()))
