"""`loopwright tune --method all` as a user runs it: wall-clock time from start to exit, and peak memory of the process.

The median of five runs each on a lag-dominant, a balanced, a delay-dominant, a second-order, an integrating and an
inverse-response model; the slowest model and the largest process count.

    python -m benchmarks.tune
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from statistics import median

from benchmarks.command import command

MODELS = {
    "lag-dominant": '{"K": 2, "T_s": 50, "L_s": 2}',
    "balanced": '{"K": 2, "T_s": 10, "L_s": 8}',
    "delay-dominant": '{"K": 1, "T_s": 2, "L_s": 10}',
    "second order": '{"K": 2, "T1_s": 10, "T2_s": 4, "L_s": 3}',
    "integrating": '{"K": 0.1, "L_s": 3, "integrating": true}',
    "inverse response": '{"num": [-2, 1], "den": [15, 8, 1], "dead_time_s": 1}',
}
REPEATS = 5


def once(model: str) -> tuple[float, float, float]:
    """(wall-clock s, processor s, peak MB) of one process."""
    command = [sys.executable, "-m", "loopwright.service", "tune", "--method", "all", "--json", "--model", model]
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    answer = json.load(process.stdout)
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    process.stdout.close()
    if process.returncode or not answer["methods"]:
        raise RuntimeError(f"status {process.returncode} for {model}")
    return wall, used.ru_utime + used.ru_stime, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6


def run() -> dict[str, float | str]:
    """Of the slowest model, and of the largest process of all."""
    found = {name: [once(model) for _ in range(REPEATS)] for name, model in MODELS.items()}
    slowest = max(found, key=lambda name: median(wall for wall, *_ in found[name]))
    return {
        "models": len(MODELS),
        "slowest": slowest,
        "wall_s": median(wall for wall, *_ in found[slowest]),
        "processor_s": median(processor for _, processor, _ in found[slowest]),
        "fastest_wall_s": min(median(wall for wall, *_ in each) for each in found.values()),
        "peak_MB": max(memory for each in found.values() for *_, memory in each),
    }


if __name__ == "__main__":
    command(__doc__, run)
