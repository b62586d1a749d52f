"""The closed loop over vcan0: plant and controller as two processes against a bare exchange of the same three frames.

Everything is in one run, and what is compared takes turns. Needs vcan0:

    tools/with-vcan -- .venv/bin/python -m benchmarks.bus
"""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from statistics import median
from typing import TypeVar

from benchmarks.command import parser_of, show
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, SYNC_ID, channel_ids
from loopwright.protocol.tuner import Tuner
from loopwright.service.loops.bus_loop import BusLoop

T = TypeVar("T")
INTERFACE = "vcan0"
URL = f"socketcan:{INTERFACE}"
TS = 0.1
ROUNDS = 3
INTERVAL_S = 1.0
LOOPS = (1, 10, 50, 100)
REAL_TIME_S = 15.0

FRAME = struct.Struct("=IB3x8s")
VALUE = struct.Struct("<fI")
IDS = channel_ids(1)
SO_TIMESTAMPNS = 35
TIMESPEC = struct.Struct("@ll")


def bare_socket(*ids: int) -> socket.socket:
    can = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    filters = b"".join(struct.pack("=II", can_id, socket.CAN_SFF_MASK) for can_id in ids)
    can.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
    can.bind((INTERFACE,))
    return can


def bare_controller() -> None:
    """PV in, MV out; like the controller device it lets the kernel filter SYNC away."""
    can = bare_socket(IDS.pv)
    print("ready", flush=True)
    while True:
        _, _, data = FRAME.unpack(can.recv(16))
        pv, number = VALUE.unpack(data)
        can.send(FRAME.pack(IDS.mv, 8, VALUE.pack(50.0 - pv, number)))


def bare_samples_per_s() -> float:
    """In a process of its own: it gives up priority as the plant device does at full speed, for good."""
    command = [sys.executable, "-m", "benchmarks.bus", "bare-plant"]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def bare_plant() -> float:
    """SYNC, PV, and wait for MV; samples/s."""
    can = bare_socket(IDS.mv)
    with process("benchmarks.bus", "bare-controller"):
        os.nice(10)
        number = 0
        start = now = time.perf_counter()
        while now - start < INTERVAL_S:
            for _ in range(100):
                number += 1
                can.send(FRAME.pack(SYNC_ID, 1, bytes([number % 240])))
                can.send(FRAME.pack(IDS.pv, 8, VALUE.pack(0.5, number)))
                _, answered = VALUE.unpack(FRAME.unpack(can.recv(16))[2])
                assert answered == number
            now = time.perf_counter()
    can.close()
    return number / (now - start)


@contextmanager
def process(module: str, *arguments: str) -> Iterator[None]:
    with subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert running.stdout.readline().startswith("ready"), f"{module} did not start"
        try:
            yield
        finally:
            running.terminate()


@contextmanager
def devices(loops: int, speed: str) -> Iterator[None]:
    """The processes a user starts. The plants are the 50 models over and over."""
    models = [f"--model=model-{k % 50 + 1}" for k in range(loops)]
    with ExitStack() as stack:
        gains = ("--kp", "0.1", "--ti", "20", "--sp", "50")
        stack.enter_context(process("loopwright.controller", "--bus", URL, "--channels", str(loops), *gains))
        stack.enter_context(process("loopwright.plantsim", "--bus", URL, *models, "--ts", str(TS), "--speed", speed))
        time.sleep(0.5)
        yield


def produced_per_s(tuner: Tuner) -> float:
    """Samples the plant has finished, by its own sample number."""
    first, start = tuner.number("sample_number", node=PLANT_NODE), time.perf_counter()
    time.sleep(INTERVAL_S)
    last, end = tuner.number("sample_number", node=PLANT_NODE), time.perf_counter()
    return (last - first) / (end - start)


def device_samples_per_s(loops: int = 1) -> float:
    with devices(loops, "max"):
        # Of a channel that is not there: nobody listens to the samples.
        tuner = Tuner(URL, CONTROLLER_NODE, PLANT_NODE, loops + 1, sdo_timeout_s=2.0)
        rate = produced_per_s(tuner)
        tuner.close()
    return rate


def heard_samples_per_s() -> float:
    """A third process takes every sample of a plant that runs freely: PV, MV and status, our heartbeat besides."""
    with devices(1, "max"):
        tuner = Tuner(URL, CONTROLLER_NODE, PLANT_NODE, sdo_timeout_s=2.0)
        tuner.beating = True
        tuner.drain()
        first = last = tuner.sample(2.0)
        start = now = time.perf_counter()
        heard = 0
        while now - start < INTERVAL_S:
            for _ in range(100):
                last = tuner.sample(2.0)
                assert last is not None
                heard += 1
            now = time.perf_counter()
        assert first is not None and last is not None
        assert last.n - first.n == heard, f"{last.n - first.n - heard} samples lost"
        tuner.close()
    return heard / (now - start)


