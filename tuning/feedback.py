"""Whether a record shows the controller rather than the plant: MV follows from PV, and nothing else moves it."""

from __future__ import annotations

import numpy as np

from tuning.models import Reals

LEFT = 0.1
"""Of MV's moves, rms, at most, by a law of the present and the two PV before."""
OWN = 1e-3
"""Of MV's moves, rms: less is left of a ramp or a sine by what MV itself did before."""
VALUES = 0.1
"""Different ones of MV, in samples: a relay or a series of steps has fewer."""


def follows_from_pv(u: Reals, y: Reals) -> bool:
    """u, y: MV and PV, shape (N,). Of a PI or PID at rest in its set-point nothing is left; of a step, a relay or a
    set-point that acts on MV at once, nearly all."""
    if len(np.unique(u)) < VALUES * len(u):
        return False
    moves = np.diff(u)
    scale = float(np.sqrt(np.mean(moves[2:] ** 2)))
    span = float(np.ptp(y))
    centred = (y - y.mean()) / span
    own = np.column_stack((np.ones(len(moves) - 2), moves[1:-1] / scale, moves[:-2] / scale))
    of_pv = np.column_stack((own, centred[3:], centred[2:-1], centred[1:-2]))
    alone, with_pv = (_left(columns, moves[2:] / scale) for columns in (own, of_pv))
    return alone > OWN and with_pv < LEFT * alone


def _left(columns: Reals, wanted: Reals) -> float:
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.sqrt(np.mean((wanted - columns @ found) ** 2)))
