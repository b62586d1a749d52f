"""The watchdog message to systemd, sent while the service works; without it systemd kills and restarts the service.

The event loop sends the message, so the message shows that the loop runs. The thread that reads stop requests must run
too, or wait for a database that is known to be unreachable, which is no reason to end the running tests.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Mapping

log = logging.getLogger(__name__)

LATE_S = 45.0
"""Longest time without a round of the thread that watches the jobs, s; its waits for a database are shorter."""
PING_S = 20.0
"""Wall time that the database has to answer, s."""


def interval_s(environment: Mapping[str, str] = os.environ) -> float | None:
    """Returns the wall time between two messages to systemd, s, a third of the required time; None where none is
    required."""
    asked, of = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not asked.isdigit() or (of and of != str(os.getpid())):
        return None
    return int(asked) / 3e6


class Watchdog:
    """Sends the watchdog messages.

    late_s: returns the time since the last round of the thread, s.
    ping: returns when the database accepts something.
    tell: sends a message to systemd.
    """

    def __init__(self, late_s: Callable[[], float], ping: Callable[[], None], tell: Callable[[str], None]) -> None:
        self._late_s, self._ping, self._tell = late_s, ping, tell

    async def run(self, every_s: float) -> None:
        """Sends messages until it is cancelled."""
        while True:
            if await self.well():
                self._tell("WATCHDOG=1")
            else:
                log.critical("the jobs have not been watched for %.0f s; systemd gets no message", self._late_s())
            await asyncio.sleep(every_s)

    async def well(self) -> bool:
        """Returns whether the jobs are watched, or the database is known to be unreachable."""
        if self._late_s() <= LATE_S:
            return True
        try:
            await asyncio.wait_for(asyncio.to_thread(self._ping), PING_S)
        except TimeoutError:
            return False
        except Exception:  # known to be unreachable: the thread has a reason to wait
            return True
        return False
