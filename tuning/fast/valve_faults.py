"""Does a faulty valve explain the record better than a linear plant does?

Under a relay a dead band only makes the plant's gain smaller, and sticking does nothing: what fits well may be wrong.
The set-point step moves MV by little and both ways; there the record tells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN
from loopwright.tuning.identification.output_error import DisturbanceHypothesis, Fit, Fitted
from loopwright.tuning.models import Reals

SIZES = (0.03, 0.06, 0.11, 0.19, 0.31)  # of MV's largest move
MIN_STICTION = 0.04
"""Of MV's largest move: less is not told from a plant that is none of the structures, and does not move Ms."""
SATURATIONS, MAX_SATURATION = (0.55, 0.7, 0.85), 0.96
FIRST_STEPS, STEPS = 4, 10
REFINED = (1.25, 1.1, 1.04)
"""Factors by which the size of the likeliest fault is moved."""


@dataclass(frozen=True, slots=True)
class ValveFault:
    """fault: in words.  gain: of BIC over the best model without it."""

    fault: str
    gain: float


def backlash(u: Reals, band: float) -> Reals:
    """The valve follows `band` behind."""
    at, found = 0.0, []
    for value in u:
        at = min(max(at, value - band), value + band)
        found.append(at)
    return np.array(found)


def stiction(u: Reals, size: float) -> Reals:
    """The valve stays until MV is off by more than `size`, then jumps there."""
    at, found = 0.0, []
    for value in u:
        if abs(value - at) > size:
            at = value
        found.append(at)
    return np.array(found)


def saturation(u: Reals, size: float) -> Reals:
    """The valve goes no further."""
    return np.clip(u, -size, size)


FAULTS = {
    backlash: (SIZES, "a valve that follows about {:.2g} of MV behind"),
    stiction: (SIZES, "a valve that sticks until MV is off by about {:.2g}"),
    saturation: (SATURATIONS, "an actuator that goes about {:.2g} of MV far"),
}


def find_valve_fault(fit: Fit[ExperimentRecord], best: Fitted) -> ValveFault | None:
    """The fault that explains the record clearly better than the best model without one."""
    structure, record = best.structure, fit.record
    # at rest nobody knows where in its slack the valve stands: that is a load from the relay's start on
    slack = DisturbanceHypothesis(load_disturbances=1)
    start = np.append(best.theta[: structure.searched], record.listened)

    def under(fault: Callable[[Reals, float], Reals], size: float, theta: Reals, steps: int) -> Fitted:
        moved = Fit(replace(record, u=record.input_range * fault(fit.u, size)))
        return moved.search(structure, slack, [theta], steps)

    tried = [
        (under(fault, size, start, FIRST_STEPS), fault, size) for fault, (sizes, _) in FAULTS.items() for size in sizes
    ]
    found, fault, size = min(tried, key=_bic)
    for factor in REFINED:
        sizes = [each for each in (size / factor, size * factor) if fault is not saturation or each <= MAX_SATURATION]
        near = [(under(fault, each, found.theta, FIRST_STEPS), fault, each) for each in sizes]
        found, fault, size = min([(found, fault, size), *near], key=_bic)
    if fault is stiction and size < MIN_STICTION:
        return None
    found = under(fault, size, found.theta, STEPS)
    # that freedom alone may explain as much: MV at rest is known only as well as the noise lets it be. Or the way that
    # the search has gone: the best fit may be a local minimum
    sound = fit.search(structure, slack, [start, found.theta], FIRST_STEPS + STEPS)
    gain = min(best.bic, sound.bic) - found.bic
    return ValveFault(FAULTS[fault][1].format(size * record.input_range), gain) if gain > MIN_BIC_GAIN else None


def _bic(each: tuple[Fitted, object, float]) -> float:
    return each[0].bic
