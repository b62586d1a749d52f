"""A loop whose test was cut off is given time to come to rest before its plan goes on."""

from __future__ import annotations

from contextlib import closing, suppress
from typing import TypeVar

from loopwright.tuning.experiments.preflight import SETTLE, check_at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.plan import Mode, Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Refused

T = TypeVar("T")

MAX_ATTEMPTS = 20
"""Number of checks, of half a T95 each. Under the present gains the loop may oscillate, or creep, for much longer than
the plant alone."""


def after_settling(facts: Facts, plan: Plan[T], mode: Mode = Mode.AUTOMATIC) -> Plan[T]:
    """Waits until the loop is at rest, then carries out the plan: the transient of the test that was cut off dies away.

    A loop that is not at rest after MAX_ATTEMPTS checks is left to the preflight of the plan, which refuses it.

    mode: the mode of the loop, automatic or manual.
    """
    with closing(plan):
        items = next(plan)
        ahead = sum(item.expected_s + item.remaining_s for item in items if isinstance(item, StageStarted))
        yield (StageStarted(SETTLE, facts.T95_s, ahead),)
        for _ in range(MAX_ATTEMPTS):
            with suppress(Refused):
                yield from check_at_rest(facts, mode=mode)
                break
        items = (StageDone(SETTLE, None), *items)
        while True:
            answer = yield items
            try:
                items = plan.send(answer)
            except StopIteration as end:
                value: T = end.value
                return value
