"""The sizes of the pulses of the manual output: PV and MV stay within what is permitted.

The first pulse has no model. Each later one is sized on all models that explain the record so far about as well: the
plant is in open loop, so that its PV is what MV has set going already, and the pulse's own part in proportion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint
from loopwright.tuning.fast.forecast import OFFSET_SAMPLES, pv_of
from loopwright.tuning.fast.pulses.levels import NOISES, RESTED, PulseBounds, candidate_models
from loopwright.tuning.models import Model, Reals
from loopwright.tuning.reasons import Refused

OF_ROOM = 0.95
"""Part of the way to MV's limits that a pulse may take: MV never stands at a limit."""
FIRST_OF_LARGEST, WITHOUT_KP = 0.5, 0.25
"""The largest first pulse, and that of a controller without a proportional part, as parts of the largest pulse."""
MAY_USE = 0.8
"""Part of the bounds that a forecast may use: the response to the first pulse shows the plant's gain to some 20 %."""
GROWTH = 4.0
"""How many times the pulse before a pulse may be: beyond that a model is an extrapolation."""
MIN_PULSE = 0.25
"""Smallest pulse worth making, as a part of the one before; PV needs more rest first."""
HORIZON = 3.0
"""Time after a pulse for which PV is simulated, in widths of the pulse, besides the length of the record so far."""


@dataclass(frozen=True, slots=True, eq=False)
class ManualRecord:
    """The record so far, as deviations from rest.

    Ts: the sample time, s.
    u, y: MV and PV, MV and PV units, shape (N,).
    begun: the sample of the first pulse.
    action: +1 for a plant whose PV must rise with MV, else -1.
    """

    Ts: float
    u: Reals
    y: Reals
    begun: int
    action: float


def largest_pulse(home: float, mv_low: float, mv_high: float, mv_step_max: float, side: float | None) -> float:
    """The largest pulse that MV's limits and its largest jump permit, MV units; 0 where there is no room.

    home: MV at rest. mv_low, mv_high, mv_step_max: as in `Facts`. All in MV units.
    side: +1 for pulses up, -1 for pulses down, None for both.
    """
    up, down = mv_high - home, home - mv_low
    room = min(up, down) if side is None else up if side > 0.0 else down
    return max(0.0, min(OF_ROOM * room, mv_step_max))


def first_pulse(kick: float, largest: float) -> float:
    """The size of the first pulse, MV units: what the proportional part of the present gains makes of the permitted
    step of the set-point, which moves PV by about that where these gains are any good.

    kick: Kp of the present gains times the permitted step. largest: the largest pulse that MV permits. In MV units.
    """
    return min(kick, FIRST_OF_LARGEST * largest) if kick > 0.0 else WITHOUT_KP * largest


def next_pulse(
    past: ManualRecord,
    side: float,
    width: int,
    bounds: PulseBounds,
    before: float,
    largest: float,
    models: Sequence[Model] = (),
) -> float:
    """The size of a pulse that begins now, MV units: as large as every model that explains the record permits; 0 where
    PV needs more rest first.

    side: +1 for a pulse up, -1 for one down. width: its length, in samples.
    before: the size of the pulse before. largest: the largest size that MV permits, MV units.
    models: these in place of those that explain the record.
    """
    first = max(past.begun - RESTED, 0)
    try:
        models = models or candidate_models(past.u[first:], past.y[first:], past.Ts, past.action)
    except Refused:
        models = ()
    if not models:
        return min(before, largest)
    samples = int(HORIZON * width) + len(past.y) - past.begun
    size = min(largest, GROWTH * before, *(_permitted(model, past, side, width, bounds, samples) for model in models))
    return size if size >= MIN_PULSE * before else 0.0


def _permitted(model: Model, past: ManualRecord, side: float, width: int, bounds: PulseBounds, samples: int) -> float:
    """The largest pulse that keeps PV within its bounds on this model, MV units; inf where the model does not move."""
    u = np.concatenate((past.u, np.zeros(samples)))
    pulse = np.zeros(samples)
    pulse[:width] = side
    modelled = pv_of(model, u, past.Ts)
    offset = float(np.mean((past.y - modelled[: len(past.y)])[-OFFSET_SAMPLES:]))
    free, moved = modelled[len(past.y) :] + offset, pv_of(model, pulse, past.Ts)
    left = NOISES * bounds.noise
    low, high = MAY_USE * bounds.pv_low + left, MAY_USE * bounds.pv_high - left
    room = np.where(moved > 0.0, high - free, free - low)
    answering = np.abs(moved) > 1e-9 * float(np.max(np.abs(moved), initial=0.0))
    return max(0.0, float(np.min(room[answering] / np.abs(moved[answering]), initial=math.inf)))


def pv_bounds(facts: Facts, point: OperatingPoint, noise: float, beyond: float) -> PulseBounds:
    """How far PV may move: by the permitted step, and within the PV limits.

    beyond: how far it may go to a side that is not permitted, in permitted steps: it may swing on its way back.
    """
    low = high = facts.sp_deviation
    if facts.one_sided:
        low, high = (low, beyond * high) if facts.side < 0.0 else (beyond * low, high)
    return PulseBounds(max(-low, facts.pv_low - point.pv), min(high, facts.pv_high - point.pv), noise)
