"""Gains for another Ms are designed on a model that is known already and tried on the loop, without a relay test."""

from __future__ import annotations

import math
from functools import partial

from loopwright.tuning.analysis.comparison import Comparison, predicted
from loopwright.tuning.experiments.preflight import preflight
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.step_limits import not_kept
from loopwright.tuning.experiments.step_test import StepResult
from loopwright.tuning.experiments.verification import verification
from loopwright.tuning.fast.design.design import DesignSpec, GainDesign, OptimalGains
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.design.requirements import required
from loopwright.tuning.fast.evaluation.proposal import (
    FastProposal,
    IdentifiedModel,
    chosen_for,
    comparison_on,
    delayed,
    ultimate,
)
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.models import Model, TransferFunction, sign, time_constants
from loopwright.tuning.plan import Plan, StageDone, StageStarted, worked
from loopwright.tuning.reasons import Reason, Refused

__all__ = ["TRIAL_STAGES", "designed_on", "trial"]

TRIAL_STAGES = ("preflight", "design", "verify")


def trial_stages(verify: bool) -> tuple[str, ...]:
    """The stages of a trial with or without the set-point step, in their order."""
    return TRIAL_STAGES if verify else TRIAL_STAGES[:2]


def designed_on(model: Model, spec: DesignSpec, sample_time_s: float) -> OptimalGains:
    """The best gains on the model, for a controller of this sample time. Raises Refused, NOT_ROBUST or NOT_POSSIBLE."""
    known = ultimate(model)
    # a model without an ultimate point is designed on the time scale of its lags and dead time
    period = known.Pu_s if known else 4.0 * (model.L + float(max(time_constants(model), default=0.0)))
    return required(GainDesign(delayed(model, 0.5 * sample_time_s), spec, period))


def _considered(model: Model, options: DesignOptions, facts: Facts) -> tuple[OptimalGains, Comparison]:
    """The best gains on the model and their comparison with the present gains. Raises Refused, NOT_ROBUST or
    NOT_POSSIBLE."""
    best = designed_on(model, options.spec(), facts.sample_time_s)
    sampled = delayed(model, 0.5 * facts.sample_time_s)
    return best, comparison_on(sampled, best, facts, options.spec(), options.propose_anyway)


def trial(facts: Facts, options: DesignOptions, model: Model) -> Plan[FastProposal]:
    """The plan of a trial, for a loop in automatic and at rest.

    model: the process model that the gains are designed on.
    New gains that improve nothing that was asked for are tried only if the options contain `propose_anyway`.
    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    options.check_sampling(facts)
    expected = {"preflight": facts.T95_s / 2, "design": 0.0, "verify": 6 * facts.T95_s}
    todo = trial_stages(options.verify)
    if broken := not_kept(facts.directions, facts.sp_rate_max_per_s, todo, mirrored=True):
        raise Refused(Reason.BAD_LIMITS, "; ".join(broken))

    def started(stage: str) -> tuple[StageStarted]:
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    point = yield from preflight(facts, sum(expected[stage] for stage in todo[1:]))
    yield (StageDone("preflight", point), *started("design"))
    if (sign(model) > 0.0) != facts.reverse:
        raise Refused(
            Reason.WRONG_SIGN,
            f"the model's gain is {'positive' if sign(model) > 0.0 else 'negative'}; the controller acts "
            f"{'reverse' if facts.reverse else 'direct'}",
        )
    best, comparison = yield from worked(partial(_considered, model, options, facts))
    gains = best.gains
    promised = predicted(comparison.new)
    yield (StageDone("design", gains),)
    shown: StepResult | None = None
    if options.verify and (comparison.gain or options.propose_anyway):
        yield started("verify")
        gain = model.static_gain if math.isfinite(model.static_gain) else math.nan
        shown = yield from verification(facts, point, gains, promised, gain, model.L)
        yield (StageDone("verify", shown),)
    given = TransferFunction(model.num, model.den, model.L)
    return FastProposal(
        method=FAST,
        chosen=chosen_for(options.spec(), best),
        model=IdentifiedModel("typed in", given.num, given.den, given.L),
        previous_gains=facts.previous_gains,
        gains=gains,
        predicted=promised,
        predicted_previous=predicted(comparison.previous) if comparison.previous.stable else None,
        comparison=comparison,
        ultimate=ultimate(model),
        found=None,
        known_previous=None,
        verified=None,
        verification=shown,
        notes=(),
        model_from="the request",
    )
