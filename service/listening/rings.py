"""The history of one loop in bounded memory: samples, and bins of them on two levels. Pure."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopwright.service.listening.bins import (
    BIN,
    SAMPLE,
    Bins,
    GainSet,
    Rows,
    between,
    gaps,
    merged,
    of_samples,
    shortest_gap_s,
    thinned,
    with_sets,
)

SAMPLES = 12_000
"""Samples that are kept as they are: 20 min at ten a second."""
LEVELS = ((4.0, 7_200), (32.0, 2_700))
"""Time of a bin, s, and number of bins, for each level: at least 8 h and 24 h."""
MAX_SETS = 64
"""Sets of gains that are remembered."""
_LAST_SET = 0xFFFF


class Ring:
    """The latest rows, in the order in which they were put."""

    def __init__(self, size: int, kind: Any) -> None:
        self._rows = np.zeros(size, kind)
        self._size = size
        self._put = 0

    @property
    def nbytes(self) -> int:
        return int(self._rows.nbytes)

    def __len__(self) -> int:
        return min(self._put, self._size)

    def put(self, row: Any) -> None:
        self._rows[self._put % self._size] = row
        self._put += 1

    def last(self, count: int) -> Bins:
        """Returns a copy of the latest `count` rows, or of all."""
        count = min(count, len(self))
        end = self._put % self._size
        begin = end - count
        if begin >= 0:
            return self._rows[begin:end].copy()
        return np.concatenate([self._rows[begin:], self._rows[:end]])

    @property
    def count(self) -> int:
        """Returns how many rows were ever put."""
        return self._put

    @property
    def first_s(self) -> float:
        """Returns the time of the oldest row, s; infinite where there is none."""
        if not self._put:
            return np.inf
        return float(self._rows["at_s"][self._put % self._size if self._put > self._size else 0])


class Rings:
    """Takes samples in the order of time. A level gets a bin when the next sample is in another one; the newest samples
    are on the levels below only.

    samples, levels: sizes, as SAMPLES and LEVELS.
    """

    def __init__(self, samples: int = SAMPLES, levels: tuple[tuple[float, int], ...] = LEVELS) -> None:
        self._rings = [Ring(samples, SAMPLE), *(Ring(size, BIN) for _, size in levels)]
        self._widths = [width for width, _ in levels]
        self._part = [0] * len(levels)
        self._open = [0] * len(levels)
        """Rows of the ring below that no bin of the level has yet."""
        self._most_open = samples // 2
        self._unsaved = 0
        self._sets: dict[int, GainSet] = {}
        self._latest_set = 0

    @property
    def nbytes(self) -> int:
        return sum(ring.nbytes for ring in self._rings)

    @property
    def oldest_s(self) -> float:
        """Returns the time of the oldest row, s; infinite where there is none."""
        return min(ring.first_s for ring in self._rings)

    @property
    def count(self) -> int:
        """Returns how many samples were ever put."""
        return self._rings[0].count

    def since(self, count: int) -> Bins:
        """Returns the samples that were put after the first `count` ones, as far as they are still kept."""
        return self._rings[0].last(self.count - count)

    def number_of(self, gains: GainSet) -> int:
        """Returns the number under which samples name these gains."""
        if self._sets.get(self._latest_set) != gains:
            self._latest_set = self._latest_set % _LAST_SET + 1
            self._sets[self._latest_set] = gains
            while len(self._sets) > MAX_SETS:
                del self._sets[next(iter(self._sets))]
        return self._latest_set

    def put(self, at_s: float, n: int, pv: float, mv: float, sp: float, gains: int, mode: int, gap: int) -> None:
        """Adds a sample.

        gap: GAP_BEFORE where samples are missing before it, else 0.
        """
        part = int(at_s // self._widths[0])
        if self._open[0] and (part != self._part[0] or self._open[0] >= self._most_open):
            self._close(0, at_s)
        self._part[0] = part
        self._rings[0].put((at_s, n, pv, mv, sp, gains, mode, gap))
        self._open[0] += 1

    def _close(self, level: int, next_s: float) -> None:
        """Makes a bin of the level from the open rows of the ring below.

        next_s: the time of the next sample.
        """
        rows = self._rings[level].last(self._open[level])
        row = merged(of_samples(rows) if level == 0 else rows, [0])[0]
        self._open[level] = 0
        self._rings[level + 1].put(row)
        if level == 0:
            self._unsaved += 1
        above = level + 1
        if above < len(self._widths):
            self._open[above] += 1
            self._part[above] = int(row["at_s"] // self._widths[above])
            if int(next_s // self._widths[above]) != self._part[above]:
                self._close(above, next_s)

    def unsaved(self, all_of_it: bool = False) -> Rows | None:
        """Returns the bins of the first level that were not returned before; None where there are none.

        all_of_it: whether the samples of a bin that is not full yet make one.
        """
        if all_of_it and self._open[0]:
            self._close(0, self._part[0] * self._widths[0])
        if not self._unsaved:
            return None
        bins, sets = with_sets(self._rings[1].last(self._unsaved), self._sets)
        self._unsaved = 0
        return Rows(bins, sets)

    def rows(self, from_s: float, to_s: float, points: int) -> Rows:
        """Returns at most `points` bins of this time, of the finest level that goes back far enough, and the gaps
        that are not shorter than a bin."""
        reaching = [level for level, ring in enumerate(self._rings) if ring.first_s <= from_s]
        oldest = min(range(len(self._rings)), key=lambda level: self._rings[level].first_s)
        every = self._all(reaching[0] if reaching else oldest)
        whole, sets = with_sets(between(every, from_s, to_s), self._sets)
        shortest_s = shortest_gap_s(len(whole), from_s, to_s, points)
        found = tuple(gap for gap in gaps(every, from_s, to_s) if gap[1] - gap[0] >= shortest_s)
        return Rows(thinned(whole, from_s, to_s, points), sets, found)

    def _all(self, level: int) -> Bins:
        """Returns the bins of a level, and after them the rows that only the levels below have."""
        rows = self._rings[level].last(len(self._rings[level]))
        if level == 0:
            return of_samples(rows)
        below = self._rings[level - 1].last(self._open[level - 1])
        parts = [rows, of_samples(below) if level == 1 else below]
        if level > 1:
            newest = self._rings[0].last(self._open[0])
            parts.append(of_samples(newest))
        return np.concatenate(parts)
