"""Listens to the service's heartbeat, and beside it to the machine: how late a process is that only sleeps.

    python -m tests.hostile.listening BUS

A process of its own, so that what the rest of the measuring does is not counted as the service's. On SIGTERM it prints
what was late, when (in monotonic time, which all processes of a machine share) and by how much, and ends.
What the machine does to a process that wants nothing but 10 ms of sleep it does to the service, too.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
import time

from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import TUNER_NODE, heartbeat_id
from loopwright.protocol.station import HEARTBEAT_S

NAP_S = 0.01


def main() -> None:
    logging.getLogger("can").setLevel(logging.ERROR)  # its socketcand client tells of every frame that TCP splits
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    heartbeat: list[tuple[float, float]] = []
    machine: list[tuple[float, float]] = []
    listener = threading.Thread(target=listen, args=(sys.argv[1], heartbeat, over))
    listener.start()
    print("ready", flush=True)
    while not over.is_set():
        due = time.monotonic() + NAP_S
        time.sleep(NAP_S)
        now = time.monotonic()
        machine.append((now, now - due))
    listener.join()
    print(json.dumps({"heartbeat": heartbeat, "machine": machine}), flush=True)


def listen(url: str, found: list[tuple[float, float]], over: threading.Event) -> None:
    """Notes by how much each heartbeat came later than it is due."""
    bus = open_bus(url)
    wanted = heartbeat_id(TUNER_NODE)
    bus.set_filters({wanted})
    last: float | None = None
    while not over.is_set():
        frame = bus.recv(0.05)
        if frame is None or frame[0] != wanted:
            continue
        now = time.monotonic()
        if last is not None:
            found.append((now, max(0.0, now - last - HEARTBEAT_S)))
        last = now
    bus.close()


if __name__ == "__main__":
    main()
