"""Whether the columns of MV and PV may be swapped: MV is smooth and PV jumps, which plants do not."""

from __future__ import annotations

import numpy as np

from loopwright.service.offline.csv_record.record import Record
from loopwright.tuning.models import Reals

MIN_RESTING = 0.8
"""Smallest part of the samples at which what was moved by hand or by a relay keeps its value."""
MAX_RESTING = 0.5
"""Largest part of the samples at which what a plant answers keeps its value."""
MIN_JUMP = 0.25
"""Smallest move between two samples that is a jump, as a part of the range."""


def may_be_swapped(record: Record) -> bool:
    """Whether MV moves as a plant answers, and PV as an operator or a relay moves an output."""
    resting_mv, jump_mv = _moves(record.u)
    resting_pv, jump_pv = _moves(record.y)
    pv_is_moved = resting_pv > MIN_RESTING and jump_pv > MIN_JUMP
    return pv_is_moved and resting_mv < MAX_RESTING and jump_mv < MIN_JUMP


def _moves(column: Reals) -> tuple[float, float]:
    """The part of the samples at which a column keeps its value, and its largest move as a part of its range."""
    moves, span = np.abs(np.diff(column)), float(np.ptp(column))
    if not len(moves) or span == 0.0:
        return 1.0, 0.0
    return float(np.mean(moves == 0.0)), float(np.max(moves)) / span
