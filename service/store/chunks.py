"""Samples as compressed blocks: columns t - t0, sp, pv, mv, mode as little-endian float32, one after another, zlib.

float32 holds what the bus carries (REAL32). Time is kept as an offset from the block's first sample, whose time the
row holds as a double: absolute times of a long job would not fit a float32.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from tuning.plan import Sample

_COLUMNS = 5


def pack(samples: Sequence[Sample]) -> bytes:
    """The block of a non-empty list of samples."""
    columns = np.array(samples, dtype=np.float64).T
    columns[0] -= columns[0, 0]
    return zlib.compress(columns.astype("<f4").tobytes(), 1)


def unpack(data: bytes, count: int, first_t_s: float) -> list[Sample]:
    """The samples of a block."""
    columns = np.frombuffer(zlib.decompress(data), dtype="<f4").reshape(_COLUMNS, count).astype(np.float64)
    # A multiple of Ts such as 0.1 s is shown as it was counted, not with float32's tail.
    times = np.round(columns[0] + first_t_s, 6)
    values = [_shortest(row) for row in columns[1:4]]
    return [
        Sample(t, sp, pv, mv, int(mode))
        for t, sp, pv, mv, mode in zip(times.tolist(), *values, columns[4].tolist(), strict=True)
    ]


def _shortest(row: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[float]:
    """Seven significant digits are all a float32 has."""
    return [float(f"{value:.7g}") for value in row.tolist()]
