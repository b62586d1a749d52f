"""The search beyond lags, for records that lags do not explain: zeros, feed-through, a third lag, and disturbances.

The search is that of the procedure "fast" (`output_error`, `disturbances`). Its time scale, which a relay would give,
is the ultimate period of the second-order model of the same record.
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
from loopwright.tuning.models import Reals, TransferFunction
from loopwright.tuning.reasons import Ended

STRUCTURES = (*SEVEN, THIRD, INTEGRATOR, LAGGED_INTEGRATOR, INTEGRATOR_WITH_ZERO)
MAX_TIME_CONSTANT = 1.0
"""Largest time constant of a pole or zero of a model of more than lags, in lengths of the record after the first move
of MV; a slower one is not supported by the record."""
MIN_MOVE = 0.2
"""Smallest change of MV, as a fraction of the largest, that counts as a move."""
FEW_MOVES = 2
"""Number of moves up to which a record shows a load disturbance apart from the plant's response only where the response
is over. Moves on in the same direction, before the response is over, are one."""
NEAR_A_MOVE = 0.02
"""Distance from a move of MV, as a fraction of the record, within which a load disturbance comes with the move."""
SETTLED = 0.9
"""Part of its response to a move of MV that a plant has gone through when it counts as over."""
UNDONE = 0.5
"""Part of a move of MV, or of MV's deviation from where it was first, from which on a load disturbance undoes it."""
MIN_REST = 5
"""Smallest number of samples before the first answer to MV that can show a drift."""
DRIFT_ERRORS = 3.0
"""Standard errors that the slope of PV before its first answer to MV must be away from 0 to show a drift."""
LIKELIEST = 4
"""Number of the best fits to averages that are refined on every sample."""
NEIGHBOURS = range(-2, 3)
"""Samples around the fitted dead time at which the jump of a plant with feed-through is searched."""


class StructureSearch:
    """The search for structures of more than lags and for disturbances. lags: the fits of structures of lags, the
    second order among them."""

    def __init__(self, problem: IdentificationProblem, lags: Sequence[Fitted]) -> None:
        self.problem = problem
        self._lags = lags
        self._fit = problem.fit_around(_period(problem, next(each for each in lags if each.structure == SECOND)))
        self._undisturbed: list[Fitted] = []

    def undisturbed(self) -> list[Fitted]:
        """The fits of all structures without a disturbance that the record supports, on every sample."""
        known = [self.problem.fit(SECOND_WITH_ZERO, UNDISTURBED), *self._lags]
        self._undisturbed = fit_structures(self._fit, UNDISTURBED, known, STRUCTURES)
        return self._supported(self._undisturbed)

    def disturbed(self, lags_and_one_load: bool) -> list[list[Fitted]]:
        """The fits with disturbances that the record supports, the simplest hypothesis first; `undisturbed` must be
        called before.

        lags_and_one_load: only structures of lags with one load disturbance are tried.
        """
        unexplained = (lambda fit: False) if lags_and_one_load else self._unexplained
        disturbed = disturbance_candidates(
            self._fit, self._undisturbed, unexplained, structures=LAGS_ONLY if lags_and_one_load else STRUCTURES
        )
        for found in disturbed:
            if (best := min(found, key=by_bic)).hypothesis.load_disturbances:
                found += search_last_load_again(self._fit, best)
        return [[each for each in self._supported(found) if not confounded(self.problem, each)] for found in disturbed]

    def _unexplained(self, fit: Fitted) -> bool:
        return self.problem.residual_matters(fit) and whiteness(fit.linear.residual, len(fit.theta)) < WHITE_ABOVE

    def _supported(self, found: list[Fitted]) -> list[Fitted]:
        """The fits that the record supports, on every sample, the lowest BIC first."""
        best = min(found, key=by_bic)
        dead_time = float(best.theta[best.structure.lags])
        ranked = sorted((self._on_every_sample(fit, dead_time) for fit in found), key=by_bic)
        shown = [each for each in ranked if _within_the_record(self.problem, each)]
        if self._fit.block > 1:
            # times are sharper on every sample than on averages; all competing structures must profit from that
            shown[:LIKELIEST] = [self._further(each) for each in shown[:LIKELIEST]]
        return shown

    def _further(self, fit: Fitted) -> Fitted:
        return min(fit, self.problem.refined(fit.structure, fit.hypothesis, [fit.theta]), key=by_bic)

    def _on_every_sample(self, fit: Fitted, dead_time: float) -> Fitted:
        """The fit on every sample. With feed-through, dead times of whole samples around its own and around `dead_time`
        are tried one by one, as no slope leads across a jump."""
        at, maximum = fit.structure.lags, float(self.problem.max_dead_time)
        thetas = [fit.theta]
        if fit.structure.feed_through:
            for whole in np.floor([fit.theta[at], dead_time])[:, None] + np.array(NEIGHBOURS):
                thetas += [np.insert(np.delete(fit.theta, at), at, np.clip(L + 0.5, 0.0, maximum)) for L in whole]
        tried = sorted((self.problem.fitted(fit.structure, fit.hypothesis, theta) for theta in thetas), key=by_bic)
        if len(tried) == 1:
            return tried[0]
        return self._further(tried[0])


