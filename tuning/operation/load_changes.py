"""Where a load moves PV while the set-point rests."""

from __future__ import annotations

import numpy as np

from loopwright.tuning.identification.output_error import averaged
from loopwright.tuning.operation.history import Stretch

ROWS_PER_PERIOD = 8
"""Means of PV in an ultimate period."""
REST_PERIODS = 2.0
"""Ultimate periods at rest before a load."""
SETTLED_PERIODS = 8.0
"""Ultimate periods after a move of the set-point in which PV may move because of it."""
MIN_NOISES = 8.0
"""Smallest deviation of two means of PV in a row from rest, in standard deviations of their noise."""
BEGAN_EARLIER = 2
"""Means before the first one that deviates in which the load may have begun."""


def load_changes(stretch: Stretch, period_s: float) -> list[int]:
    """The samples at which loads begin to move PV, each at least SETTLED_PERIODS after the one before, and after the
    last move of the set-point.

    period_s: the ultimate period, s.
    """
    block = max(1, round(period_s / stretch.Ts / ROWS_PER_PERIOD))
    pv = averaged(np.asarray(stretch.pv, dtype=np.float64), block)
    moves = np.array(stretch.moves, dtype=np.int64) // block
    rest, settled = round(REST_PERIODS * ROWS_PER_PERIOD), round(SETTLED_PERIODS * ROWS_PER_PERIOD)
    found: list[int] = []
    if len(pv) <= rest + 1:
        return found
    noise = float(np.median(np.abs(np.diff(pv)))) / (0.6745 * np.sqrt(2.0))
    last = -settled
    for row in range(rest, len(pv) - 1):
        before = moves[moves <= row]
        if row < last + settled or (len(before) and row < before[-1] + settled + rest):
            continue
        level = float(np.mean(pv[row - rest : row]))
        away = pv[row : row + 2] - level
        rested = float(np.ptp(pv[row - rest : row])) < MIN_NOISES * noise
        if rested and float(np.min(np.abs(away))) > MIN_NOISES * noise and away[0] * away[1] > 0.0:
            found.append(max(row - BEGAN_EARLIER, 0) * block)
            last = row
    return found
