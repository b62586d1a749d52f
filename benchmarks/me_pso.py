"""ME-PSO with the paper's budget: 50 particles, 50 iterations, 2,500 simulated step responses.

Without dead time 1/(s+1)^3, with it exp(-s)/(0.5s+1)^2, the error weighting, no bound on Ms, the paper's domains and
horizons, 6,000 samples a response. Wall-clock times; the particles of an iteration are simulated together.

    python -m benchmarks.me_pso
"""

from __future__ import annotations

import time
from statistics import median

from benchmarks.command import command
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.rules.me_pso import me_pso

WITHOUT = TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0))
WITH = TransferFunction((1.0,), (0.25, 1.0, 1.0), 1.0)
REPEATS = 5


def timed(model: TransferFunction, horizon_s: float, Ki_min: float) -> tuple[float, float, float]:
    """(median s, evaluations, criterion found)."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        found = me_pso(model, Ms_max=0.0, horizon_s=horizon_s, Kp_max=10.0, Ki_min=Ki_min)
        times.append(time.perf_counter() - start)
    return median(times), found.chosen["evaluations"], found.chosen["criterion"]


def run() -> dict[str, float]:
    """Seconds of a whole tuning, evaluations and the criterion found, without and with dead time."""
    without, evaluations, criterion = timed(WITHOUT, 60.0, 0.1)
    with_it, evaluations_with, criterion_with = timed(WITH, 80.0, 0.05)
    return {
        "no_dead_time_s": without,
        "no_dead_time_evaluations": evaluations,
        "no_dead_time_criterion": criterion,
        "dead_time_s": with_it,
        "dead_time_evaluations": evaluations_with,
        "dead_time_criterion": criterion_with,
    }


if __name__ == "__main__":
    command(__doc__, run)
