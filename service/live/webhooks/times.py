"""When messages to webhooks are sent."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from loopwright.service.store.clock_watch import uptime_s

LOOK_S = 1.0
"""Wall time between two looks for messages, s."""
DELAYS_S = (5.0, 30.0, 120.0, 600.0, 1800.0, 7200.0, 21_600.0, 50_000.0)
"""Wall time from a failed attempt to the next one, s; after the last of them, a day, the message is given up."""


@dataclass(frozen=True)
class DeliveryTimes:
    """The wall clock, s since 1970 UTC, the time that has passed, s, which nobody sets, the delays between attempts, s,
    and the time between two looks, s."""

    now_s: Callable[[], float] = time.time
    passed_s: Callable[[], float] = uptime_s
    delays_s: Sequence[float] = DELAYS_S
    look_s: float = LOOK_S
