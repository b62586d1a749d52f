"""A test whether a record shows the controller instead of the plant, because MV follows from PV alone."""

from __future__ import annotations

import numpy as np

from loopwright.tuning.models import Reals

MAX_LEFT_BY_PV = 0.1
"""Largest residual of MV's moves, predicted from their own past and three values of PV, as a fraction of the residual
of a prediction from their own past alone; a larger residual is no feedback."""
MIN_LEFT_BY_OWN_PAST = 1e-3
"""Smallest residual of a prediction from MV's own past, as a fraction of the rms of MV's moves; a ramp or a sine leaves
less, and the test cannot decide."""
MIN_VALUES = 0.1
"""Smallest number of different values of MV per sample; a relay or a series of steps has fewer."""


def follows_from_pv(u: Reals, y: Reals) -> bool:
    """Whether MV follows from PV alone, as under a PI or PID whose set-point rests.

    u, y: MV and PV, shape (N,); PV must not be constant.
    A prediction of MV's moves from PV leaves nothing of a PI or PID whose set-point rests. It leaves nearly everything
    of a step, a relay or a set-point change that acts on MV at once.
    """
    moves = np.diff(u)
    if len(np.unique(u)) < MIN_VALUES * len(u) or not np.any(moves[2:]):
        return False
    moves /= np.max(np.abs(moves))
    centred = (y - y.mean()) / np.ptp(y)
    own = np.column_stack((np.ones(len(moves) - 2), moves[1:-1], moves[:-2]))
    of_pv = np.column_stack((own, centred[3:], centred[2:-1], centred[1:-2]))
    alone, with_pv = (_left(columns, moves[2:]) for columns in (own, of_pv))
    return alone > MIN_LEFT_BY_OWN_PAST * float(np.sqrt(np.mean(moves[2:] ** 2))) and with_pv < MAX_LEFT_BY_PV * alone


def _left(columns: Reals, wanted: Reals) -> float:
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.sqrt(np.mean((wanted - columns @ found) ** 2)))
