"""Time to come to rest, for a loop whose test was cut off."""

from __future__ import annotations

from contextlib import closing, suppress
from typing import TypeVar

from loopwright.tuning.experiments.preflight import SETTLE, check_at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.plan import Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Refused

T = TypeVar("T")

MAX_ATTEMPTS = 20
"""Of half a T95 each. The present gains may well swing, or creep, for much longer than the plant alone: that is why the
loop is tuned."""


def after_settling(facts: Facts, plan: Plan[T]) -> Plan[T]:
    """The plan, once the loop is fit to be tested: what the cut-off test has left has to die away first.

    A loop that is not fit after LOOKS is the plan's own preflight to refuse.
    """
    with closing(plan):
        items = next(plan)
        ahead = sum(item.expected_s + item.remaining_s for item in items if isinstance(item, StageStarted))
        yield (StageStarted(SETTLE, facts.T95_s, ahead),)
        for _ in range(MAX_ATTEMPTS):
            with suppress(Refused):
                yield from check_at_rest(facts)
                break
        items = (StageDone(SETTLE, None), *items)
        while True:
            answer = yield items
            try:
                items = plan.send(answer)
            except StopIteration as end:
                value: T = end.value
                return value
