"""Rehearsal of the 50 models, preflight to verification, at Ts = 0.1 s on one processor: plant time per wall time.

python -m benchmarks.rehearsal
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from importlib.resources import files

from benchmarks.command import command
from loopwright.service.execution.rehearsal import rehearse

TS = 0.1


def run() -> dict[str, float]:
    """Times in s; memory is the peak of the whole process, MB."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    models = json.loads((files("loopwright.plantsim") / "models-50.json").read_text())["models"]
    plant_s, proposed = 0.0, 0
    wall, processor = time.perf_counter(), time.process_time()
    for model in models:
        answer = rehearse(
            {
                "name": f"model-{model['id']}",
                "num": model["num"],
                "den": model["den"],
                "dead_time_s": model["delay"],
                "sample_time_s": TS,
            },
            "five-stage",
        )
        plant_s += sum(answer.plant_time_s.values())
        proposed += answer.ended is None
    wall_s, processor_s = time.perf_counter() - wall, time.process_time() - processor
    unit = 1 if sys.platform == "darwin" else 1024
    return {
        "models": len(models),
        "proposed": proposed,
        "plant_s": plant_s,
        "wall_s": wall_s,
        "processor_s": processor_s,
        "factor": plant_s / wall_s,
        "factor_of_processor_time": plant_s / processor_s,
        "peak_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6,
    }


if __name__ == "__main__":
    command(__doc__, run)
