"""Control laws in discrete time: what a controller makes of a record of set-point and PV.

    f = PV through a filter of the first order,   e = SP - f (direct action: all signs change)
    u = Kp (b SP - f) + I + D,   I(k+1) = I(k) + Kp Ts/Ti e(k),   D = Kp Td s/(1 + Tf s) (c SP - f)

The law that a device is said to have is without the filter. The other laws are those that controllers of other makers
have: every one of them is the ISA law with other gains, perhaps with the filter in front.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from loopwright.tuning.analysis.recursion import recursive
from loopwright.tuning.gains import Gains, Parallel, Series, of_parallel, of_series
from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Refused


@dataclass(frozen=True, slots=True)
class ControlLaw:
    """A control law.

    gains: the gains in ISA form that are in force.
    filter_s: the time constant of the filter between the PV on record and the PV that the law takes, s; 0 for none.
    """

    gains: Gains
    filter_s: float = 0.0

    def output(self, sp: Reals, pv: Reals, Ts: float, reverse: bool) -> Reals:
        """MV for this record, but for a constant and a start: the integral begins at zero, and filter and derivative
        at rest. sp, pv: shape (N,). Ts: the sample time, s."""
        gains = self.gains
        Kp = gains.Kp if reverse else -gains.Kp
        seen = self._filtered(pv, Ts)
        u = Kp * (gains.b * sp - seen)
        if gains.Ti > 0.0:
            u[1:] += Kp * Ts / gains.Ti * np.cumsum((sp - seen)[:-1])
        if gains.Td > 0.0:
            decay, kick = gains.Tf / (gains.Tf + Ts), Kp * gains.Td / (gains.Tf + Ts)
            moved = np.diff(gains.c * sp - seen, prepend=gains.c * sp[0] - seen[0])
            u += recursive(np.array([1.0, -decay]), kick * moved)
        return np.asarray(u)

    def poles(self, Ts: float) -> tuple[float, ...]:
        """The factors, per sample, by which what the start has left in filter and derivative falls."""
        found = []
        if self.filter_s > 0.0:
            found.append(self.filter_s / (self.filter_s + Ts))
        if self.gains.Td > 0.0:
            found.append(self.gains.Tf / (self.gains.Tf + Ts))
        return tuple(found)

    def _filtered(self, pv: Reals, Ts: float) -> Reals:
        if not self.filter_s > 0.0:
            return pv
        pole = self.filter_s / (self.filter_s + Ts)
        return np.asarray(pv[0] + recursive(np.array([1.0, -pole]), (1.0 - pole) * (pv - pv[0])))


class LawDifference(StrEnum):
    """In what a controller may differ from the law that it is said to have."""

    GAIN = "gain"
    INTEGRAL_TIME = "integral_time"
    PV_FILTER = "pv_filter"
    SETPOINT_WEIGHT = "setpoint_weight"
    DERIVATIVE_ON_ERROR = "derivative_on_error"
    PARALLEL = "parallel_form"
    SERIES = "series_form"
    NO_DERIVATIVE_FILTER = "no_derivative_filter"


@dataclass(frozen=True, slots=True)
class AlternativeLaw:
    """A law that a controller may have in place of the one that it is said to have.

    kind: in what it differs.
    law: the law for gains as they are said to be, and a size.
    sizes: sizes among which a search begins; empty where the alternative has none.
    neutral: the size at which it is the law as said.
    by_setpoint: whether it differs only where the set-point moves.
    """

    kind: LawDifference
    law: Callable[[Gains, float], ControlLaw | None]
    sizes: tuple[float, ...] = ()
    neutral: float = 1.0
    by_setpoint: bool = False


def _parallel(gains: Gains, _size: float) -> ControlLaw:
    """Ki = 1/Ti and Kd = Td, neither of them times Kp."""
    Ki = 1.0 / gains.Ti if gains.Ti > 0.0 else 0.0
    return ControlLaw(_weighted(of_parallel(Parallel(gains.Kp, Ki, gains.Td, gains.Tf)), gains))


def _series(gains: Gains, _size: float) -> ControlLaw | None:
    """Kp, Ti, Td and Tf are those of the series form."""
    try:
        found = of_series(Series(gains.Kp, gains.Ti, gains.Td, gains.Tf))
    except Refused:
        return None
    return ControlLaw(_weighted(found, gains)) if gains.Td > 0.0 and gains.Ti > 0.0 else None


def _weighted(found: Gains, gains: Gains) -> Gains:
    return replace(found, b=gains.b, c=gains.c)


def _without_filter(gains: Gains, _size: float) -> ControlLaw | None:
    return ControlLaw(replace(gains, Tf=0.0)) if gains.Td > 0.0 and gains.Tf > 0.0 else None


def _on_error(gains: Gains, size: float) -> ControlLaw | None:
    return ControlLaw(replace(gains, c=size)) if gains.Td > 0.0 else None


def _integral_time(gains: Gains, size: float) -> ControlLaw | None:
    return ControlLaw(replace(gains, Ti=size * gains.Ti)) if gains.Ti > 0.0 else None


def alternatives(said: Gains, Ts: float) -> tuple[AlternativeLaw, ...]:
    """The laws that are tried, those without a size first. said: the gains as they are said to be."""
    times = tuple(Ts * 2.0**k for k in range(-1, 11))
    factors = (0.1, 0.25, 0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0, 4.0, 10.0)
    return (
        AlternativeLaw(LawDifference.PARALLEL, _parallel),
        AlternativeLaw(LawDifference.SERIES, _series),
        AlternativeLaw(LawDifference.NO_DERIVATIVE_FILTER, _without_filter),
        AlternativeLaw(LawDifference.DERIVATIVE_ON_ERROR, _on_error, (0.0, 0.5, 1.0), said.c, by_setpoint=True),
        AlternativeLaw(
            LawDifference.SETPOINT_WEIGHT,
            lambda gains, size: ControlLaw(replace(gains, b=size)),
            (0.0, 0.5, 1.0),
            said.b,
            by_setpoint=True,
        ),
        AlternativeLaw(LawDifference.GAIN, lambda gains, size: ControlLaw(replace(gains, Kp=size * gains.Kp)), factors),
        AlternativeLaw(LawDifference.INTEGRAL_TIME, _integral_time, factors),
        AlternativeLaw(LawDifference.PV_FILTER, lambda gains, size: ControlLaw(gains, size), times, 0.0),
    )
