"""Does a faulty valve explain the record better than a linear plant does?

Under a relay a dead band only makes the plant's gain smaller, and sticking does nothing: what fits well may be wrong.
The set-point step moves MV by little and both ways; there the record tells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.fast.record import Evidence
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN
from loopwright.tuning.identification.output_error import Fit, Fitted, Hypothesis
from loopwright.tuning.models import Reals

SIZES = (0.03, 0.06, 0.11, 0.19, 0.31)  # of MV's largest move
MIN_STICK = 0.04
"""Of MV's largest move: less is not told from a plant that is none of the structures, and does not move Ms."""
ENDS, WIDEST_END = (0.55, 0.7, 0.85), 0.96
FIRST_STEPS, STEPS = 4, 10
REFINED = (1.25, 1.1, 1.04)
"""Factors by which the size of the likeliest fault is moved."""


@dataclass(frozen=True, slots=True)
class Suspicion:
    """fault: in words.  gain: of BIC over the best model without it."""

    fault: str
    gain: float


def play(u: Reals, band: float) -> Reals:
    """The valve follows `band` behind."""
    at, found = 0.0, []
    for value in u:
        at = min(max(at, value - band), value + band)
        found.append(at)
    return np.array(found)


def stick(u: Reals, size: float) -> Reals:
    """The valve stays until MV is off by more than `size`, then jumps there."""
    at, found = 0.0, []
    for value in u:
        if abs(value - at) > size:
            at = value
        found.append(at)
    return np.array(found)


def end(u: Reals, size: float) -> Reals:
    """The valve goes no further."""
    return np.clip(u, -size, size)


FAULTS = {
    play: (SIZES, "a valve that follows about {:.2g} of MV behind"),
    stick: (SIZES, "a valve that sticks until MV is off by about {:.2g}"),
    end: (ENDS, "an actuator that goes about {:.2g} of MV far"),
}


def suspect(fit: Fit[Evidence], best: Fitted) -> Suspicion | None:
    """The fault that explains the record clearly better than the best model without one."""
    structure, evidence = best.structure, fit.evidence
    # at rest nobody knows where in its slack the valve stands: that is a load from the relay's start on
    slack = Hypothesis(loads=1)
    start = np.append(best.theta[: structure.searched], evidence.listened)

    def under(fault: Callable[[Reals, float], Reals], size: float, theta: Reals, steps: int) -> Fitted:
        moved = Fit(replace(evidence, u=evidence.swing * fault(fit.u, size)))
        return moved.search(structure, slack, [theta], steps)

    tried = [
        (under(fault, size, start, FIRST_STEPS), fault, size) for fault, (sizes, _) in FAULTS.items() for size in sizes
    ]
    found, fault, size = min(tried, key=_bic)
    for factor in REFINED:
        sizes = [each for each in (size / factor, size * factor) if fault is not end or each <= WIDEST_END]
        near = [(under(fault, each, found.theta, FIRST_STEPS), fault, each) for each in sizes]
        found, fault, size = min([(found, fault, size), *near], key=_bic)
    if fault is stick and size < MIN_STICK:
        return None
    found = under(fault, size, found.theta, STEPS)
    # that freedom alone may explain as much: MV at rest is known only as well as the noise lets it be. Or the way that
    # the search has gone: the best fit may be a local minimum
    sound = fit.search(structure, slack, [start, found.theta], FIRST_STEPS + STEPS)
    gain = min(best.bic, sound.bic) - found.bic
    return Suspicion(FAULTS[fault][1].format(size * evidence.swing), gain) if gain > MIN_BIC_GAIN else None


def _bic(each: tuple[Fitted, object, float]) -> float:
    return each[0].bic
