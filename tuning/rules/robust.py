"""The robust PI of the five-stage procedure as a rule: see `tuning.robust`, which says what is minimised."""

from __future__ import annotations

from loopwright.tuning.models import FOPDT
from loopwright.tuning.robust import optimise
from loopwright.tuning.rules.common import positive, ratio_within, setting
from loopwright.tuning.setting import Setting

RATIO = (0.02, 20.0)
"""L/T. The search takes about 0.1 s inside, and many times as long outside."""


def robust(model: FOPDT, *, horizon_s: float | None = None, scale_free: bool | None = None) -> Setting:
    """horizon_s: length of the step response, s, by default 10 (T + L).  scale_free: by default for T < 5 s, where the
    printed criterion depends on the unit of time."""
    ratio_within(model, *RATIO, "the robust PI")
    if horizon_s is None:
        horizon_s = 10.0 * (model.T + model.L)
    positive("horizon_s", horizon_s, "s")
    found = optimise(model, horizon_s=horizon_s, scale_free=scale_free)
    return setting(found.gains.Kp, found.gains.Ti, chosen={"horizon_s": horizon_s})
