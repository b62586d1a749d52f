"""The levels of the set-point's pulses that follow a model: PV and MV stay within what is permitted.

A pulse that turns while PV still moves swings a loop that is nearly unstable further than the set-point itself. All
models that explain the record so far about as well are asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.fast.forecast import Course, Past, SetpointTurn, forecast
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.disturbances import by_bic
from loopwright.tuning.identification.output_error import UNDISTURBED
from loopwright.tuning.identification.problem import IdentificationProblem
from loopwright.tuning.identification.record import recorded_test
from loopwright.tuning.identification.structures import FIRST, INTEGRATOR, LAGGED_INTEGRATOR, SECOND, Structure
from loopwright.tuning.models import Model, Reals, sign
from loopwright.tuning.reasons import Refused

MIN_FOLLOWED = 0.2
"""A pulse turns when PV has followed this fraction of the set-point's move."""
FOLLOWED_TO_ONE_SIDE, CAME_BACK = 0.4, 0.5
"""Where the set-point may go to one side of its rest only: the fraction of the first move that PV follows before the
set-point goes back, and the fraction of the way back that PV has come before the last pulse."""
STRUCTURES = (FIRST, SECOND, INTEGRATOR, LAGGED_INTEGRATOR)
CLOSE_BIC = 10.0
"""Difference of BIC within which a model is asked besides the best one."""
LEVELS = np.linspace(1.0, 0.0, 21)
"""The sizes that are tried for a level, in sizes of the first pulse, the one wanted first."""
MIN_LEVEL = 0.2
"""Smallest size of the second level."""
HORIZON_OF_SECOND, HORIZON_OF_LAST = 4.0, 2.0
"""Time that is simulated, in lengths of the record since the first pulse."""
SECOND_MAY_USE, LAST_MAY_USE = 0.8, 0.95
"""Part of the bounds that a forecast may use: the rise of the first pulse alone shows the plant's gain to some 20 %."""
RESTED = 30
"""Number of samples at rest before the pulses that the models are fitted to as well."""
WITHOUT_A_MODEL = 0.5
"""A level where no model can be fitted."""
NOISES = 2.0
"""Distance from the bounds that is left to the noise, in its standard deviations."""


@dataclass(frozen=True, slots=True)
class PulseBounds:
    """How far PV may move from rest, PV units.

    pv_low, pv_high: the bounds of PV, as deviations from rest.
    noise: the standard deviation of the noise of PV.
    """

    pv_low: float
    pv_high: float
    noise: float


def candidate_models(
    u: Reals, y: Reals, Ts: float, action: float, structures: Sequence[Structure] = STRUCTURES
) -> list[Model]:
    """The models of lags that explain a record about as well as the best one, the best one first.

    u, y: MV and PV as deviations from rest, shape (N,). Ts: the sample time, s.
    action: the sign that the plant's gain must have.
    Raises Refused as `recorded_test`.
    """
    problem = IdentificationProblem(recorded_test(Ts * np.arange(len(u)), u, y, 0.0))
    ranked = sorted((problem.fit(structure, UNDISTURBED) for structure in structures), key=by_bic)
    found = [(fit.bic, problem.model(fit)) for fit in ranked]
    right = [(bic, model) for bic, model in found if sign(model) == action]
    return [model for bic, model in right if bic <= right[0][0] + CLOSE_BIC]


def second_level(past: Past, begun: int, size: float, bounds: PulseBounds, models: Sequence[Model] = ()) -> float:
    """The level of the second pulse, in sizes of the first: negative, and as far from rest as every candidate model
    permits. The third level, which PV calls for when it has followed, is then one that suits.

    past: the record so far. begun: the sample of the first pulse. size: the size of the first pulse, PV units.
    models: these in place of those that explain the record.
    """
    second = LEVELS[LEVELS >= MIN_LEVEL - 1e-9]
    third = LEVELS[::5]
    down, up = (each.ravel() for each in np.meshgrid(-second, third, indexing="ij"))
    at = float(np.mean(past.pv[-3:])) - MIN_FOLLOWED * (1.0 - down) * size

    def excess(model: Model, samples: int) -> Reals:
        course = forecast(model, past, past.gains, size * down, samples, SetpointTurn(at, False, size * up))
        found = _excess(course, past, bounds, SECOND_MAY_USE).reshape(len(second), len(third))
        return np.asarray(found.min(axis=1))

    return -_largest(second, past, begun, HORIZON_OF_SECOND, excess, models)


