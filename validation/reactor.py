"""The five-stage paper's reactor, linearised at its operating point."""

from __future__ import annotations

import numpy as np
from scipy import signal

from plantsim.reactor import INLET, MV_NOMINAL, STEADY_STATE, derivative
from tuning.models import Reals, TransferFunction


def linear_reactor(lag_s: float, delay_s: float) -> TransferFunction:
    """From MV, percent, to the concentration of C, mol/m3, with the actuator's lag and the sensor's delay, s."""
    nominal = np.array(STEADY_STATE)

    def slope(state: Reals, opening: float) -> Reals:
        CA, CB, CC, h, T = (float(x) for x in state)
        return np.array(derivative((CA, CB, CC, h, T), opening, INLET))

    A = np.zeros((5, 5))
    for i, step in enumerate(1e-5 * np.abs(nominal)):
        moved = step * np.eye(5)[i]
        A[:, i] = (slope(nominal + moved, MV_NOMINAL) - slope(nominal - moved, MV_NOMINAL)) / (2.0 * step)
    B = (slope(nominal, MV_NOMINAL + 1e-3) - slope(nominal, MV_NOMINAL - 1e-3)) / 2e-3
    num, den = signal.ss2tf(A, B[:, None], np.eye(5)[2:3], np.zeros((1, 1)))
    # what differences leave of the coefficients that are zero: the relative degree is one
    kept = np.where(np.abs(num[0]) > 1e-9 * np.max(np.abs(num[0])), num[0], 0.0)
    return TransferFunction(tuple(kept), tuple(np.polymul(den, [lag_s, 1.0])), delay_s)
