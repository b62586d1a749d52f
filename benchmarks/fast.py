"""Identification, design and verdict of one record of 600 samples, against the same work written plainly.

The plain way: each of the seven structures is simulated step by step in Python (exact hold, dead time by interpolating
its whole samples) and fitted with scipy's least_squares from the same kind of starts; the PI comes from a search over
Kp and Ti of simulated step responses under a penalty on Ms.

    python -m benchmarks.fast [records]
"""

from __future__ import annotations

import math
import resource
import sys
import time
from functools import partial
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import least_squares, minimize

from benchmarks.command import parser_of, show
from loopwright.controller.channel import Channel, RelaySettings, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import evaluate
from loopwright.tuning.fast.record import ExperimentRecord, oscillation_period
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.disturbances import STRUCTURES
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.identification.structures import Structure
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode

NUM, DEN, L, TS = (1.0,), (2.0, 7.0, 7.0, 2.0), 0.53, 0.085
NOISE = 0.01
SAMPLES, LISTENED = 600, 150
REPEATS = 9
MANY = 20
DEAD_TIMES = (0.2,)
"""Periods, where the plain fit begins; ours begins at many places."""
Reals = NDArray[np.float64]


def record(seed: int = 1) -> ExperimentRecord:
    """Rest, then a biased relay."""
    span = _recorded(0.0, seed).output_range
    return _recorded(NOISE * span, seed)


def _recorded(noise: float, seed: int) -> ExperimentRecord:
    plant = LinearPlant(NUM, DEN, L, TS, noise_std=noise, seed=seed)
    channel = Channel(TS, Settings(-5.0, 5.0), Parameters(1.0), 0.0, Mode.MANUAL)
    u, y, switches = [], [], []
    for k in range(SAMPLES):
        if k == LISTENED:
            channel.start_relay(RelaySettings(1.0, 2.2 * noise, 0.0, SAMPLES, -1e9, 1e9, 0.5, 3 if noise else 1))
        y.append(plant.pv)
        u.append(channel.step(plant.pv))
        if k > LISTENED and u[-1] != u[-2]:
            switches.append(k)
        plant.step(u[-1])
    period = oscillation_period(switches)
    return ExperimentRecord(TS, np.array(u), np.array(y), 1.0, LISTENED, SAMPLES, len(switches), period)


def plain_response(structure: Structure, theta: Reals, b: Reals, u: Reals) -> Reals:
    """PV of the structure, sample by sample; time in samples."""
    monic = structure.monic(theta)
    n = len(monic)
    A = np.vstack((np.eye(n)[1:], -monic[::-1])) if n > 1 else np.array([[-monic[0]]])
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[n - 1, n] = A, 1.0
    step = expm(block)
    phi, gamma = step[:n, :n], step[:n, n]
    delay = max(float(theta[-1]), 0.0)
    whole, part = int(delay), delay - int(delay)
    C = np.zeros(n)
    C[: structure.zeros + 1] = b[: structure.zeros + 1]
    x, out = np.zeros(n), np.zeros(len(u))
    for k in range(len(u)):
        out[k] = C @ x
        now = u[k - whole] if k >= whole else 0.0
        before = u[k - whole - 1] if k > whole else 0.0
        if structure.feed_through:
            out[k] += b[structure.zeros + 1] * before
        x = phi @ x + gamma * ((1.0 - part) * now + part * before)
    return out


def plain_fit(evidence: ExperimentRecord) -> TransferFunction:
    """The structure of the least BIC, every parameter searched."""
    fit = Fit(evidence)
    found = []
    for structure in STRUCTURES:
        unit = fit.period
        logs = {1: [0.0], 2: [1.0, 1.0], 3: [1.0, 1.0, 2.5]}[structure.lags]
        powers = {1: [1.0], 2: [1.0, 2.0], 3: [1.0, 2.0, 1.0]}[structure.lags]
        best = None
        for dead_time in DEAD_TIMES:
            theta = np.append(np.array(logs) - np.array(powers) * math.log(unit), dead_time * unit)
            start = np.concatenate((theta, 0.01 * np.ones(structure.inputs), [0.0]))

            def residual(p: Reals, structure: Structure = structure) -> Reals:
                count = structure.searched
                y = plain_response(structure, p[:count], p[count:-1], fit.u)
                left: Reals = np.nan_to_num(y + p[-1] - fit.y, nan=1e3, posinf=1e3, neginf=-1e3)
                return left

            one = least_squares(residual, start, x_scale=np.maximum(np.abs(start), 0.01), max_nfev=20)
            if best is None or one.cost < best.cost:
                best = one
        assert best is not None
        N = len(fit.y)
        bic = N * math.log(2.0 * best.cost / N + 4e-8) + len(best.x) * math.log(N)
        found.append((bic, structure, best.x))
    _, structure, p = min(found, key=lambda each: each[0])
    return fit.transfer(structure, p[: structure.searched], p[structure.searched :])


def plain_design(model: TransferFunction, period: float) -> Gains:
    """Kp and Ti of the least sum of both integrals of |error|, Ms at most 1.6 by a penalty."""
    dt = period / 80.0

    def integral(gains: Gains, load: bool) -> float:
        plant = LinearPlant(model.num, model.den, model.L, dt)
        total, integrated, y = 0.0, 0.0, 0.0
        for _ in range(1600):
            error = -y if load else 1.0 - y
            integrated += error * dt / gains.Ti
            y = plant.step(gains.Kp * (error + integrated) + (1.0 if load else 0.0))
            total += abs(error) * dt
        return total

    def cost(x: Reals) -> float:
        gains = Gains(float(np.exp(x[0])), float(np.exp(x[1])))
        found = margins(model, gains)
        if not found.stable:
            return 1e3
        return integral(gains, False) + integral(gains, True) + 1e3 * max(0.0, found.Ms - 1.6)

    found = minimize(cost, np.log([0.5, 0.5 * period]), method="Nelder-Mead", options={"maxfev": 60})
    return Gains(float(np.exp(found.x[0])), float(np.exp(found.x[1])))


def run(records: int = MANY) -> dict[str, float]:
    """Times in s of processor; memory in MB of the whole process."""
    evidence = record()
    spec = DesignSpec(1.6)
    evaluate(evidence, spec)
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        ours = evaluate(evidence, spec)
        times.append(time.process_time() - start)
    start = time.process_time()
    model = plain_fit(evidence)
    gains = plain_design(model, evidence.period * TS)
    plain_s = time.process_time() - start
    unit = 1 if sys.platform == "darwin" else 1024
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    for seed in range(records):
        evaluate(record(seed + 1), spec)
    each_s = (time.process_time() - start) / records
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    true = TransferFunction(NUM, DEN, L + 0.5 * TS)
    return {
        "samples": SAMPLES,
        "ours_s": median(times),
        "plain_s": plain_s,
        "ratio": plain_s / median(times),
        "ours_Ms": margins(true, ours.best.gains).Ms,
        "plain_Ms": margins(true, gains).Ms,
        "records": records,
        "each_s": each_s,
        "grown_MB": (after - before) * unit / 1e6,
    }


if __name__ == "__main__":
    parser = parser_of(__doc__)
    parser.add_argument("records", type=int, nargs="?", default=MANY, help="one after the other (default: %(default)s)")
    show(partial(run, parser.parse_args().records))