def _within_the_record(problem: IdentificationProblem, fit: Fitted) -> bool:
    if fit.structure.lags_only:
        return True
    model = problem.model(fit)
    corners = np.abs(np.concatenate((np.roots(model.num), np.roots(model.den))))
    longest = MAX_TIME_CONSTANT * (problem.samples - problem.record.first_move) * problem.record.Ts
    return bool(np.all(corners[corners > 0.0] > 1.0 / longest))


def confounded(problem: IdentificationProblem, fit: Fitted) -> bool:
    """Whether the disturbance may be confounded with the plant's own response.

    It may be

    - where MV is not needed for the fit, or where two load disturbances come together;
    - where a load disturbance undoes MV's last move, or brings MV and the loads together back to where MV began: what
      integrates may then be what settles;
    - in a record of few moves, where a load disturbance comes before the response to the last move is over, or slows
      down a plant that integrates: a slow part of the plant looks the same;
    - in a record of few moves, where PV before its first answer does not show the drift.
    """
    if not problem.response_visible(fit):
        return True
    seen = np.sort(fit.theta[fit.structure.searched :])
    if np.any(np.diff(seen) < NEAR_A_MOVE * problem.samples):
        return True
    if fit.hypothesis.drift:
        return len(_turns(problem.u, 0.0)) <= FEW_MOVES and not _drifts_at_rest(problem, fit)
    return bool(fit.hypothesis.load_disturbances) and _explains_the_response(problem, fit)


def _explains_the_response(problem: IdentificationProblem, fit: Fitted) -> bool:
    """Whether a load disturbance may stand for a part of the response to MV."""
    settling, dead_time = _settling(problem, fit), float(fit.theta[fit.structure.lags])
    moves = np.flatnonzero(np.abs(np.diff(problem.u, prepend=0.0)) > MIN_MOVE)
    few = len(_turns(problem.u, settling)) <= FEW_MOVES
    near = NEAR_A_MOVE * problem.samples
    total = 0.0
    for at, _, size in sorted(values.tolist() for values, _ in problem.load_disturbances(fit)):
        seen, load = at / problem.record.Ts, size / problem.mv_unit
        answered = min(max(math.ceil(seen - dead_time), 0), problem.samples - 1)
        held = float(problem.u[answered])
        before, last = held + total, 0.0
        earlier = moves[moves <= answered]
        if len(earlier):
            last = float(problem.u[earlier[-1]] - problem.u[max(earlier[-1] - 1, 0)])
        if abs(before) > MIN_MOVE and -load / before > UNDONE:
            return True
        if last and -load / last > UNDONE:
            return True
        if few:
            if fit.structure.integrating and load * before < 0.0 and abs(before) > MIN_MOVE:
                return True
            if np.any((seen > moves - near) & (seen < moves + dead_time + max(near, settling))):
                return True
        total += load
    return False


def _turns(u: Reals, settling: float) -> list[int]:
    """The samples at which MV moves, without those that go on in the same direction within `settling` samples."""
    found: list[int] = []
    steps = np.diff(u, prepend=0.0)
    last = -math.inf
    for at in np.flatnonzero(np.abs(steps) > MIN_MOVE).tolist():
        if not (found and at - last <= settling and steps[at] * steps[found[-1]] > 0.0):
            found.append(at)
        last = at
    return found


def _settling(problem: IdentificationProblem, fit: Fitted) -> float:
    """Samples from the first answer to a move until the response is over; of a plant that integrates, its slope."""
    structure, theta = fit.structure, fit.theta[: fit.structure.searched].copy()
    theta[structure.lags] = 0.0
    answers = problem.full_fit.answers(structure, theta, np.ones((1, 1, problem.samples)))[0]
    response = answers @ fit.linear.coefficients[: structure.inputs]
    if structure.integrating:
        response = np.diff(response)
    final = problem.full_fit.static_gain(fit)
    away = np.flatnonzero(np.abs(response - final) > (1.0 - SETTLED) * abs(final))
    return float(away[-1] + 1) if len(away) else 0.0


def _drifts_at_rest(problem: IdentificationProblem, fit: Fitted) -> bool:
    """Whether PV before its first answer to MV shows the drift of the fit."""
    rest = problem.y[: problem.record.first_move + int(fit.theta[fit.structure.lags])]
    if len(rest) < MIN_REST:
        return False
    ramp = np.arange(len(rest)) - 0.5 * (len(rest) - 1)
    slope = float(ramp @ rest / (ramp @ ramp))
    left = rest - rest.mean() - slope * ramp
    error = math.sqrt(float(left @ left) / (len(rest) - 2) / float(ramp @ ramp))
    drift = 2.0 * float(fit.linear.coefficients[fit.structure.inputs + 1]) / (problem.samples - 1)
    return slope * drift > 0.0 and abs(slope) > DRIFT_ERRORS * error and abs(slope) > 0.5 * abs(drift)


def _period(problem: IdentificationProblem, second: Fitted) -> float:
    """The ultimate period of the second-order model, in samples; infinite where the model has none."""
    plant = problem.model(second)
    Ts = problem.record.Ts
    try:
        # one sample of dead time more: a plant without one has no ultimate period
        return ultimate_point(TransferFunction(plant.num, plant.den, plant.L + Ts))[1] / Ts
    except Ended:
        return math.inf
