"""Where lags do not explain a record: zeros, feed-through and a third lag, and stories of what moved PV beside MV.

The search is that of the procedure "fast" (`output_error`, `disturbances`). The time scale that a relay would give
comes from the second-order model of the same record: its ultimate period.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.identification.disturbances import (
    LAGS_ONLY,
    by_bic,
    disturbance_candidates,
    fit_structures,
    search_last_load_again,
)
from loopwright.tuning.identification.disturbances import STRUCTURES as SEVEN
from loopwright.tuning.identification.output_error import UNDISTURBED, Fitted
from loopwright.tuning.identification.problem import WHITE_ABOVE, IdentificationProblem
from loopwright.tuning.identification.residuals import whiteness
from loopwright.tuning.identification.structures import (
    INTEGRATOR,
    INTEGRATOR_WITH_ZERO,
    LAGGED_INTEGRATOR,
    SECOND,
    SECOND_WITH_ZERO,
    THIRD,
)
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Ended

STRUCTURES = (*SEVEN, THIRD, INTEGRATOR, LAGGED_INTEGRATOR, INTEGRATOR_WITH_ZERO)
SLOWEST = 1.0
"""Records after the first move of MV: a slower pole or zero of a plant of more than lags is a shape, no finding."""
A_MOVE = 0.2
"""Of MV's largest: what counts as one."""
FEW_MOVES = 2
NEAR_A_MOVE = 0.02
"""Of the record: the neighbourhood of a move."""
LIKELIEST = 4
"""Of the fits to averages, so many are searched further on every sample."""
NEAR = range(-2, 3)
"""Samples, around the dead time found, in which the jump of a plant that passes MV at once is looked for."""


class StructureSearch:
    """lags: the fits of the record by lags, the second order among them."""

    def __init__(self, problem: IdentificationProblem, lags: Sequence[Fitted]) -> None:
        self.problem = problem
        self._lags = lags
        self._fit = problem.fit_around(_period(problem, next(each for each in lags if each.structure == SECOND)))
        self._quiet: list[Fitted] = []

    def quiet(self) -> list[Fitted]:
        """All structures from rest that the record can show, on every sample."""
        known = [self.problem.fit(SECOND_WITH_ZERO, UNDISTURBED), *self._lags]
        self._quiet = fit_structures(self._fit, UNDISTURBED, known, STRUCTURES)
        return self._sound(self._quiet)

    def told(self, simple: bool) -> list[list[Fitted]]:
        """The same with what else moved PV, the simplest story first; `quiet` comes before.

        simple: one load and lags only.
        """
        unexplained = (lambda fit: False) if simple else self._unexplained
        told = disturbance_candidates(
            self._fit, self._quiet, unexplained, structures=LAGS_ONLY if simple else STRUCTURES
        )
        for found in told:
            if (best := min(found, key=by_bic)).hypothesis.load_disturbances:
                found += search_last_load_again(self._fit, best)
        return [[each for each in self._sound(found) if not confounded(self.problem, each)] for found in told]

    def _unexplained(self, fit: Fitted) -> bool:
        return self.problem.residual_matters(fit) and whiteness(fit.linear.residual, len(fit.theta)) < WHITE_ABOVE

    def _sound(self, found: list[Fitted]) -> list[Fitted]:
        """Those that the record can show, the lowest BIC first."""
        best = min(found, key=by_bic)
        dead_time = float(best.theta[best.structure.lags])
        ranked = sorted((self._on_every_sample(fit, dead_time) for fit in found), key=by_bic)
        shown = [each for each in ranked if _shown(self.problem, each)]
        if self._fit.block > 1:
            # times are sharper on every sample than on averages, and that must not decide between structures
            shown[:LIKELIEST] = [self._further(each) for each in shown[:LIKELIEST]]
        return shown

    def _further(self, fit: Fitted) -> Fitted:
        return min(fit, self.problem.refined(fit.structure, fit.hypothesis, [fit.theta]), key=by_bic)

    def _on_every_sample(self, fit: Fitted, dead_time: float) -> Fitted:
        """Where MV passes at once whole samples of dead time are tried one by one: no slope leads across a jump.

        Around its own and around the dead time of the best fit.
        """
        at, maximum = fit.structure.lags, float(self.problem.max_dead_time)
        thetas = [fit.theta]
        if fit.structure.feed_through:
            for whole in np.floor([fit.theta[at], dead_time])[:, None] + np.array(NEAR):
                thetas += [np.insert(np.delete(fit.theta, at), at, np.clip(L + 0.5, 0.0, maximum)) for L in whole]
        tried = sorted((self.problem.fitted(fit.structure, fit.hypothesis, theta) for theta in thetas), key=by_bic)
        if len(tried) == 1:
            return tried[0]
        return self._further(tried[0])


def _shown(problem: IdentificationProblem, fit: Fitted) -> bool:
    if fit.structure.lags_only:
        return True
    model = problem.model(fit)
    corners = np.abs(np.concatenate((np.roots(model.num), np.roots(model.den))))
    longest = SLOWEST * (problem.samples - problem.record.first_move) * problem.record.Ts
    return bool(np.all(corners[corners > 0.0] > 1.0 / longest))


def confounded(problem: IdentificationProblem, fit: Fitted) -> bool:
    """A story that may be the plant's own shape: MV is not needed, or a load comes with its move, or with another load.

    Where MV moves more often the plant's shape shows without the load.
    """
    if not problem.response_visible(fit):
        return True
    seen = np.sort(fit.theta[fit.structure.searched :])
    near = NEAR_A_MOVE * problem.samples
    if np.any(np.diff(seen) < near):
        return True
    moves = np.flatnonzero(np.abs(np.diff(problem.u, prepend=0.0)) > A_MOVE)
    if len(moves) > FEW_MOVES:
        return False
    after = float(fit.theta[fit.structure.lags]) + near
    return bool(np.any((seen[:, None] > moves - near) & (seen[:, None] < moves + after)))


def _period(problem: IdentificationProblem, second: Fitted) -> float:
    """Samples."""
    plant = problem.model(second)
    Ts = problem.record.Ts
    try:
        # one sample of dead time more: a plant without one has no ultimate period
        return ultimate_point(TransferFunction(plant.num, plant.den, plant.L + Ts))[1] / Ts
    except Ended:
        return math.inf
