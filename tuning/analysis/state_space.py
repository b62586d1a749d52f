"""The rational part of a model as a balanced state space, and models scaled in time and gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import companion, matrix_balance

from loopwright.tuning.models import Model, Reals, TransferFunction, integrators, monic, sign, time_constants


@dataclass(frozen=True, slots=True)
class StateSpace:
    """The state space x' = a x + b u, y = c x + d u, with a of shape (n, n), b and c of shape (n,), and d a number."""

    a: Reals
    b: Reals
    c: Reals
    d: float

    def rest(self) -> tuple[Reals, float]:
        """The state x and the input u at which the output rests at 1; the plant must have no zero at the origin."""
        n = len(self.b)
        system = np.block([[self.a, self.b[:, None]], [self.c[None, :], np.array([[self.d]])]])
        found = np.linalg.solve(system, np.eye(n + 1)[n])
        return found[:n], float(found[n])


def time_sum(model: Model) -> float:
    """The sum of all lags and of the dead time, s; 0 for a pure integrator."""
    return float(time_constants(model).sum()) + model.L


def gain_unit(model: Model, time_unit: float) -> float:
    """|K| of a self-regulating model, PV units per MV unit; for an integrating model the rise of PV within one time
    unit (s) per MV unit."""
    slowest = np.trim_zeros(np.asarray(model.den), "b")[-1]
    return abs(float(model.num[-1] / slowest)) * time_unit ** integrators(model)


def normalised(model: Model, time_unit: float) -> TransferFunction:
    """The same plant with a gain of one and with its time in units of time_unit, s."""
    scale = sign(model) / gain_unit(model, time_unit)
    num = [c * scale * time_unit**-i for i, c in enumerate(reversed(model.num))]
    den = [c * time_unit**-i for i, c in enumerate(reversed(model.den))]
    return TransferFunction(tuple(reversed(num)), tuple(reversed(den)), model.L / time_unit)


def state_space(model: Model) -> StateSpace:
    """Returns the state space of the model without its dead time, see `canonical_form`."""
    return canonical_form(*monic(model))


def canonical_form(num: Reals, den: Reals) -> StateSpace:
    """Returns the controller canonical form of num/den; balancing keeps very different lags well conditioned.

    num, den: of the same length, highest power first; den begins with 1.
    """
    balanced, (scale, _) = matrix_balance(companion(den), permute=False, separate=True)
    b = np.zeros(len(den) - 1)
    b[0] = 1.0 / scale[0]
    return StateSpace(np.asarray(balanced), b, (num[1:] - den[1:] * num[0]) * scale, float(num[0]))
