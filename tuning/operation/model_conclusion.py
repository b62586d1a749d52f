"""What the changes since the acceptance say of the accepted model together.

One change alone does not disprove a model: a load that steps some time after the set-point looks like a second path. By
chance two loads do so with the same delay, sign and share of the set-point change only rarely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from loopwright.tuning.operation.change_findings import ChangeState, ComparedChange, OtherPlant

ALIKE, ALIKE_DEVIATIONS = 0.5, 3.0
"""Largest difference of the sizes of an alternative in two changes that show the same one: a fraction of the larger
size, or this number of standard deviations, whichever is more."""
ALIKE_DELAY = 0.1
"""Largest difference of the delays of a second path in two changes that show the same one, as a fraction."""


class ModelState(StrEnum):
    """What operation says of the model."""

    OPEN = "open"
    CONFIRMED = "confirmed"
    MISMATCH = "mismatch"


@dataclass(frozen=True, slots=True)
class Conclusion:
    """What operation says of the model.

    confirmed: the number of changes that confirm it.
    instead: what fits instead, of a mismatch; its size is the mean of the changes that show it. changes: their number.
    """

    state: ModelState
    confirmed: int
    instead: OtherPlant | None = None
    changes: int = 0


def conclusion_of(changes: Sequence[ComparedChange]) -> Conclusion:
    """The conclusion from all changes so far, oldest first."""
    confirmed = sum(each.state is ChangeState.CONFIRMED for each in changes)
    shown = [[each for each in change.alternatives if each.clear] for change in changes if _differs(change)]
    found = [together for first in range(len(shown)) if (together := _largest_alike(shown[first:]))]
    if found:
        best = min(found, key=lambda each: (-len(each), sum(one.residual for one in each)))
        return Conclusion(ModelState.MISMATCH, confirmed, _mean(best), len(best))
    telling = [each.state for each in changes if each.state in (ChangeState.CONFIRMED, ChangeState.DIFFERS)]
    last_confirms = bool(telling) and telling[-1] is ChangeState.CONFIRMED
    return Conclusion(ModelState.CONFIRMED if last_confirms else ModelState.OPEN, confirmed)


def _differs(change: ComparedChange) -> bool:
    return change.state is ChangeState.DIFFERS


def _largest_alike(shown: Sequence[Sequence[OtherPlant]]) -> tuple[OtherPlant, ...]:
    """One alternative of the first change and those of the later ones that agree with it and with each other, of as
    many changes as possible and with the least residual; empty where none agree."""
    best: tuple[OtherPlant, ...] = ()
    for first in shown[0]:
        together = [first]
        for later in shown[1:]:
            alike = [each for each in later if all(_alike(each, one) for one in together)]
            if alike:
                together.append(min(alike, key=lambda each: each.residual))
        better = (-len(together), sum(each.residual for each in together))
        if len(together) > 1 and (not best or better < (-len(best), sum(each.residual for each in best))):
            best = tuple(together)
    return best


def _alike(one: OtherPlant, other: OtherPlant) -> bool:
    if one.kind is not other.kind or one.size * other.size <= 0.0:
        return False
    if abs(one.delay_s - other.delay_s) > ALIKE_DELAY * max(one.delay_s, other.delay_s):
        return False
    largest = max(abs(one.size), abs(other.size))
    permitted = max(ALIKE * largest, ALIKE_DEVIATIONS * math.hypot(one.deviation, other.deviation))
    return abs(one.size - other.size) <= permitted


def _mean(shown: Sequence[OtherPlant]) -> OtherPlant:
    """The alternative with the mean size, each weighted with its precision; Ms and residual are the latest ones."""
    weights = [1.0 / each.deviation**2 for each in shown]
    size = sum(weight * each.size for weight, each in zip(weights, shown, strict=True)) / sum(weights)
    # what is not known of the model is common to all changes, so the mean is no better known than the best of them
    deviation = min(each.deviation for each in shown)
    last = shown[-1]
    delay_s = sum(weight * each.delay_s for weight, each in zip(weights, shown, strict=True)) / sum(weights)
    return OtherPlant(last.kind, delay_s, size, deviation, last.residual, last.Ms, True)
