"""Loops as a bus carries them, for those that listen only: PV, MV and status of so many, so often a second.

python -m benchmarks.broadcast BUS LOOPS RATE_PER_S
"""

from __future__ import annotations

import math
import signal
import threading
import time
from contextlib import closing

from benchmarks.command import parser_of
from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import MV_FRAME, PV_FRAME, STATUS_FRAME, Mode, channel_ids

MIDDLE = 50.0
SLOWEST_S = 20.0
"""Period of the slowest PV, s."""


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("bus")
    parser.add_argument("loops", type=int, help="channels 1 to LOOPS")
    parser.add_argument("rate_per_s", type=float, help="samples of each")
    given = parser.parse_args()
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    ids = [channel_ids(n + 1) for n in range(given.loops)]
    status = STATUS_FRAME.pack(int(Mode.AUTOMATIC), 0, MIDDLE, 0, 0)
    with closing(open_bus(given.bus)) as bus:
        bus.set_filters(())
        print("ready", flush=True)
        number, due = 0, time.monotonic()
        while not over.is_set():
            number += 1
            for n, each in enumerate(ids):
                angle = 2.0 * math.pi * number / given.rate_per_s / (SLOWEST_S / (1 + n % 7))
                bus.send(each.pv, PV_FRAME.pack(MIDDLE + math.sin(angle), number))
                bus.send(each.mv, MV_FRAME.pack(MIDDLE + 20.0 * math.cos(angle), number))
                if number % max(1, round(given.rate_per_s)) == 1 % max(1, round(given.rate_per_s)):
                    bus.send(each.status, status)  # a service that begins later has to learn mode and set-point
            due += 1.0 / given.rate_per_s
            over.wait(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
