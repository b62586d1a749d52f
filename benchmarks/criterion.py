"""The robust PI: ours against the same minimisation written plainly on python-control and scipy, in one run.

The plain one is what an engineer writes in an afternoon: a Pade approximation of the dead time, `control.step_response`
for each of the eight corners, the margins from the frequency response, `scipy.optimize.minimize`.

    python -m benchmarks.criterion
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import product

import control
import numpy as np
from scipy.integrate import trapezoid
from scipy.optimize import minimize

from benchmarks.command import command
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Reals
from loopwright.tuning.rules.robust_pi import UNSTABLE, Criterion, Optimum, optimise

MODEL = FOPDT(K=2.0, T=5.0, L=2.5)
HORIZON_S = 40.0
PADE_ORDER = 5
POINTS = 2001  # a hundredth of the shortest dead time, as the criterion asks


def plain_criterion(model: FOPDT, horizon: float) -> Callable[[float, float], float]:
    """Criterion (7) on python-control: ITAE in s^2, overshoot as a fraction, Ms on 300 points, weights 10, 1, 10."""
    corners = []
    for k, lag, dead in product((0.8, 1.2), repeat=3):
        L = dead * model.L
        lagged = control.tf([k * model.K], [lag * model.T, 1.0])
        corners.append((lagged, lagged * control.tf(*control.pade(L, PADE_ORDER)), L))
    t = np.linspace(0.0, horizon, POINTS)

    def J(Kp: float, Ti: float) -> float:
        pi = control.tf([Kp * Ti, Kp], [Ti, 0.0])
        worst = 0.0
        for lagged, plant, L in corners:
            loop = plant * pi
            closed = control.feedback(loop, 1)
            y = control.step_response(closed, t).outputs
            jw = 1j * np.geomspace(0.02 / L, 20.0 / L, 300)
            ms = float(np.max(1.0 / np.abs(1.0 + lagged(jw) * np.exp(-L * jw) * pi(jw))))
            itae = float(trapezoid(t * np.abs(1.0 - y), t))
            pole = float(np.max(closed.poles().real))
            worst = max(worst, UNSTABLE * (1.0 + pole) if pole >= 0.0 else 0.0)
            worst = max(worst, 10.0 * itae + max(0.0, float(np.max(y)) - 1.0) + 10.0 * ms)
        return worst

    return J


def plain_optimise(model: FOPDT, horizon: float) -> Optimum:
    """Nelder-Mead from the Ziegler-Nichols PI with one restart, as ours."""
    J = plain_criterion(model, horizon)

    def cost(x: Reals) -> float:
        return J(float(np.exp(x[0])), float(np.exp(x[1])))

    Ku, Pu = ultimate_point(model)
    x: Reals = np.log(np.array([Ku / 2.2, Pu / 1.2]))
    while (value := cost(x)) >= UNSTABLE:
        x = x + np.array([np.log(0.7), 0.0])
    evaluations = 0
    for size in (0.15, 0.03):
        simplex = x + np.array([[0.0, 0.0], [size, 0.0], [0.0, size]])
        found = minimize(
            cost,
            x,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 5e-4, "fatol": 1e-5 * value, "maxfev": 200},
        )
        x, value, evaluations = np.asarray(found.x), float(found.fun), evaluations + int(found.nfev)
    return Optimum(Gains(Kp=float(np.exp(x[0])), Ti=float(np.exp(x[1]))), value, evaluations)


def run(repeats: int = 20) -> dict[str, float]:
    """Processor times in s (ours: median), their ratio, and both results, each judged by both criteria."""
    optimise(MODEL, horizon_s=HORIZON_S)  # the first call pays for imports and caches
    times = []
    for _ in range(repeats):
        start = time.process_time()
        ours = optimise(MODEL, horizon_s=HORIZON_S)
        times.append(time.process_time() - start)
    start = time.process_time()
    plain = plain_optimise(MODEL, HORIZON_S)
    plain_s = time.process_time() - start
    fast_J, plain_J = Criterion(MODEL, HORIZON_S), plain_criterion(MODEL, HORIZON_S)
    ours_s = float(np.median(times))
    return {
        "ours_s": ours_s,
        "plain_s": plain_s,
        "ratio": plain_s / ours_s,
        "ours_evaluations": ours.evaluations,
        "plain_evaluations": plain.evaluations,
        "ours_Kp": ours.gains.Kp,
        "ours_Ti_s": ours.gains.Ti,
        "plain_Kp": plain.gains.Kp,
        "plain_Ti_s": plain.gains.Ti,
        "J_of_ours": ours.J,
        "J_of_plain": fast_J(plain.gains.Kp, plain.gains.Ti),
        "J_of_ours_on_pade": plain_J(ours.gains.Kp, ours.gains.Ti),
        "J_of_plain_on_pade": plain.J,
    }


if __name__ == "__main__":
    command(__doc__, run)
