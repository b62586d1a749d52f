"""Listens to the service's heartbeat and to the session of one loop, and beside them to the machine: how late a process
is that only sleeps.

    python -m tests.hostile.listening BUS CHANNEL

A process of its own, so that what the rest of the measuring does is not counted as the service's. On SIGTERM it prints
what was late, when (in monotonic time, which all processes of a machine share) and by how much, and when a session of
the channel was opened or over, and ends.
What the machine does to a process that wants nothing but 10 ms of sleep it does to the service, too.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time

from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import STATUS_FRAME, TUNER_NODE, channel_ids, heartbeat_id
from loopwright.protocol.station import HEARTBEAT_S

NAP_S = 0.01


def main() -> None:
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    heartbeat: list[tuple[float, float]] = []
    machine: list[tuple[float, float]] = []
    sessions: list[tuple[float, int]] = []
    arguments = (sys.argv[1], channel_ids(int(sys.argv[2])).status, heartbeat, sessions, over)
    listener = threading.Thread(target=listen, args=arguments)
    listener.start()
    print("ready", flush=True)
    while not over.is_set():
        due = time.monotonic() + NAP_S
        time.sleep(NAP_S)
        now = time.monotonic()
        machine.append((now, now - due))
    listener.join()
    print(json.dumps({"heartbeat": heartbeat, "machine": machine, "sessions": sessions}), flush=True)


def listen(
    url: str,
    status_id: int,
    heartbeat: list[tuple[float, float]],
    sessions: list[tuple[float, int]],
    over: threading.Event,
) -> None:
    """Notes by how much each heartbeat came later than it is due, and when a session began or ended."""
    bus = open_bus(url)
    heartbeats_id = heartbeat_id(TUNER_NODE)
    bus.set_filters({heartbeats_id, status_id})
    last: float | None = None
    while not over.is_set():
        frame = bus.recv(0.05)
        now = time.monotonic()
        match frame:
            case (can_id, _) if can_id == heartbeats_id:
                if last is not None:
                    heartbeat.append((now, max(0.0, now - last - HEARTBEAT_S)))
                last = now
            case (can_id, data) if can_id == status_id:
                session = STATUS_FRAME.unpack(data)[3]
                if not sessions or sessions[-1][1] != session:
                    sessions.append((now, session))
    bus.close()


if __name__ == "__main__":
    main()
