"""Whether the wall clock may be believed about the age of things: what is deleted for its age does not come back.

A clock that jumps changes the age of everything at once. It is compared with the machine's own count of the time that
has passed, which nobody sets, and over a stop of the service with what it said when it was last seen. After a jump the
ages count from then: whatever ended before is taken to have ended in that moment. So nothing is deleted before the
service itself has seen its time pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

STEP = timedelta(minutes=10)
"""A clock that is put right by less has not jumped."""
SHORTEST_STOP, LONGEST_STOP = timedelta(days=1), timedelta(days=31)


@dataclass(frozen=True)
class Seen:
    """at: what the clock said when it was last looked at.  ages_from: nothing counts as older than this; None: no jump
    was ever seen."""

    at: datetime
    ages_from: datetime | None = None


@dataclass(frozen=True)
class Jump:
    """The clock says `to` where `expected` would have been right, or at most so after a stop of the service."""

    expected: datetime
    to: datetime

    @property
    def text(self) -> str:
        by = abs((self.to - self.expected) / timedelta(hours=1))
        far = f"{by / 24:.0f} days" if by >= 48 else f"{by:.1f} h"
        return (
            f"the wall clock has jumped {'forward' if self.to > self.expected else 'back'} by {far}, "
            f"to {self.to:%Y-%m-%d %H:%M} UTC: the ages of samples count from there"
        )


def longest_stop(keep_days: float | None) -> timedelta:
    """How long the service may have been stopped and its clock still be believed: half of the time for which samples
    are kept, within a day and a month."""
    if keep_days is None:
        return LONGEST_STOP
    half = timedelta(days=min(keep_days, 1000.0) / 2)
    return min(max(half, SHORTEST_STOP), LONGEST_STOP)


def after_a_stop(seen: Seen | None, at: datetime, longest: timedelta) -> tuple[Seen, Jump | None]:
    """The first look of a service. seen: the last one of the service before it; None: there was none, nor a job."""
    if seen is None:
        return Seen(at), None
    if at < seen.at - STEP:
        return Seen(at, at), Jump(seen.at, at)
    if at > seen.at + longest:
        return Seen(at, at), Jump(seen.at + longest, at)
    return replace(seen, at=at), None


def in_operation(seen: Seen, at: datetime, expected: datetime) -> tuple[Seen, Jump | None]:
    """A further look. expected: what the clock should say by the time that has passed."""
    if abs(at - expected) > STEP:
        return Seen(at, at), Jump(expected, at)
    return replace(seen, at=at), None


def uptime_s() -> float:
    """Time that has passed, s, that of a suspended machine too; nobody sets it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class ClockWatch:
    """Looks at the clock of this process. wall, passed_s: the clocks."""

    def __init__(
        self,
        wall: Callable[[], datetime] = lambda: datetime.now(UTC),
        passed_s: Callable[[], float] = uptime_s,
    ) -> None:
        self._wall, self._passed_s = wall, passed_s
        self._anchor: tuple[datetime, float] | None = None
        self.seen: Seen | None = None

    def look(self, before: Seen | None, longest: timedelta) -> Jump | None:
        """Looks, and keeps what was seen; tells when the clock has jumped since the last look. before: what a service
        before this one saw last, for the first look."""
        at, passed_s = self._wall(), self._passed_s()
        if self._anchor is None or self.seen is None:
            self.seen, jump = after_a_stop(before, at, longest)
        else:
            began, began_s = self._anchor
            self.seen, jump = in_operation(self.seen, at, began + timedelta(seconds=passed_s - began_s))
        if self._anchor is None or jump is not None:
            self._anchor = at, passed_s
        return jump
