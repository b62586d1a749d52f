"""Samples as compressed blocks: columns t - t0, sp, pv, mv, mode as little-endian float32, one after another, zlib.

float32 holds what the bus carries (REAL32). Time is kept as an offset from the block's first sample, whose time the
row holds as a double: absolute times of a long job would not fit a float32.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.plan import Sample

COLUMNS = ("t_s", "sp", "pv", "mv", "mode")


@dataclass(frozen=True, slots=True)
class Block:
    """A block as it is stored: samples of one stage."""

    stage: str
    first_t_s: float
    count: int
    data: bytes

    def texts(self, column: str) -> list[str]:
        """The decimals of a column: of each value as many digits as it has, of a float32 nine at most. What is no
        number is "nan", "inf" or "-inf"."""
        row = self._row(column)
        if column == "mode":
            return [str(value) for value in row.astype(np.int64).tolist()]
        if column == "t_s":
            return [repr(value) for value in self._times(row).tolist()]
        # Set-point and MV stay the same for long, and a transmitter has its steps: each value is written once.
        distinct, places = np.unique(row.view("<i4"), return_inverse=True)
        texts: list[str] = distinct.view("<f4").astype(str)[places].tolist()
        return texts

    def values(self, column: str) -> NDArray[np.float64]:
        """The same as numbers."""
        row = self._row(column)
        return self._times(row) if column == "t_s" else _decimal(row)

    def _row(self, column: str) -> NDArray[np.float32]:
        at = COLUMNS.index(column)
        raw = zlib.decompress(self.data)
        return np.frombuffer(raw, dtype="<f4", count=self.count, offset=4 * self.count * at)

    def _times(self, offsets: NDArray[np.float32]) -> NDArray[np.float64]:
        # A multiple of Ts such as 0.1 s is shown as it was counted, not with the tail of a sum.
        times: NDArray[np.float64] = np.round(_decimal(offsets) + self.first_t_s, 6)
        return times


def pack(samples: Sequence[Sample]) -> bytes:
    """The block of a non-empty list of samples."""
    columns = np.array(samples, dtype=np.float64).T
    columns[0] -= columns[0, 0]
    return zlib.compress(columns.astype("<f4").tobytes(), 1)


def unpack(block: Block) -> list[Sample]:
    """The samples of a block."""
    t, sp, pv, mv, mode = (block.values(column).tolist() for column in COLUMNS)
    return [Sample(*each[:4], int(each[4])) for each in zip(t, sp, pv, mv, mode, strict=True)]


def _decimal(row: NDArray[np.float32]) -> NDArray[np.float64]:
    """The shortest decimals that are these float32, as doubles: 0.05 and not 0.05000000074505806."""
    decimal: NDArray[np.float64] = row.astype(str).astype(np.float64)
    return decimal
