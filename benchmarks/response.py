"""Step figures of one plant under PI: ours against python-control's simulation of the same loop, in one run.

The loop has a closed form: the PI cancels the lag, what is left is c*exp(-s)/s with time in dead times, whose response
is a finite sum at any time. Both record 10,000 samples, 500 to the dead time, and take IAE, ISE, ITAE, overshoot, rise
and settling from them; the plain one has a fifth-order Pade approximant of the dead time.

    python -m benchmarks.response
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from statistics import median

import control
import numpy as np
from scipy.integrate import trapezoid

from benchmarks.command import command
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.analysis.step_response import step_figures, step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Reals

MODEL = FOPDT(K=2.0, T=5.0, L=2.5)
C = 6.0 - 4.0 * math.sqrt(2.0)
"""Loop gain per dead time of the direct-synthesis rule: no overshoot."""
GAINS = Gains(Kp=C * MODEL.T / (MODEL.K * MODEL.L), Ti=MODEL.T)
SAMPLES, PER_DEAD_TIME = 10_000, 500
PADE_ORDER = 5
DT = MODEL.L / PER_DEAD_TIME
T = np.arange(SAMPLES + 1) * DT


def exact() -> Reals:
    """The response: the error is the sum over k < x of (-c)^k (x-k)^k / k!, with x the time in dead times."""
    x = T / MODEL.L
    y = np.ones_like(x)
    for k in range(math.ceil(x[-1]) + 1):
        y -= np.where(x >= k, (-C) ** k * np.maximum(x - k, 0.0) ** k / math.factorial(k), 0.0)
    return y


def figures(y: Reals) -> dict[str, float]:
    e = 1.0 - y
    outside = np.flatnonzero(np.abs(e) > 0.02)
    return {
        "IAE": float(trapezoid(np.abs(e), T)),
        "ISE": float(trapezoid(e * e, T)),
        "ITAE": float(trapezoid(T * np.abs(e), T)),
        "overshoot_pct": max(0.0, 100.0 * (float(np.max(y)) - 1.0)),
        "rise_s": float(T[np.argmax(y >= 0.9)] - T[np.argmax(y >= 0.1)]),
        "settling_s": float(T[outside[-1] + 1]),
    }


def ours() -> StepFigures:
    return step_figures(MODEL, GAINS, horizon=SAMPLES * DT, dt=DT)


def plain_response() -> Reals:
    plant = control.tf([MODEL.K], [MODEL.T, 1.0]) * control.tf(*control.pade(MODEL.L, PADE_ORDER))
    pi = control.tf([GAINS.Kp * GAINS.Ti, GAINS.Kp], [GAINS.Ti, 0.0])
    return np.asarray(control.step_response(control.feedback(plant * pi, 1), T).outputs)


def plain() -> dict[str, float]:
    return figures(plain_response())


def timed(call: Callable[[], object], repeats: int) -> float:
    """Least processor time, s, of this thread alone: spinning threads of a BLAS count for nobody."""
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        call()
        times.append(time.thread_time() - start)
    return min(times)


def run(rounds: int = 10) -> dict[str, float]:
    """Median times in s and median ratio of rounds in which both take turns, and the errors against the closed form.

    The error of y is its largest, the error of ITAE relative.
    """
    ours(), plain()  # the first call pays for imports and caches
    times = [(timed(ours, 10), timed(plain, 3)) for _ in range(rounds)]
    y, itae = exact(), figures(exact())["ITAE"]
    return {
        "ours_s": median(a for a, _ in times),
        "plain_s": median(b for _, b in times),
        "ratio": median(b / a for a, b in times),
        "ours_y_error": float(np.max(np.abs(step_response(MODEL, GAINS, SAMPLES * DT, DT).y - y))),
        "plain_y_error": float(np.max(np.abs(plain_response() - y))),
        "ours_ITAE_error": abs(ours().ITAE / itae - 1.0),
        "plain_ITAE_error": abs(plain()["ITAE"] / itae - 1.0),
    }


if __name__ == "__main__":
    command(__doc__, run)