def back_level(past: Past, begun: int, size: float, bounds: PulseBounds, models: Sequence[Model] = ()) -> float:
    """The level after the first pulse where the set-point may go to one side of its rest only, in sizes of the first
    pulse: as near to rest as every candidate model permits. The arguments are those of `second_level`; the size is
    negative where the set-point goes down."""
    swings = LEVELS[LEVELS >= MIN_LEVEL - 1e-9]
    last = LEVELS[LEVELS >= MIN_LEVEL - 1e-9][::4]
    back, again = (each.ravel() for each in np.meshgrid(1.0 - swings, last, indexing="ij"))
    now = float(np.mean(past.pv[-3:]))
    at = now - CAME_BACK * (now - back * size)

    def excess(model: Model, samples: int) -> Reals:
        turn = SetpointTurn(at, size < 0.0, size * again)
        course = forecast(model, past, past.gains, size * back, samples, turn)
        found = _excess(course, past, bounds, SECOND_MAY_USE).reshape(len(swings), len(last))
        return np.asarray(found.min(axis=1))

    return 1.0 - _largest(swings, past, begun, HORIZON_OF_SECOND, excess, models)


def last_level_of_one_side(
    past: Past, begun: int, size: float, bounds: PulseBounds, models: Sequence[Model] = ()
) -> float:
    """The level of the last pulse where the set-point may go to one side of its rest only, see `last_level`. It is
    never at rest: the step home begins there."""
    return _last_level(LEVELS[LEVELS >= MIN_LEVEL - 1e-9], past, begun, size, bounds, models)


def last_level(past: Past, begun: int, size: float, bounds: PulseBounds, models: Sequence[Model] = ()) -> float:
    """The level of the last pulse, in sizes of the first: the largest at which every candidate model keeps PV and MV
    within bounds, or the one that leaves them least. The arguments are those of `second_level`."""
    return _last_level(LEVELS, past, begun, size, bounds, models)


def _last_level(
    levels: Reals, past: Past, begun: int, size: float, bounds: PulseBounds, models: Sequence[Model]
) -> float:
    def excess(model: Model, samples: int) -> Reals:
        return _excess(forecast(model, past, past.gains, size * levels, samples), past, bounds, LAST_MAY_USE)

    return _largest(levels, past, begun, HORIZON_OF_LAST, excess, models)


def step_fits(past: Past, models: Sequence[Model], gains: Gains, home: float, noise: float, samples: int) -> bool:
    """Whether MV stays within its limits on every model when these gains take over and bring the set-point home.

    home: the set-point after the step, as a deviation from rest, PV units. noise: the standard deviation of PV's noise.
    samples: the number of samples to look ahead.
    """
    left = NOISES * noise * gains.Kp
    courses = (forecast(model, past, gains, np.array([home]), samples).mv for model in models)
    return all(bool(np.all((mv > past.low + left) & (mv < past.high - left))) for mv in courses)


def _largest(
    levels: Reals,
    past: Past,
    begun: int,
    horizon: float,
    excess: Callable[[Model, int], Reals],
    models: Sequence[Model],
) -> float:
    """The first of the levels without an excess on any candidate model, or the one with the least."""
    models = models or _explaining(past, begun)
    if not models:
        return WITHOUT_A_MODEL
    samples = int(horizon * (len(past.pv) - begun))
    worst = np.max([excess(model, samples) for model in models], axis=0)
    within = np.flatnonzero(worst <= 0.0)
    return float(levels[within[0] if len(within) else np.argmin(worst)])


def _explaining(past: Past, begun: int) -> list[Model]:
    first = max(begun - RESTED, 0)
    # at rest only the noise moves MV, in which a model of so short a record would find what it needs
    mv = np.where(np.arange(len(past.mv)) < begun, 0.0, past.mv)
    try:
        return candidate_models(mv[first:], past.pv[first:], past.Ts, past.action)
    except Refused:
        return []


def _excess(course: Course, past: Past, bounds: PulseBounds, part: float) -> Reals:
    """By how much PV or MV leaves this part of its bounds at worst, as a fraction of their width; shape (moves,)."""
    left = NOISES * bounds.noise
    found = []
    for values, low, high, margin in (
        (course.pv, bounds.pv_low, bounds.pv_high, left),
        (course.mv, past.low, past.high, left * past.gains.Kp),
    ):
        outside = np.maximum(values - part * high, part * low - values).max(axis=0) + margin
        found.append(outside / (high - low))
    return np.asarray(np.max(found, axis=0))
