"""From what is abnormal at each moment to alarms. Pure: time is handed in.

A condition becomes an alarm when it has lasted for the on-delay without a break, and the alarm ends when the condition
has been away for the off-delay without a break. One that comes back before that is the same alarm still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from loopwright.service.alarms.alarm import RULES, Alarm
from loopwright.service.alarms.conditions import Condition
from loopwright.service.store.clock import stamp


@dataclass
class _Course:
    """A condition as it was seen last.

    seen_s: when it was seen first without a break, wall time, s.
    gone_s: since when it is away; None: it is there.
    alarm: what it has become; None: nothing yet.
    """

    condition: Condition
    seen_s: float
    gone_s: float | None = None
    alarm: Alarm | None = None


class Delays:
    """Keeps the course of each condition from one moment to the next."""

    def __init__(self) -> None:
        self._courses: dict[str, _Course] = {}

    def step(self, found: Sequence[Condition], now_s: float) -> list[Alarm]:
        """Returns the alarms of this moment, the worst first.

        found: what is abnormal at this moment.
        now_s: the present time, wall time, s. A clock that is put back begins the delays anew and ends no alarm.
        """
        there = {each.id for each in found}
        for each in found:
            course = self._courses.setdefault(each.id, _Course(each, now_s))
            course.condition, course.gone_s = each, None
            course.seen_s = min(course.seen_s, now_s)
            if course.alarm is not None:
                course.alarm = _alarm(each, course.alarm.since)
            elif now_s - min(_from_s(course), now_s) >= _on_s(each):
                course.alarm = _alarm(each, _since(course, now_s))
        for id_, course in list(self._courses.items()):
            if id_ in there:
                continue
            course.gone_s = now_s if course.gone_s is None else min(course.gone_s, now_s)
            if course.alarm is None or now_s - course.gone_s >= RULES[course.condition.kind].off_s:
                del self._courses[id_]
        alarms = [course.alarm for course in self._courses.values() if course.alarm is not None]
        return sorted(alarms, key=lambda alarm: (alarm.priority, alarm.subject, alarm.kind, alarm.id))


def _from_s(course: _Course) -> float:
    return course.seen_s if course.condition.from_s is None else course.condition.from_s


def _on_s(condition: Condition) -> float:
    if condition.on_s is not None:
        return condition.on_s
    return RULES[condition.kind].on_s


def _since(course: _Course, now_s: float) -> str:
    since_s = course.seen_s if course.condition.since_s is None else course.condition.since_s
    return stamp(datetime.fromtimestamp(min(since_s, now_s), UTC))


def _alarm(found: Condition, since: str) -> Alarm:
    rule = RULES[found.kind]
    return Alarm(
        id=found.id, priority=rule.priority, kind=found.kind, subject=found.subject, text=found.text,
        advice=found.advice, since=since, gateway=found.host, loop=found.loop, loops=list(found.loops), job=found.job,
        unacknowledged=rule.to_acknowledge, acknowledged=None,
    )  # fmt: skip
