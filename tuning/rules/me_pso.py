"""ME-PSO: the PI that a multi-epoch particle swarm finds on the complex criterion.

Source: Y. Romasevych, V. Loveikin, S. Usenko, "PI-controller tuning optimization via PSO-based technique". The
criterion is in `complex_criterion`, the swarm in `global_search`; both state how the open points of the paper are read.

The following are additions to the paper: the bound on Ms, without which the criterion returns loops that no engineer
would accept (Ms above 5 among the paper's five plants); the time and gain units, which make the result follow the
plant's scale; the choice of the search domain; the other two optimisers on the same criterion.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.complex_criterion import ComplexCriterion, Weighting
from loopwright.tuning.rules.global_search import (
    Cost,
    SearchResult,
    differential_evolution,
    multi_epoch_swarm,
    nelder_mead,
)
from loopwright.tuning.rules.setting import Setting

OPTIMISERS: dict[str, Callable[[Cost, int, int], SearchResult]] = {
    "me-pso": multi_epoch_swarm,
    "de": differential_evolution,
    "nelder-mead": nelder_mead,
}
LOWEST = np.array([1e-4, 1e-3])
"""Smallest kp and ti in the plant's units: the ISA form has no pure integral controller, and no gain is infinite."""
KP_MAX = 10.0
TI_MAX = 10.0
ROBUST_MS = 2.0


def me_pso(
    model: Model,
    *,
    weighting: str = Weighting.ERROR,
    seed: int = 0,
    optimiser: str = "me-pso",
    Ms_max: float = ROBUST_MS,
    horizon_s: float | None = None,
    Kp_max: float | None = None,
    Ki_min: float | None = None,
) -> Setting:
    """The PI with the smallest complex criterion for a unit set-point step, with b = 1.

    weighting: "error", "control" or "duration", the three weightings of the paper.
    seed: the seed of the search; the same seed gives the same gains.
    optimiser: "me-pso" (2,500 evaluations, as published), "de" (differential evolution) or "nelder-mead" (multi-start),
    the last two with at most as many evaluations.
    Ms_max: the bound on the maximum sensitivity, above 1; 0 for none, as published.
    horizon_s: the simulated time, s; by default 20 times all lags and the dead time together.
    Kp_max: the largest Kp, MV units per PV unit; by default the ultimate gain (10/K without one).
    Ki_min: the smallest Ki, MV units per PV unit and s; by default a tenth of 1/(K*time unit).
    With Ms_max = 0 and the paper's horizon and domain the problem is that of the paper, except that the smallest Kp is
    not quite 0.
    Raises Refused for a bad argument, a model without lag and dead time, or when no stable loop was found.
    """
    if weighting not in tuple(Weighting):
        raise Refused(Reason.BAD_INPUT, f"weighting {weighting!r}: one of {', '.join(Weighting)} is accepted")
    if optimiser not in OPTIMISERS:
        raise Refused(Reason.BAD_INPUT, f"optimiser {optimiser!r}: one of {', '.join(OPTIMISERS)} is accepted")
    if not (Ms_max == 0.0 or 1.0 < Ms_max < math.inf):
        raise Refused(Reason.BAD_INPUT, f"Ms_max {Ms_max}: above 1, or 0 for no bound, is accepted")
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise Refused(Reason.BAD_INPUT, f"seed {seed}: a whole number, not negative, is accepted")
    for name, value in (("horizon_s", horizon_s), ("Kp_max", Kp_max), ("Ki_min", Ki_min)):
        if value is not None and not 0.0 < value < math.inf:
            raise Refused(Reason.BAD_INPUT, f"{name} {value}: a positive number is accepted")

    criterion = ComplexCriterion(model, Weighting(weighting), horizon_s, Ms_max or None)
    highest = np.array([_highest_kp(model, criterion, Kp_max), _highest_ti(criterion, Ki_min)])
    found, (kp, ti) = _search(criterion, highest, optimiser, int(seed))
    if not criterion.stable(kp, ti):
        raise Refused(Reason.NOT_ROBUST, f"no stable loop among {found.evaluations} settings up to Kp*K = {highest[0]}")

    each = criterion.indices(np.array([kp]), np.array([ti]))
    Ms = float(criterion.sensitivity(np.array([kp]), np.array([ti]))[0])
    chosen = {
        "criterion": found.value,
        "settling_s": float(each.settling[0]) * criterion.time_unit_s,
        "overshoot_pct": 100.0 * float(each.overshoot[0]),
        "Ms": Ms,
        "Ms_max": Ms_max,
        "horizon_s": criterion.horizon * criterion.time_unit_s,
        "Kp_max": float(highest[0]) / criterion.gain_unit,
        "Ki_min": 1.0 / (float(highest[1]) * criterion.gain_unit * criterion.time_unit_s),
        "seed": float(seed),
        "evaluations": float(found.evaluations),
    }
    notes = _notes(kp, ti, highest, Ms, weighting)
    if each.settling[0] >= criterion.horizon:
        notes += ("The answer is not within 5 % of the set-point by the end of the horizon.",)
    # the paper's Ti is the reciprocal of the integral gain
    return Setting(Gains(Kp=kp / criterion.gain_unit, Ti=kp * ti * criterion.time_unit_s), chosen, notes)


