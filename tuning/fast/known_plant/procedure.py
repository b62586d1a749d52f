"""The fast procedure with a plant that normal operation has shown: only the gains designed on it are tried.

    listen - design on the record of operation - set-point step under the new gains - fit of both, design again

Nothing but the step moves the loop, which stays in automatic. The step is a further piece of the record. A plant that
has changed since shows there: in the residual, in the models of both records, and by the score test of `agreement`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

from loopwright.tuning.analysis.comparison import Comparison
from loopwright.tuning.experiments.preflight import PREFLIGHT, at_rest
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.experiments.ramp import MIN_NOISES_OF_TRIAL, too_slow
from loopwright.tuning.experiments.step_test import KICK_OF_ROOM
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.controller_effect import with_controller
from loopwright.tuning.fast.evaluation.evaluation import NEGLIGIBLE_RESIDUAL, Evaluation, evaluate
from loopwright.tuning.fast.evaluation.outcome import outcome_of
from loopwright.tuning.fast.evaluation.proposal import (
    FastProposal,
    VerifiedStep,
    evaluation_summary,
    proposed,
    verified_step,
)
from loopwright.tuning.fast.evaluation.still_open import OPEN_REASONS
from loopwright.tuning.fast.experiment import STEP_BACK_FRACTION, VERIFICATION_PERIODS, Experiment, on_trial
from loopwright.tuning.fast.known_plant.agreement import Agreement, agreement
from loopwright.tuning.fast.known_plant.plant import ObservedPlant
from loopwright.tuning.fast.record import MIN_LISTENED, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Note, Plan, Sample, SetGains, SetSetpoint, StageDone, StageStarted
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["KNOWN_STAGES", "TRIAL", "ObservedPlantFails", "TrialFigures", "by_known_plant"]

TRIAL = "trial"
KNOWN_STAGES = (PREFLIGHT, "design", TRIAL, "redesign")
MIN_SAMPLES = 2 * MIN_LISTENED
REST_PERIODS = 2.0
"""Time at rest before the step that belongs to its piece of the record, in ultimate periods."""
FARTHEST = 2.0
"""Deviation of PV from rest, in steps of the set-point, at which the step under the new gains is ended: with an Ms of 2
PV overshoots by less than half of a step."""
MAX_CHI, CHI_PER_PARAMETER = 20.0, 5.0
"""How much of the residual, in its variances, a plant of its own may explain of the step: this, and this for each
parameter."""
MAX_STEP_RESIDUAL = 1.35
"""Largest residual of the step, in standard deviations of the noise at rest."""
OUTDATED = (
    Reason.MODEL_MISMATCH,
    Reason.UNEXPLAINED,
    Reason.DIVERGES,
    Reason.WRONG_SIGN,
    Reason.NOT_ROBUST,
    Reason.NO_RESPONSE,
)
"""Reasons for a refusal of the step that speak against the known plant; the others against the time of the step."""


class ObservedPlantFails(Refused):
    """The known plant does not give gains. moved: the loop was moved and is not at rest."""

    def __init__(self, reason: Reason, detail: str, moved: bool = False) -> None:
        super().__init__(reason, detail)
        self.moved = moved


@dataclass(frozen=True, slots=True)
class TrialFigures:
    """The set-point step under the gains designed on the known plant.

    source: where the known plant comes from, in words.
    tested: these gains.
    step: the set-point step, PV units. duration_s: the time since the step, s.
    Ms: the maximum sensitivity of the tested gains on the model of operation and step together; None without one.
    gain, gain_error: the plant's gain in the step over that in operation and its standard deviation, where nothing else
    differs; None where the step could not be evaluated.
    later_s, later_error_s: by how much the dead time is longer, and its standard deviation, s, likewise.
    outdated: why the known plant is not the present one, in words with the numbers; None where nothing says so.
    """

    source: str
    tested: Gains
    step: float
    duration_s: float
    Ms: float | None
    gain: float | None
    gain_error: float | None
    later_s: float | None
    later_error_s: float | None
    outdated: str | None


class KnownTrial(Experiment):
    """The set-point step under gains designed on the known plant, from rest, and its record.

    known: the known plant; None where the step alone is of interest, and nobody asks for the record.
    """

    def __init__(self, facts: Facts, point: OperatingPoint, listened: Trace, known: ObservedPlant | None) -> None:
        super().__init__(facts, point, listened)
        self._known = known
        self._period = 0.0

    def step(self, gains: Gains, model_period: float) -> Plan[None]:
        """Puts the new gains in effect without a bump, and steps the set-point as far as MV permits.

        model_period: the ultimate period of the model, s.
        """
        kick, permitted = gains.b * gains.Kp, self.facts.sp_deviation
        size = min(permitted, KICK_OF_ROOM * self.point.room / kick) if kick > 0.0 else permitted
        self._step = self.facts.side * size
        self._period = model_period
        self._follow_s = VERIFICATION_PERIODS * model_period
        self.excited = len(self.trace)
        self._gains_tried = gains
        commands = (*self._commands, SetGains(gains), SetSetpoint(self.point.sp + self._step))
        self._commands = ()
        yield from self._follow(commands, size, FARTHEST)

    def step_home(self) -> Plan[None]:
        """Steps the set-point home under the same gains and follows PV for half as long as after the first step."""
        self._follow_s *= STEP_BACK_FRACTION
        yield from self._follow((SetSetpoint(self.point.sp),), abs(self._step), FARTHEST)

    def experiment_record(self) -> ExperimentRecord:
        """The record of operation with the step as its last piece."""
        assert self._known is not None
        rest = max(round(REST_PERIODS * self._period / self.facts.sample_time_s), 2 * self._known.together)
        first = max(self._steps[0] - rest, 0)
        record = self._known.with_trial(self.trace, first, self._steps, self._known.record.period)
        return replace(record, control=self._control())

    def _on_sample(self, sample: Sample) -> tuple[Command, ...]:
        self._add(sample)
        return ()


def by_known_plant(facts: Facts, options: DesignOptions, known: ObservedPlant, method: str) -> Plan[FastProposal]:
    """The plan of the procedure, for a loop in automatic and at rest.

    method: the name of the procedure in the proposal.
    Raises Refused where the loop is not at rest, and where what was asked for is not possible, else ObservedPlantFails.
    The plan restores nothing but the present gains and the set-point before ObservedPlantFails is raised: the runner
    restores the loop.
    """
    why = known.not_for(facts)
    if why is None and not options.verify:
        why = "without the step under the new gains (verify: false) gains from operation are not proposed"
    if why is not None:
        raise ObservedPlantFails(Reason.UNCERTAIN, why)
    expected = {PREFLIGHT: facts.T95_s / 2, "design": 0.0, TRIAL: 1.5 * facts.T95_s, "redesign": 0.0}

    def started(stage: str) -> tuple[StageStarted]:
        after = KNOWN_STAGES[KNOWN_STAGES.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    point, listened = yield from at_rest(facts, expected[TRIAL], MIN_SAMPLES)
    test = KnownTrial(facts, point, listened, known)
    yield from test.report(StageDone(PREFLIGHT, point), *started("design"))
    if (why := known.not_at(point)) is not None:
        raise ObservedPlantFails(Reason.UNCERTAIN, why)
    first, outcome = yield from test.computed(partial(_designed, facts, options, known))
    yield from test.report(StageDone("design", evaluation_summary(first)))
    if isinstance(outcome, Refused):
        if outcome.reason is Reason.NOT_POSSIBLE:  # a test that moves the loop would only tell the same
            raise outcome
        raise ObservedPlantFails(outcome.reason, outcome.detail)
    shown: VerifiedStep | None = None
    evaluation = first
    if outcome.gain or options.propose_anyway:
        if (why := too_slow(facts, test.noise, first.period, MIN_NOISES_OF_TRIAL)) is not None:
            raise ObservedPlantFails(Reason.UNCERTAIN, why)
        yield from test.report(*started(TRIAL))
        evaluation, shown = yield from _tried(facts, options, known, test, first)
        yield from test.report(*started("redesign"), StageDone("redesign", evaluation_summary(evaluation)))
        outcome = outcome_of(facts, options, evaluation)
        assert isinstance(outcome, Comparison)
    begun_at_s = test.trace.t[test.excited] if shown else math.nan
    return (
        yield from test.computed(
            partial(proposed, method, facts, options.spec(), evaluation, outcome, shown, begun_at_s, known.source)
        )
    )


def _tried(
    facts: Facts, options: DesignOptions, known: ObservedPlant, test: KnownTrial, first: Evaluation
) -> Plan[tuple[Evaluation, VerifiedStep]]:
    """Tries the gains of the first evaluation. Raises ObservedPlantFails."""
    tested = on_trial(first.best.gains)
    looked: _Look | None = None
    try:
        yield from test.step(tested, first.period)
        looked = yield from test.computed(partial(_look, facts, options, test.experiment_record(), first))
        if looked.refused is not None and looked.refused.reason in OPEN_REASONS:
            yield from test.report(Note(f"after the set-point step: {looked.refused.detail}; it is stepped back"))
            yield from test.step_home()
            looked = yield from test.computed(partial(_look, facts, options, test.experiment_record(), first))
        refused = looked.refused
    except Refused as raised:
        refused = raised
    outdated = refused.detail if refused is not None and refused.reason in OUTDATED else None
    yield from test.report(StageDone(TRIAL, _figures(known, test, tested, looked, outdated)))
    if refused is not None and refused.reason is Reason.CONTROLLER_MISMATCH:
        raise refused
    if refused is not None:
        yield (SetGains(facts.previous_gains), SetSetpoint(test.point.sp))
        raise ObservedPlantFails(refused.reason, refused.detail, moved=True)
    assert looked is not None and looked.evaluation is not None
    return looked.evaluation, verified_step(looked.evaluation, tested, *test.stepped)


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What operation and the step tell together."""

    evaluation: Evaluation | None
    agreement: Agreement | None
    refused: Refused | None