def live_loop_samples_per_s() -> float:
    """As a retune does it: the plant in blocks, lease and heartbeat, no sample lost by construction."""
    with devices(1, "max"):
        loop = BusLoop(URL, CONTROLLER_NODE, PLANT_NODE)
        state = loop.begin()
        steps = 0
        start = now = time.perf_counter()
        while now - start < INTERVAL_S:
            for _ in range(100):
                loop.step(())
                steps += 1
            now = time.perf_counter()
        loop.restore(state)
        loop.close()
    return steps / (now - start)


def real_time(loops: int = 100) -> dict[str, float]:
    """Kernel time stamps of SYNC and of the last loop's MV against the grid of Ts.

    The grid is laid through the earliest SYNC, so that every delay counts. In ms.
    """
    last_mv = channel_ids(loops).mv
    syncs: list[float] = []
    answers: list[float] = []
    with devices(loops, "1"):
        can = bare_socket(SYNC_ID, last_mv)
        can.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        can.settimeout(2.0)
        numbers: list[int] = []
        while len(answers) < REAL_TIME_S / TS:
            raw, notes, _, _ = can.recvmsg(16, 64)
            seconds, nanoseconds = TIMESPEC.unpack(notes[0][2])
            at = seconds + nanoseconds * 1e-9
            can_id, _, data = FRAME.unpack(raw)
            if can_id == SYNC_ID:
                syncs.append(at)
            elif syncs:  # begun in the middle of a sample: this answer's SYNC was not seen
                answers.append(at)
                numbers.append(VALUE.unpack(data)[1])
        can.close()
    syncs = syncs[: len(answers)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "samples are missing"
    grid = min(at - k * TS for k, at in enumerate(syncs))
    late = [1e3 * (at - grid - k * TS) for k, at in enumerate(answers)]
    latest_sync = [1e3 * (at - grid - k * TS) for k, at in enumerate(syncs)]
    answered_in = [1e3 * (b - a) for a, b in zip(syncs, answers, strict=True)]
    return {
        "samples": len(late),
        "late_max_ms": max(late),
        "late_median_ms": median(late),
        "late_by_more_than_half_Ts": sum(each > 500 * TS for each in late),
        "sync_late_max_ms": max(latest_sync),
        "sync_to_last_mv_median_ms": median(answered_in),
        "sync_to_last_mv_max_ms": max(answered_in),
    }


def told(what: str, figure: T) -> T:
    print(f"  {what}: {figure}", file=sys.stderr, flush=True)
    return figure


def run() -> dict[str, object]:
    rounds = [
        (
            told("bare, samples/s", bare_samples_per_s()),
            told("devices", device_samples_per_s()),
            told("listening", heard_samples_per_s()),
            told("live loop", live_loop_samples_per_s()),
        )
        for _ in range(ROUNDS)
    ]
    bare, alone, heard, live = (median(each) for each in zip(*rounds, strict=True))
    return {
        "vcan": os.environ.get("LOOPWRIGHT_VCAN", "host"),
        "rounds": ROUNDS,
        "bare_per_s": bare,
        "devices_per_s": alone,
        "listening_per_s": heard,
        "live_loop_per_s": live,
        "devices_ratio": median(a / b for b, a, _, _ in rounds),
        "listening_ratio": median(a / b for b, _, a, _ in rounds),
        "live_loop_ratio": median(a / b for b, _, _, a in rounds),
        "devices_ratio_range": [min(a / b for b, a, _, _ in rounds), max(a / b for b, a, _, _ in rounds)],
        "listening_ratio_range": [min(a / b for b, _, a, _ in rounds), max(a / b for b, _, a, _ in rounds)],
        "speed_factor": {
            str(loops): told(f"speed factor, {loops} loops", TS * device_samples_per_s(loops)) for loops in LOOPS
        },
        "real_time_100_loops": real_time(),
    }


if __name__ == "__main__":
    parser = parser_of(__doc__)
    roles = ("bare-controller", "bare-plant")
    parser.add_argument("role", nargs="?", choices=roles, help="one of its own processes; default: the benchmark")
    role = parser.parse_args().role
    if role == "bare-controller":
        bare_controller()
    elif role == "bare-plant":
        print(bare_plant())
    else:
        show(run)
