"""Whether a record shows the controller rather than the plant: MV follows from PV, and nothing else moves it."""

from __future__ import annotations

import numpy as np

from loopwright.tuning.models import Reals

LEFT = 0.1
"""What a law of the present PV and the two before leaves, in what MV's own past leaves: more is no feedback."""
OWN = 1e-3
"""Of MV's moves, rms: of a ramp or a sine MV's own past leaves less, and there is nothing to judge by."""
VALUES = 0.1
"""Different ones of MV, in samples: a relay or a series of steps has fewer."""


def follows_from_pv(u: Reals, y: Reals) -> bool:
    """u, y: MV and PV, shape (N,), PV not constant. Of a PI or PID at a set-point that rests nothing is left; of a
    step, a relay or a set-point that acts on MV at once, nearly all."""
    moves = np.diff(u)
    if len(np.unique(u)) < VALUES * len(u) or not np.any(moves[2:]):
        return False
    moves /= np.max(np.abs(moves))
    centred = (y - y.mean()) / np.ptp(y)
    own = np.column_stack((np.ones(len(moves) - 2), moves[1:-1], moves[:-2]))
    of_pv = np.column_stack((own, centred[3:], centred[2:-1], centred[1:-2]))
    alone, with_pv = (_left(columns, moves[2:]) for columns in (own, of_pv))
    return alone > OWN * float(np.sqrt(np.mean(moves[2:] ** 2))) and with_pv < LEFT * alone


def _left(columns: Reals, wanted: Reals) -> float:
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.sqrt(np.mean((wanted - columns @ found) ** 2)))
