"""What the changes since the acceptance say of the accepted model together.

One change alone does not disprove a model: a load that steps some time after the set-point looks like a second path. By
chance two loads do so with the same delay, sign and share of the set-point change only rarely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations

from loopwright.tuning.operation.compared_change import Alternative, ChangeState, ComparedChange, Kind

ALIKE, ALIKE_DEVIATIONS = 0.35, 3.0
"""Largest difference of the sizes of an alternative in two changes that show the same one: a fraction of the larger
size, or this number of standard deviations, whichever is more."""


class ModelVerdict(StrEnum):
    """What operation says of the model."""

    OPEN = "open"
    CONFIRMED = "confirmed"
    MISMATCH = "mismatch"


@dataclass(frozen=True, slots=True)
class Judgement:
    """What operation says of the model.

    confirmed: the number of changes that confirm it.
    instead: what fits instead, of a mismatch; its size is the mean of the changes that show it. changes: their number.
    """

    verdict: ModelVerdict
    confirmed: int
    instead: Alternative | None = None
    changes: int = 0


def judged(changes: Sequence[ComparedChange]) -> Judgement:
    """The judgement from all changes so far, oldest first."""
    confirmed = sum(each.state is ChangeState.CONFIRMED for each in changes)
    shown: dict[tuple[Kind, float], list[Alternative]] = {}
    for change in changes:
        if change.state is ChangeState.DIFFERS:
            for each in change.alternatives:
                if each.clear:
                    shown.setdefault((each.kind, each.delay_s), []).append(each)
    found = [agreed for each in shown.values() if len(agreed := _largest_alike(each)) > 1]
    if found:
        best = min(found, key=lambda each: (-len(each), sum(one.residual for one in each)))
        return Judgement(ModelVerdict.MISMATCH, confirmed, _mean(best), len(best))
    return Judgement(ModelVerdict.CONFIRMED if confirmed else ModelVerdict.OPEN, confirmed)


def _largest_alike(shown: Sequence[Alternative]) -> tuple[Alternative, ...]:
    """The most alternatives of which any two agree; empty where no two do."""
    for count in range(len(shown), 1, -1):
        for some in combinations(shown, count):
            if all(_alike(one, other) for one, other in combinations(some, 2)):
                return some
    return ()


def _alike(one: Alternative, other: Alternative) -> bool:
    apart = abs(one.size - other.size)
    largest = max(abs(one.size), abs(other.size))
    permitted = max(ALIKE * largest, ALIKE_DEVIATIONS * math.hypot(one.deviation, other.deviation))
    return one.size * other.size > 0.0 and apart <= permitted


def _mean(shown: Sequence[Alternative]) -> Alternative:
    """The alternative with the mean size, each weighted with its precision; Ms and residual are the latest ones."""
    weights = [1.0 / each.deviation**2 for each in shown]
    size = sum(weight * each.size for weight, each in zip(weights, shown, strict=True)) / sum(weights)
    # what is not known of the model is common to all changes, so the mean is no better known than the best of them
    deviation = min(each.deviation for each in shown)
    last = shown[-1]
    return Alternative(last.kind, last.delay_s, size, deviation, last.residual, last.Ms, True)
