"""What listening takes: 100 loops with ten samples a second on a hub, and 1,000 such loops on ten buses.

The 100 loops come from a hub of this machine through python-can, which is the slowest way there is; the figure is the
processor time of the listening process alone. The 1,000 loops are handed to it as fast as it takes them, from buses in
memory, with their times: what a kernel's socket costs comes to that (`benchmarks.bus`).

    python -m benchmarks.listening
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing
from multiprocessing import Pipe

from benchmarks.command import command
from loopwright.protocol.bus import Bus, open_bus
from loopwright.protocol.hub import Hub
from loopwright.protocol.profile import MV_FRAME, PV_FRAME, ChannelIds, channel_ids
from loopwright.service.listening.child import Child, Clock
from loopwright.service.listening.messages import Listen, Query, Report
from loopwright.service.listening.rings import Rings

LOOPS, TS, HEARD_S = 100, 0.1, 20.0
BUSES, MANY_S = 10, 20
HOURS_H = 8.0


def ids_of(loops: int) -> dict[str, ChannelIds]:
    return {f"T-{n}": channel_ids(n + 1) for n in range(loops)}


def processor_s(pid: int) -> float:
    with open(f"/proc/{pid}/stat") as stat:
        user, system = stat.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / 100.0


def produce(url: str, over: threading.Event) -> None:
    """Sends PV and MV of all loops ten times a second."""
    with closing(open_bus(url)) as bus:
        bus.set_filters(())
        ids, due = ids_of(LOOPS), time.monotonic()
        number = 0
        while not over.is_set():
            number += 1
            for each in ids.values():
                bus.send(each.pv, PV_FRAME.pack(50.0 + number % 7, number))
                bus.send(each.mv, MV_FRAME.pack(40.0 + number % 5, number))
            due += TS
            time.sleep(max(0.0, due - time.monotonic()))


def on_a_hub() -> dict[str, float]:
    """The listening process as the service starts it, on a hub."""
    with ExitStack() as stack:
        hub = Hub(port=0)
        serving = threading.Thread(target=hub.serve)
        serving.start()
        stack.callback(serving.join)
        stack.callback(hub.stop)
        over = threading.Event()
        producer = threading.Thread(target=produce, args=(hub.url, over))
        ours, theirs = Pipe()
        program = [sys.executable, "-m", "loopwright.service.listening.child", str(theirs.fileno())]
        child = stack.enter_context(subprocess.Popen(program, pass_fds=[theirs.fileno()]))
        stack.callback(ours.close)
        theirs.close()
        ours.send(Listen({hub.url: ids_of(LOOPS)}))
        while not isinstance(report := ours.recv(), Report) or report.down:
            pass
        producer.start()
        stack.callback(producer.join)
        stack.callback(over.set)
        time.sleep(2.0)
        while ours.poll():
            ours.recv()
        ours.recv()  # the time begins with a report
        frames, before_s, began = 0, processor_s(child.pid), time.monotonic()
        while time.monotonic() - began < HEARD_S:
            frames += sum(ours.recv().frames.values())
        elapsed_s = time.monotonic() - began
        return {
            "loops": LOOPS,
            "samples_per_s": frames / 2 / elapsed_s,
            "share_of_a_core": (processor_s(child.pid) - before_s) / elapsed_s,
        }


def no_bus(_url: str) -> Bus:
    raise AssertionError("frames are handed over")


def in_memory() -> dict[str, float]:
    """1,000 loops at ten samples a second on ten buses, with the reports and blocks of every second."""
    now = [1_769_860_800.0]
    child = Child({f"bus {n}": of_bus(n) for n in range(BUSES)}, Clock(lambda: now[0], lambda: now[0]), no_bus)
    ids = ids_of(LOOPS)
    buses = list(child.buses.values())
    began = time.process_time()
    for number in range(1, round(MANY_S / TS) + 1):
        pv, mv = PV_FRAME.pack(50.0 + number % 7, number), MV_FRAME.pack(40.0 + number % 5, number)
        for bus in buses:
            for each in ids.values():
                bus.take(each.pv, pv)
                bus.take(each.mv, mv)
        now[0] += TS
        if number % 10 == 0:
            child.report()
    took_s = time.process_time() - began
    began = time.process_time()
    child.answer(Query(1, "0-T-0", now[0] - 3600.0, now[0], 600))
    answer_s = time.process_time() - began
    samples = BUSES * LOOPS * MANY_S / TS
    return {
        "loops": BUSES * LOOPS,
        "samples_per_s": samples / MANY_S,
        "share_of_a_core": took_s / MANY_S,
        "us_per_sample": 1e6 * took_s / samples,
        "answer_ms": 1e3 * answer_s,
    }


def of_bus(number: int) -> dict[str, ChannelIds]:
    return {f"{number}-{tag}": each for tag, each in ids_of(LOOPS).items()}


def memory() -> dict[str, float]:
    """The rings of a loop, full after eight hours of ten samples a second, and how long an hour of it takes to ask."""
    rings = Rings()
    samples = round(HOURS_H * 3600.0 / TS)
    for n in range(samples):
        rings.put(TS * n, n + 1, 50.0, 40.0, 50.0, 0, 2, 0)
    end_s = TS * samples
    began = time.perf_counter()
    found = rings.rows(0.0, end_s, 1500)
    return {
        "bytes_per_loop": rings.nbytes,
        "hours": HOURS_H,
        "samples_answered": int(found.bins["count"].sum()),
        "answer_ms": 1e3 * (time.perf_counter() - began),
    }


def measure() -> dict[str, dict[str, float]]:
    return {"hub": on_a_hub(), "many": in_memory(), "memory": memory()}


if __name__ == "__main__":
    command(__doc__, measure)