def _designed(facts: Facts, options: DesignOptions, known: ObservedPlant) -> tuple[Evaluation, Refused | Comparison]:
    """The evaluation of the record of operation with what follows from it. Raises ObservedPlantFails."""
    try:
        evaluation = evaluate(known.record, options.spec())
        return evaluation, outcome_of(facts, options, evaluation)
    except Refused as refused:
        raise ObservedPlantFails(refused.reason, refused.detail) from None


def _look(facts: Facts, options: DesignOptions, record: ExperimentRecord, first: Evaluation) -> _Look:
    try:
        evaluation = with_controller(evaluate(record, options.spec(), first))
        outcome = outcome_of(facts, options, evaluation)
    except Refused as raised:
        return _Look(None, None, raised)
    compared = agreement(evaluation)
    refused = _another_plant(evaluation, compared)
    another = evaluation.reason is Reason.CONTROLLER_MISMATCH
    if (refused is None or another) and isinstance(outcome, Refused):
        refused = outcome
    return _Look(evaluation, compared, refused)


def _another_plant(evaluation: Evaluation, compared: Agreement) -> Refused | None:
    """The refusal where the step shows another plant than operation did."""
    fit, found = evaluation.fit, evaluation.chosen.best
    left = found.linear.residual[fit.rows[-1]]
    rms = math.sqrt(float(left @ left) / len(left))
    noise = fit.record.noise / fit.record.output_range
    changed = (
        f"the gain would be {compared.gain[0]:.2f} +- {2.0 * compared.gain[1]:.2g} times that of operation, or the "
        f"dead time {compared.later_s[0]:+.3g} +- {2.0 * compared.later_s[1]:.2g} s longer"
    )
    if rms > max(MAX_STEP_RESIDUAL * noise, NEGLIGIBLE_RESIDUAL):
        return Refused(
            Reason.MODEL_MISMATCH,
            f"one plant does not explain operation and the step: it leaves {100.0 * rms:.2g} % of PV's range of the "
            f"step unexplained, the noise is {100.0 * noise:.2g} %; {changed}",
        )
    if compared.chi > MAX_CHI + CHI_PER_PARAMETER * compared.parameters:
        return Refused(Reason.MODEL_MISMATCH, f"the step shows another plant than operation did: {changed}")
    return None


def _figures(
    known: ObservedPlant, test: KnownTrial, tested: Gains, looked: _Look | None, outdated: str | None
) -> TrialFigures:
    size, duration_s = test.stepped
    compared = looked.agreement if looked else None
    shown = verified_step(looked.evaluation, tested, size, duration_s) if looked and looked.evaluation else None
    return TrialFigures(
        source=known.source,
        tested=tested,
        step=size,
        duration_s=duration_s,
        Ms=shown.Ms if shown else None,
        gain=compared.gain[0] if compared else None,
        gain_error=compared.gain[1] if compared else None,
        later_s=compared.later_s[0] if compared else None,
        later_error_s=compared.later_s[1] if compared else None,
        outdated=outdated,
    )