def _highest_kp(model: Model, criterion: ComplexCriterion, Kp_max: float | None) -> float:
    if Kp_max is None:
        try:
            Kp_max = ultimate_point(model)[0]
        except Refused:
            return KP_MAX
    if (kp := Kp_max * criterion.gain_unit) <= LOWEST[0]:
        raise Refused(Reason.BAD_INPUT, f"Kp_max {Kp_max}: above {LOWEST[0] / criterion.gain_unit:.3g} is accepted")
    return kp


def _highest_ti(criterion: ComplexCriterion, Ki_min: float | None) -> float:
    if Ki_min is None:
        return TI_MAX
    scale = criterion.gain_unit * criterion.time_unit_s
    if (ti := 1.0 / (Ki_min * scale)) <= LOWEST[1]:
        raise Refused(Reason.BAD_INPUT, f"Ki_min {Ki_min}: below {1.0 / (LOWEST[1] * scale):.3g} is accepted")
    return ti


def _search(
    criterion: ComplexCriterion, highest: Reals, optimiser: str, seed: int
) -> tuple[SearchResult, tuple[float, float]]:
    """The result of the search and its (kp, ti). The swarm and differential evolution search ti linearly, as published;
    Nelder-Mead searches it logarithmically."""

    def even(x: Reals) -> Reals:
        return np.asarray(LOWEST + x * (highest - LOWEST))

    def by_decades(x: Reals) -> Reals:
        settings = even(x)
        settings[..., 1] = LOWEST[1] * (highest[1] / LOWEST[1]) ** x[..., 1]
        return settings

    place = by_decades if optimiser == "nelder-mead" else even

    def cost(x: Reals) -> Reals:
        settings = place(x)
        return criterion(settings[:, 0], settings[:, 1])

    found = OPTIMISERS[optimiser](cost, 2, seed)
    kp, ti = place(found.point)
    return found, (float(kp), float(ti))


def _notes(kp: float, ti: float, highest: Reals, Ms: float, weighting: str) -> tuple[str, ...]:
    notes = []
    if kp <= 1.1 * LOWEST[0]:
        notes.append("The criterion wants a pure integral controller; Kp is as small as the search permits.")
    if kp >= 0.999 * highest[0] or ti >= 0.999 * highest[1]:
        notes.append("The optimum is on the edge of the search domain (Kp_max or Ki_min).")
    if ti <= 1.1 * LOWEST[1]:
        notes.append("The criterion wants no limit to the integral gain; it is as large as the search permits.")
    if weighting == Weighting.DURATION:
        notes.append("Settling jumps when a peak touches the 5 % band, and this optimum may sit there: check it.")
    if Ms > 1.005 * ROBUST_MS:
        notes.append(f"Ms is {Ms:.2f}: the loop is not robust; ask for Ms_max of 2 or less.")
    return tuple(notes)
