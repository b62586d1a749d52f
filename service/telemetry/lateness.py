"""The lateness of the event loop: while it is busy, every other request and stream waits.

A task asks to be woken every 10 ms and measures how late it is. No request should block the loop for 50 ms.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from loopwright.service.telemetry.metrics import LATE_SECONDS, LATEST_SECONDS

log = logging.getLogger(__name__)

EVERY_S = 0.01
"""Wall time between two measurements, s."""
MAX_S = 0.05
"""Lateness above which a warning is logged, at most once a minute, s."""
_MINUTE_S = 60.0


class Lateness:
    """The largest lateness of the last minute, and when to log it. Times are monotonic seconds."""

    def __init__(self) -> None:
        # The worst of each second, so that a minute has sixty entries.
        self.by_second: dict[int, float] = {}
        self._told: float | None = None

    def note(self, late_s: float, at_s: float) -> float | None:
        """Takes a measurement, s. Returns the lateness to log now, the worst of the last minute in s, or None."""
        second = int(at_s)
        if second not in self.by_second:
            for past in [past for past in self.by_second if past <= at_s - _MINUTE_S]:
                del self.by_second[past]
        if late_s > self.by_second.get(second, -1.0):
            self.by_second[second] = late_s
        if late_s <= MAX_S or (self._told is not None and at_s - self._told < _MINUTE_S):
            return None
        self._told = at_s
        return self.worst_s(at_s)

    def worst_s(self, at_s: float) -> float:
        """Returns the worst of the last minute, s. Any thread may call it, because the numbers are copied first."""
        recent = [late for second, late in list(self.by_second.items()) if second > at_s - _MINUTE_S]
        return max(recent, default=0.0)


@asynccontextmanager
async def watched_event_loop() -> AsyncIterator[None]:
    """Measures the running event loop, for /metrics and the log, until the context ends."""
    watch = asyncio.create_task(_watch(Lateness()), name="event loop watch")
    try:
        yield
    finally:
        watch.cancel()
        with suppress(asyncio.CancelledError):
            await watch


async def _watch(lateness: Lateness) -> None:
    LATEST_SECONDS.set_function(lambda: lateness.worst_s(time.monotonic()))
    while True:
        due = time.monotonic() + EVERY_S
        await asyncio.sleep(EVERY_S)
        now = time.monotonic()
        late = max(0.0, now - due)
        LATE_SECONDS.observe(late)
        worst_s = lateness.note(late, now)
        if worst_s is not None:
            log.warning(
                "the event loop was held up for %.0f ms: every request and stream waited for that", 1e3 * worst_s
            )
