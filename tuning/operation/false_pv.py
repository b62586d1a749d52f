"""Whether PV of a loop in operation is false: it stands still where it never did, or has jumped and stays, as no plant
of that speed does. The rules are those of tests (`tuning.experiments`); what PV did before takes the place of
its rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.pv_at_rest import PvAtRest
from loopwright.tuning.experiments.pv_jump import JUMP_BAND, JUMP_MOVES, JUMP_NOISES, JUMP_STAYS
from loopwright.tuning.models import Reals

MIN_BEFORE = 100
"""Number of samples before that have to be known."""
SLOW = 20.0
"""Sampling periods in the ultimate period of a plant that cannot jump within one sample."""


@dataclass(frozen=True, slots=True)
class FalseOperation:
    """A PV that is false.

    text: how, with the numbers.
    sure: False where PV has jumped and it is not known yet whether it stays.
    """

    text: str
    sure: bool = True


def false_operation(pv: Reals, period_samples: float) -> FalseOperation | None:
    """Returns how PV is false at the end of these samples, or has become so within them; None where it is not.

    pv: consecutive samples of operation, PV units.
    period_samples: the ultimate period, in samples.
    """
    return _frozen(pv) or (_jumped(pv) if period_samples >= SLOW else None)


def _frozen(pv: Reals) -> FalseOperation | None:
    other = np.flatnonzero(pv != pv[-1])
    first = int(other[-1]) + 1 if len(other) else 0
    run = len(pv) - first
    if first < MIN_BEFORE or run < 2:
        return None
    before = PvAtRest.of(pv[:first].tolist())
    if before.run_limit is None or run <= before.run_limit:
        return None
    return FalseOperation(
        f"PV stands at exactly {pv[-1]:.6g} for {run} samples, and never stood still for more than "
        f"{before.longest_run} before"
    )


def _jumped(pv: Reals) -> FalseOperation | None:
    moves = np.abs(np.diff(pv))
    if len(moves) <= MIN_BEFORE:
        return None
    at = MIN_BEFORE + int(np.argmax(moves[MIN_BEFORE:]))
    move, largest = float(moves[at]), float(moves[:at].max())
    if move <= JUMP_MOVES * largest or largest == 0.0:
        return None
    before = PvAtRest.of(pv[: at + 1].tolist())
    stays = pv[at + 1 : at + 1 + max(JUMP_STAYS, 2 * before.renewal)]
    if move <= JUMP_NOISES * before.noise or np.any(np.abs(stays - pv[at + 1]) > JUMP_BAND * move):
        return None
    return FalseOperation(
        f"PV went from {pv[at]:.6g} to {pv[at + 1]:.6g} within one sample and stayed there, and never moved by more "
        f"than {largest:.3g} in one before",
        sure=len(stays) >= max(JUMP_STAYS, 2 * before.renewal),
    )
