"""Whether the T95 of a loop in its configuration is that of the model that a job has found."""

from __future__ import annotations

import math

import numpy as np

from loopwright.tuning.models import Model, integrators, time_constants

MAX_RATIO = 4.0
"""Largest ratio of the two. T95 of a model is known to a factor of two: a record tells little of a slow part."""
LONGEST = 10.0
"""T95 of a model, in lengths of its record, above which the record tells nothing of it: the plant, a level mostly,
integrates as far as was seen."""


def t95_of(model: Model) -> float | None:
    """Returns about the time in which PV covers 95 % of a step, s: dead time and three times the sum of the lags; None
    for a plant that integrates."""
    return None if integrators(model) else float(model.L + 3.0 * np.sum(time_constants(model)))


def t95_mismatch(model: Model, t95_s: float, record_s: float = math.inf) -> str | None:
    """Returns what is to be corrected where T95 is far from that of the model; None where it is not.

    t95_s: T95 of the configuration, s.
    record_s: how long the record is that shows the model, s.
    """
    found = t95_of(model)
    if found is None or found > LONGEST * record_s or 1.0 / MAX_RATIO <= t95_s / found <= MAX_RATIO:
        return None
    if t95_s > found:
        many, effect = f"{t95_s / found:.0f} times too long", "tests of it wait longer than they need"
    else:
        many, effect = f"{found / t95_s:.0f} times too short", "tests of it may be ended too early"
    return (
        f"t95_s is {t95_s:g} s in the configuration, about {many}: by the model found PV covers 95 % of a step in "
        f"about {found:.3g} s. Correct t95_s; {effect}"
    )
