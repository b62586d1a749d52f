"""A transfer function as process gain, time constants and dead time, the parameters that manuals of controllers have.

K (Tz s + 1) exp(-L s) / ((T1 s + 1) (T2 s + 1)), with T and zeta in place of T1 and T2 for a pair of complex poles, and
Kv / s in place of K and the slowest lag of an integrating process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.models import Reals

_STEP = 1e-6
"""Relative step of the differences from which errors are propagated."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a process model.

    name: K, Kv, T, T1, T2, zeta, Tz or L.
    error: the standard error; None without a covariance.
    unit: PV/MV, PV/(MV s), s, or empty.
    """

    name: str
    value: float
    error: float | None
    unit: str


def parameters(
    num: Sequence[float],
    den: Sequence[float],
    dead_time_s: float,
    integrating: bool,
    covariance: Sequence[Sequence[float]] | None = None,
) -> list[Parameter]:
    """Returns the parameters of num(s)/den(s) exp(-dead_time_s s), K first and L last; none where the model has a pole
    on the right, or more than one zero.

    num, den: by falling powers of s; den begins with 1.
    integrating: whether the pole nearest to zero is taken for one at zero.
    covariance: of num, of den without its leading 1, and of the dead time; None: unknown.
    """
    at = np.array([*num, *den[1:], dead_time_s], dtype=float)
    count = len(num)
    found = _values(at, count, integrating)
    if not found:
        return []
    errors: list[float | None] = [None] * len(found)
    if covariance is not None:
        slopes = np.empty((len(found), len(at)))
        for n, value in enumerate(at):
            step = _STEP * (abs(value) or 1.0)
            beside = at.copy()
            beside[n] += step
            moved = _values(beside, count, integrating)
            if [name for name, *_ in moved] != [name for name, *_ in found]:
                return [Parameter(name, value, None, unit) for name, value, unit in found]
            slopes[:, n] = [(b[1] - a[1]) / step for a, b in zip(found, moved, strict=True)]
        variances = np.einsum("ij,jk,ik->i", slopes, np.asarray(covariance, dtype=float), slopes)
        errors = [float(np.sqrt(max(0.0, each))) for each in variances]
    return [Parameter(name, value, error, unit) for (name, value, unit), error in zip(found, errors, strict=True)]


def _values(at: Reals, count: int, integrating: bool) -> list[tuple[str, float, str]]:
    num, den = at[:count], np.array([1.0, *at[count:-1]])
    if count > 2 or num[-1] == 0.0:
        return []
    lags = den[:-1] if integrating else den
    if lags[-1] == 0.0 or len(lags) > 3:
        return []
    poles = np.roots(lags)
    if np.any(poles.real >= 0.0):
        return []
    gain = float(num[-1] / lags[-1])
    found = [("Kv", gain, "PV/(MV s)") if integrating else ("K", gain, "PV/MV")]
    if len(poles) == 2 and np.iscomplex(poles[0]):
        size = float(abs(poles[0]))
        found += [("T", 1.0 / size, "s"), ("zeta", float(-poles[0].real / size), "")]
    else:
        times = sorted((float(-1.0 / pole.real) for pole in poles), reverse=True)
        names = ["T"] if len(times) == 1 else ["T1", "T2"]
        found += [(name, time, "s") for name, time in zip(names, times, strict=False)]
    if count == 2:
        found.append(("Tz", float(num[0] / num[1]), "s"))
    return [*found, ("L", float(at[-1]), "s")]
