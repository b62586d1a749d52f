"""The fast procedure of a loop in manual: pulses of its manual output, and no trial of the gains.

    listen - a first pulse - (pulse - rest - fit and design) until two evaluations agree

MV goes away from the manual output found and comes back to it, pulse by pulse; the loop stays in manual. The gains are
not tried, so that the record has to answer what a trial would: the limits of the evaluation are narrower, a faulty
valve is looked for, and two evaluations with a pulse between them have to agree.
"""

from __future__ import annotations

from functools import partial
from itertools import cycle

from loopwright.tuning.experiments.preflight import at_rest
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.look import Look, look_at, settled
from loopwright.tuning.fast.evaluation.proposal import FastProposal, comparison_of, evaluation_summary, proposed
from loopwright.tuning.fast.evaluation.record_evaluation import first_period
from loopwright.tuning.fast.evaluation.still_open import OPEN_REASONS
from loopwright.tuning.fast.manual.manual_test import ManualTest
from loopwright.tuning.fast.record import MIN_LISTENED
from loopwright.tuning.fast.score_tests.what_hides import naming_what_hides, while_open
from loopwright.tuning.plan import Mode, Note, Plan, StageDone, StageStarted
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["MANUAL", "MANUAL_STAGES", "by_manual"]

MANUAL = "manual"
MANUAL_STAGES = ("preflight", MANUAL, "design")
MIN_SAMPLES = 2 * MIN_LISTENED
WIDTHS = (0.5, 0.35, 0.8)
"""Lengths of the pulses after the first, in ultimate periods of the model so far, in turn: a pulse of half a period
excites the plant around it, the others below and above."""
REST = 0.75
"""Time at home after a pulse before the record is evaluated, in ultimate periods."""
MORE_REST = 0.5
"""Time at home where PV is too far away for a pulse, in ultimate periods."""
MAX_PERIODS, MAX_T95 = 12.0, 1.5
"""Longest record: the longer of these numbers of ultimate periods and of T95, from the end of the first pulse's
response on, without what computations take."""
MAX_OBJECTIONS = 3
"""Number of looks in a row with an objection that a longer record will not remove, after which the pulses end."""
MAX_DISAGREEMENT = 0.05
"""Largest difference of Ms from the Ms asked for, of the gains of two successive looks on each other's model."""


def by_manual(facts: Facts, options: DesignOptions, method: str) -> Plan[FastProposal]:
    """The plan of the procedure, for a loop in manual and at rest.

    method: the name of the procedure in the proposal.
    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    options.check_sampling(facts)
    point, listened = yield from at_rest(facts, _expected_s(facts)[MANUAL], MIN_SAMPLES, Mode.MANUAL)
    test = ManualTest(facts, point, listened)
    return (yield from naming_what_hides(test, partial(_pulsed, facts, options, method, test)))


def _expected_s(facts: Facts) -> dict[str, float]:
    """The expected plant time of each stage, s."""
    return {"preflight": facts.T95_s / 2, MANUAL: 1.5 * facts.T95_s, "design": 0.0}


def _pulsed(facts: Facts, options: DesignOptions, method: str, test: ManualTest) -> Plan[FastProposal]:
    T95, spec, expected = facts.T95_s, options.spec(), _expected_s(facts)

    def started(stage: str) -> tuple[StageStarted]:
        after = MANUAL_STAGES[MANUAL_STAGES.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    yield from test.report(StageDone("preflight", test.point), *started(MANUAL))
    yield from test.start()
    yield from test.first()
    test.period = yield from test.computed(partial(first_period, *test.columns(), facts.sample_time_s))
    begun = test.spent
    look = Look(test.period, None, Refused(Reason.STALLED, "the pulses came to nothing"))
    widths, objections = cycle(WIDTHS), 0
    while True:
        if not (yield from test.pulse(max(1, round(next(widths) * test.period)))):
            yield from test.resting(MORE_REST * test.period)
        else:
            yield from test.resting(REST * test.period)
            looked_at = test.elapsed
            record = test.experiment_record()
            last, look = look, (yield from test.computed(partial(look_at, facts, options, record)))
            test.period = look.period
            if settled(look, last, looked_at, MAX_DISAGREEMENT):
                break
            if look.refusal is not None:
                yield from test.report(Note(f"after {looked_at} samples: {while_open(test, look.refusal)}"))
            lasting = look.refusal is not None and look.refusal.reason not in OPEN_REASONS
            objections = objections + 1 if lasting else 0
            if objections == MAX_OBJECTIONS:
                break
        if test.spent - begun >= max(MAX_PERIODS * test.period, MAX_T95 * T95 / facts.sample_time_s):
            if look.refusal is None:
                text = f"after {test.elapsed} samples two successive evaluations still disagree on the gains"
                look = Look(look.period, look.evaluation, Refused(Reason.UNCERTAIN, text))
            break
    evaluation = look.evaluation
    yield from test.report(StageDone(MANUAL, test.figures()), *started("design"))
    if evaluation is not None:
        yield from test.report(StageDone("design", evaluation_summary(evaluation)))
    if look.refusal is not None:
        raise look.refusal
    assert evaluation is not None
    outcome = yield from test.computed(partial(comparison_of, evaluation, facts, spec, options.propose_anyway))
    begun_at_s = test.trace.t[test.listened]
    return (yield from test.computed(partial(proposed, method, facts, spec, evaluation, outcome, None, begun_at_s)))
