"""The word to systemd that the service is well, left out when it is not: systemd then ends it and starts it anew.

The word comes out of the event loop, so it says that this one turns. The thread that hears of aborts must turn, too, or
wait for a database that is known to be away: that is no reason to end the tests that run.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Mapping

log = logging.getLogger(__name__)

LATE_S = 45.0
"""Longer than the longest waits for a database in one turn of the thread."""
PING_S = 20.0


def interval_s(environment: Mapping[str, str] = os.environ) -> float | None:
    """How often systemd is to hear of us, s of wall time, three times as often as it must; None: it does not ask."""
    asked, of = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not asked.isdigit() or (of and of != str(os.getpid())):
        return None
    return int(asked) / 3e6


class Watchdog:
    """late_s: for how long the thread has not turned.  ping: returns when the database takes something.  tell: to
    systemd."""

    def __init__(self, late_s: Callable[[], float], ping: Callable[[], None], tell: Callable[[str], None]) -> None:
        self._late_s, self._ping, self._tell = late_s, ping, tell

    async def run(self, every_s: float) -> None:
        """Until it is cancelled."""
        while True:
            if await self.well():
                self._tell("WATCHDOG=1")
            else:
                log.critical("the jobs have not been watched for %.0f s; systemd is told nothing", self._late_s())
            await asyncio.sleep(every_s)

    async def well(self) -> bool:
        if self._late_s() <= LATE_S:
            return True
        try:
            await asyncio.wait_for(asyncio.to_thread(self._ping), PING_S)
        except TimeoutError:
            return False
        except Exception:  # known to be away: who waits for it does so for a reason
            return True
        return False
