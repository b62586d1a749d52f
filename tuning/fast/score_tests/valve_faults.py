"""A test whether a faulty valve explains the record better than a linear plant with a perfect valve.

Under a relay, backlash only makes the plant's gain look smaller, and stiction has no effect: a model that fits well may
be wrong. The set-point step moves MV by small amounts in both directions, and there the record shows the fault.
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
SIZES_OF_STICTION = (0.01, 0.014, 0.02, 0.028, *SIZES[1:], 0.04, 0.085, 0.15)
"""Those of stiction: a level goes on moving for as long as the valve stands a little off."""
SMALL_STICTION, MIN_BIC_GAIN_OF_SMALL = 0.04, 30.0
"""The stiction, as a fraction of the largest deviation of MV, below which it must lower BIC by more: a plant that is
none of the structures looks a little like it."""
SATURATIONS, MAX_SATURATION = (0.55, 0.7, 0.85), 0.96
FIRST_STEPS, STEPS = 4, 10
REFINED = (1.25, 1.1, 1.04)
"""Factors by which the size of the likeliest fault is refined."""


@dataclass(frozen=True, slots=True)
class ValveFault:
    """A fault of the valve that the record shows.

    fault: the fault in words, with its size.
    gain: by how much the fault lowers BIC below the best model without it.
    """

    fault: str
    gain: float


def backlash(u: Reals, band: float) -> Reals:
    """The position of a valve with backlash: it follows MV at a distance of up to `band`. u: MV, shape (N,)."""
    at, found = 0.0, []
    for value in u.tolist():  # much faster than the elements of an array
        at = min(max(at, value - band), value + band)
        found.append(at)
    return np.array(found)


def stiction(u: Reals, size: float) -> Reals:
    """The position of a valve with stiction: it stays until MV differs by more than `size`, then jumps to MV."""
    at, found = 0.0, []
    for value in u.tolist():
        if abs(value - at) > size:
            at = value
        found.append(at)
    return np.array(found)


def saturation(u: Reals, size: float) -> Reals:
    """The position of an actuator that goes no further than `size` in either direction."""
    return np.clip(u, -size, size)


Fault = Callable[[Reals, float], Reals]
"""The position of a valve from MV, shape (N,), and the size of its fault."""

FAULTS: dict[Fault, tuple[tuple[float, ...], str]] = {
    backlash: (SIZES, "a valve that follows about {:.2g} of MV behind"),
    stiction: (SIZES_OF_STICTION, "a valve that sticks until MV is off by about {:.2g}"),
    saturation: (SATURATIONS, "an actuator that goes about {:.2g} of MV far"),
}


def find_valve_fault(fit: Fit[ExperimentRecord], best: Fitted) -> ValveFault | None:
    """The valve fault that explains the record clearly better than the best model without one, None if there is none.

    A fault must lower BIC by more than MIN_BIC_GAIN, a small stiction by more than MIN_BIC_GAIN_OF_SMALL.
    """
    structure, record = best.structure, fit.record
    # The position of the valve within its backlash is unknown at rest; it acts as a load disturbance from the start of
    # the relay.
    slack = DisturbanceHypothesis(load_disturbances=1)
    start = np.append(best.theta[: structure.searched], record.listened)

    def fitted_with(fault: Fault, size: float, theta: Reals, steps: int) -> Fitted:
        return Fit(_with_fault(record, fault, size)).search(structure, slack, [theta], steps)

    tried = [
        (fitted_with(fault, size, start, FIRST_STEPS), fault, size)
        for fault, (sizes, _) in FAULTS.items()
        for size in sizes
    ]
    found, fault, size = min(tried, key=_bic)
    for factor in REFINED:
        sizes = [each for each in (size / factor, size * factor) if fault is not saturation or each <= MAX_SATURATION]
        near = [(fitted_with(fault, each, found.theta, FIRST_STEPS), fault, each) for each in sizes]
        found, fault, size = min([(found, fault, size), *near], key=_bic)
    found = fitted_with(fault, size, found.theta, STEPS)
    # The free load disturbance alone may explain as much, as MV at rest is known only within the noise. So may the
    # better start, as the best fit may be a local minimum. The perfect valve is therefore fitted with both.
    sound = fit.search(structure, slack, [start, found.theta], FIRST_STEPS + STEPS)
    gain = min(best.bic, sound.bic) - found.bic
    minimum = MIN_BIC_GAIN_OF_SMALL if fault is stiction and size < SMALL_STICTION else MIN_BIC_GAIN
    return ValveFault(FAULTS[fault][1].format(size * record.input_range), gain) if gain > minimum else None


def _with_fault(record: ExperimentRecord, fault: Fault, size: float) -> ExperimentRecord:
    """The record with the position of such a valve for MV, which is followed from where MV of each piece is known."""
    scale, pieces = record.input_range, np.split(record.u, np.cumsum(record.pieces)[:-1])
    earlier = record.u_earlier or (np.empty(0),) * len(pieces)
    whole = [scale * fault(np.append(before, u) / scale, size) for before, u in zip(earlier, pieces, strict=True)]
    parts = [np.split(u, [len(before)]) for u, before in zip(whole, earlier, strict=True)]
    return replace(record, u=np.concatenate([u for _, u in parts]), u_earlier=tuple(before for before, _ in parts))


def _bic(each: tuple[Fitted, object, float]) -> float:
    return each[0].bic
