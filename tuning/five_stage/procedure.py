"""The five-stage procedure is one plan made of smaller plans.

    preflight - baseline - 1 relay - 2 ultimate gain - 3 ZN PI, overshoot - 4 model - 5 gains - verify

Source: Stopakevych et al., automatic re-tuning of PI controllers in poorly performing control loops. Stages 4 and 5
take no plant time. The paper's Stage 5 minimises criterion (7); any other method of `tuning.rules.registry` may take
its place, on the paper's FOPDT estimate or on a model identified from the record of Stage 3. The procedure may be
entered at any stage with values typed in by hand, as in the paper's manual mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, TypeVar

from loopwright.tuning.analysis.comparison import Comparison, Predicted
from loopwright.tuning.analysis.margins import Ultimate
from loopwright.tuning.experiments.preflight import preflight
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, explained, held, to_rest
from loopwright.tuning.experiments.step_limits import not_kept
from loopwright.tuning.experiments.step_test import StepResult, allowed_step, step_test
from loopwright.tuning.experiments.verification import verification
from loopwright.tuning.five_stage.relay import RelayResult, relay_test
from loopwright.tuning.five_stage.ultimate_gain import UltimateResult, ultimate_gain
from loopwright.tuning.five_stage.zn_pi import ZnResult, zn_pi
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.identify import identify
from loopwright.tuning.identification.overshoot import fopdt_from_overshoot
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, TransferFunction
from loopwright.tuning.plan import Plan, StageDone, StageStarted, worked
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.design import ROBUST, Designed, comparison_of, design
from loopwright.tuning.rules.registry import METHODS

__all__ = ["STAGES", "Facts", "Options", "Proposal", "five_stage"]

STAGES = ("preflight", "baseline", "relay", "ultimate", "zn_pi", "estimate", "optimise", "verify")
R = TypeVar("R")
PROCEDURE = "five-stage"
MAX_GAIN = 60.0
"""Ku * K of a FOPDT plant with L/T = 0.026, which is half the smallest value that formula (2) was checked for."""
Entry = Literal["relay", "zn_pi", "estimate", "optimise"]


def stages_of(start: Entry, baseline: bool, verify: bool) -> tuple[str, ...]:
    """The stages of a run that enters at `start`, in their order."""
    entered = STAGES.index(start)
    left_out = {stage for stage, wanted in (("baseline", baseline), ("verify", verify)) if not wanted}
    return tuple(
        s for i, s in enumerate(STAGES) if (s in ("preflight", "baseline") or i >= entered) and s not in left_out
    )


def rule_of(method: str) -> str:
    """The method's name in `tuning.rules.registry`: the procedure's own Stage 5 is the robust PI."""
    return ROBUST if method == PROCEDURE else method


@dataclass(frozen=True, slots=True)
class Options:
    """The options of the procedure.

    start: the stage at which the procedure is entered.
    Ku, Pu_s: the ultimate point that a start at zn_pi needs.
    Kp, Ti_s, overshoot_pct: the PI and its overshoot that a start at estimate needs.
    model: the model that a start at optimise needs.
    k_source: the gain in the FOPDT estimate, "k5" (formula 5) or "ke" (measured).
    kp_step_factor: Stage 3 multiplies Kp by this factor instead of adding 0.1 (Ku - Kp).
    overshoot_window_pct: the overshoots, percent, that Stage 3 accepts.
    baseline, verify: whether the steps before and after are made.
    method, method_options: the method that gives the gains, "five-stage" (criterion 7) or another of
    `tuning.rules.registry`.
    model_from: the model that the method gets, "overshoot" (the paper's FOPDT estimate) or "record" (identified from
    the set-point step of Stage 3). By default five-stage takes the first, and the others take the second unless it does
    not explain the step.
    propose_anyway: the procedure goes on where the new gains improve nothing that was asked for.
    Raises Refused, BAD_INPUT.
    """

    start: Entry = "relay"
    Ku: float | None = None
    Pu_s: float | None = None
    Kp: float | None = None
    Ti_s: float | None = None
    overshoot_pct: float | None = None
    model: FOPDT | SOPDT | None = None
    k_source: Literal["k5", "ke"] = "k5"
    kp_step_factor: float | None = None
    overshoot_window_pct: tuple[float, float] = (10.0, 50.0)
    baseline: bool = True
    verify: bool = True
    method: str = PROCEDURE
    method_options: Mapping[str, object] = field(default_factory=dict)
    model_from: Literal["overshoot", "record"] | None = None
    propose_anyway: bool = False

    def __post_init__(self) -> None:
        needed = {
            "relay": (),
            "zn_pi": ("Ku", "Pu_s"),
            "estimate": ("Kp", "Ti_s", "overshoot_pct"),
            "optimise": (),
        }
        given = {name: getattr(self, name) for name in needed[self.start]}
        bad = {name: each for name, each in given.items() if each is None or not math.isfinite(each) or each <= 0}
        if bad:
            values = ", ".join(map(repr, bad.values()))
            text = f"entering at {self.start} needs {', '.join(bad)}, numbers > 0, not {values}"
            raise Refused(Reason.BAD_INPUT, text)
        if self.start == "optimise" and self.model is None:
            raise Refused(Reason.BAD_INPUT, "entering at optimise needs a model")
        if self.method != PROCEDURE and self.method not in METHODS:
            known = ", ".join((PROCEDURE, *METHODS))
            raise Refused(Reason.BAD_INPUT, f"method must be one of {known}, not {self.method!r}")
        METHODS[rule_of(self.method)].checked(self.method_options)
        if self.model_from == "record" and self.start in ("estimate", "optimise"):
            raise Refused(Reason.BAD_INPUT, f'model_from "record" needs Stage 3; the start is {self.start}')
        if self.kp_step_factor is not None and not 1 < self.kp_step_factor <= 2:
            raise Refused(Reason.BAD_INPUT, f"kp_step_factor must be in (1, 2], not {self.kp_step_factor!r}")
        low, high = self.overshoot_window_pct
        if not 0 < low < high < 74:
            raise Refused(Reason.BAD_INPUT, f"overshoot_window_pct must satisfy 0 < low < high < 74, not {low}, {high}")


@dataclass(frozen=True, slots=True)
class EstimatedModel:
    """The model on which the gains are designed: FOPDT, or SOPDT when zeta is given.

    K: the gain, PV units per MV unit, signed.
    T_s: the time constant, or 1/(natural frequency) of a SOPDT, s.
    L_s: the dead time, s.
    k_source: "k5" or "ke" (the estimate with either gain), "record" (identified) or "typed in".
    k5, ke: the gain by formula (5) and the measured gain, PV units per MV unit.
    zeta: the damping ratio of a SOPDT.
    fit_pct: the NRMSE fit to the record, percent, None without a record.
    """

    K: float
    T_s: float
    L_s: float
    k_source: str
    k5: float | None = None
    ke: float | None = None
    zeta: float | None = None
    fit_pct: float | None = None

    def plant(self) -> FOPDT | SOPDT:
        """The same model as a process model of the library."""
        if self.zeta is None:
            return FOPDT(self.K, self.T_s, self.L_s)
        return SOPDT(self.K, self.T_s, self.zeta, self.L_s)


@dataclass(frozen=True, slots=True)
class Proposal:
    """The proposal that the operator decides on. Gains are in ISA form, MV units per PV unit and s.

    method, chosen: the method, and the design parameters in effect.
    model: the model on which the gains were designed.
    previous_gains, gains: the present gains and the gains proposed.
    predicted: the main figures of the new gains on the model.
    comparison: old and new gains on the model. Where it shows no gain, the present gains are kept, nothing is verified
    and there is nothing to decide on, unless a proposal was asked for all the same.
    ultimate: the ultimate point, None where none was measured or typed in.
    baseline, verification: the set-point steps under the old and under the new gains, None where they were not made.
    notes: what the operator should know, one sentence each.
    """

    method: str
    chosen: Mapping[str, float]
    model: EstimatedModel
    previous_gains: Gains
    gains: Gains
    predicted: Predicted
    comparison: Comparison
    ultimate: Ultimate | None
    baseline: StepResult | None
    verification: StepResult | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Finished:
    """The results of an earlier attempt that was cut off. Their stages are not run again; preflight and verify are."""

    baseline: StepResult | None = None
    relay: RelayResult | None = None
    ultimate: UltimateResult | None = None
    zn_pi: ZnResult | None = None
    estimate: EstimatedModel | None = None
    optimise: Designed | None = None


def five_stage(facts: Facts, options: Options, finished: Finished = Finished()) -> Plan[Proposal]:
    """The plan of the whole procedure, for a loop in automatic and at rest.

    finished: the results of an earlier attempt.
    Raises Refused. The plan restores nothing: the runner restores the loop.
    """
    T95 = facts.T95_s
    pu_guess = options.Pu_s or T95 / 2
    expected = {
        "preflight": T95 / 2,
        "baseline": 4 * T95,
        "relay": 8 * pu_guess + T95,
        "ultimate": 5 * (5 * pu_guess + T95),
        "zn_pi": 4 * T95,
        "estimate": 0.0,
        "optimise": 0.0,
        "verify": 6 * T95,
    }
    todo = stages_of(options.start, options.baseline, options.verify)
    if broken := not_kept(facts.directions, facts.sp_rate_max_per_s, todo):
        raise Refused(Reason.BAD_LIMITS, "; ".join(broken))

    def started(stage: str) -> tuple[StageStarted]:
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    def stage(name: str, found: R | None, make: Callable[[], Plan[R]]) -> Plan[R]:
        if found is not None:
            return found
        yield started(name)
        result = yield from explained(make())
        yield (StageDone(name, result),)
        return result

    notes: list[str] = []
    point = yield from preflight(facts, sum(expected[s] for s in todo[1:]))
    yield (StageDone("preflight", point),)

    baseline: StepResult | None = None
    stepped = Trace()
    if options.baseline:
        baseline = yield from stage("baseline", finished.baseline, lambda: _baseline(facts, point, stepped))
        if finished.baseline is None:
            yield from to_rest(facts, point, 0.02 * facts.sp_deviation, stepped)
    gain = baseline.static_gain if baseline else math.nan
    step = Trace()

    ultimate: Ultimate | None = None
    if options.start == "relay":
        rough = yield from stage("relay", finished.relay, lambda: relay_test(facts, point))
        if gain == gain and abs(gain) * rough.Ku_a > MAX_GAIN:
            raise Refused(
                Reason.CANNOT_OSCILLATE,
                f"Ku * K is about {abs(gain) * rough.Ku_a:.0f} (at most {MAX_GAIN:g}): next to no dead time",
            )
        expected["ultimate"] = 5 * (5 * rough.Pu_a_s + T95)
        found = yield from stage("ultimate", finished.ultimate, lambda: ultimate_gain(facts, point, rough))
        ultimate = Ultimate(found.Ku, found.Pu_s)
        gain = gain if gain == gain else found.static_gain
    elif options.start == "zn_pi":
        ultimate = Ultimate(_typed(options.Ku), _typed(options.Pu_s))

    def estimated() -> Plan[EstimatedModel]:
        if zn is None:
            Kp, Ti, overshoot = _typed(options.Kp), _typed(options.Ti_s), _typed(options.overshoot_pct)
            return _estimate(facts, Kp, Ti, overshoot, gain, options.k_source, notes)
        model = _estimate(facts, zn.Kp, zn.Ti_s, zn.overshoot_pct, zn.static_gain, options.k_source, notes)
        if _wants_record(options):
            model = yield from _identified(facts, point, step, model, options.model_from is not None, notes)
        return model

    zn: ZnResult | None = None
    if ultimate is not None:
        # the record of this stage is not stored, so a model identified from it needs a new record
        done = finished.zn_pi if finished.estimate is not None or not _wants_record(options) else None
        known, window, factor = ultimate, options.overshoot_window_pct, options.kp_step_factor
        zn = yield from stage(
            "zn_pi", done, lambda: zn_pi(facts, point, known.Ku, known.Pu_s, gain, window, factor, step)
        )
    if options.start == "optimise":
        model = _typed_in(facts, options)
    else:
        model = yield from stage("estimate", finished.estimate, estimated)
    designed = yield from stage("optimise", finished.optimise, lambda: _designed(options, model, ultimate))
    notes += designed.notes
    compare = partial(comparison_of, designed, model.plant(), facts.previous_gains, facts.sample_time_s)
    comparison = yield from worked(partial(compare, options.method_options, options.propose_anyway))

    verified: StepResult | None = None
    if options.verify and (comparison.gain or options.propose_anyway):
        gains, predicted = designed.gains, designed.predicted
        verified = yield from stage(
            "verify", None, lambda: verification(facts, point, gains, predicted, model.K, model.L_s)
        )
    return Proposal(
        method=options.method,
        chosen=designed.chosen,
        model=model,
        previous_gains=facts.previous_gains,
        gains=designed.gains,
        predicted=designed.predicted,
        comparison=comparison,
        ultimate=ultimate,
        baseline=baseline,
        verification=verified,
        notes=tuple(notes),
    )


def _typed(value: float | None) -> float:
    assert value is not None  # Options has checked it
    return value


def _baseline(facts: Facts, point: OperatingPoint, trace: Trace) -> Plan[StepResult]:
    """The set-point step under the accepted gains, for the comparison and for a first value of the static gain.

    trace: is filled with the samples.
    """
    step = allowed_step(facts, point, facts.previous_gains.Kp, math.nan)
    result = yield from step_test(
        facts, point, step, band=0.05, max_s=5 * facts.T95_s, smooth_s=facts.T95_s / 12, into=trace
    )
    if abs(result.static_gain) * facts.previous_gains.Kp > MAX_GAIN:
        raise Refused(
            Reason.NOT_SELF_REGULATING,
            f"PV went {step:.4g} up and MV came back to where it was: that is a gain of {result.static_gain:.3g}",
        )
    wrong = result.static_gain == result.static_gain and (result.static_gain > 0) != facts.reverse
    if wrong:
        raise Refused(
            Reason.WRONG_SIGN,
            f"PV over MV gave a gain of {result.static_gain:.4g} with a "
            f"{'reverse' if facts.reverse else 'direct'}-acting controller",
        )
    if not result.settled:
        text = f"PV has not settled within {result.duration_s:.3g} s of a set-point step of {step:.4g}"
        found = yield from worked(held(facts, point, trace, text, Reason.NOT_SELF_REGULATING).search)
        if found.reason is not Reason.NOT_SELF_REGULATING:
            raise found
    return result


def _estimate(
    facts: Facts, Kp: float, Ti: float, overshoot: float, ke: float, source: str, notes: list[str]
) -> EstimatedModel:
    estimate = fopdt_from_overshoot(Kp, Ti, overshoot)
    sign = 1.0 if facts.reverse else -1.0
    k5 = sign * estimate.k5
    known = ke == ke
    if known and abs(k5 / ke - 1) > 0.2:
        notes.append(
            f"the gains k5 = {k5:.4g} and ke = {ke:.4g} differ by more than 20 %: "
            "measurement noise, or a plant that is not FOPDT-like"
        )
    if source == "ke" and not known:
        raise Refused(Reason.BAD_INPUT, 'k_source "ke" needs a measured static gain: enter at an earlier stage')
    K = ke if source == "ke" else k5
    return EstimatedModel(K, estimate.T, estimate.L, source, k5, ke if known else None)


def _typed_in(facts: Facts, options: Options) -> EstimatedModel:
    plant = options.model
    assert plant is not None  # Options has checked it
    if (plant.K > 0) != facts.reverse:
        raise Refused(
            Reason.WRONG_SIGN,
            f"the model's gain {plant.K:g} does not go with a {'reverse' if facts.reverse else 'direct'} action",
        )
    return EstimatedModel(plant.K, plant.T, plant.L, "typed in", zeta=plant.zeta if isinstance(plant, SOPDT) else None)


def _wants_record(options: Options) -> bool:
    return options.model_from == "record" or (options.model_from is None and options.method != PROCEDURE)


def _identified(
    facts: Facts, point: OperatingPoint, step: Trace, estimate: EstimatedModel, asked: bool, notes: list[str]
) -> Plan[EstimatedModel]:
    """The model that the set-point step of Stage 3 supports best, identified while the loop goes on.

    A model that does not explain the step is replaced by the estimate, unless it was asked for.
    """
    try:
        found = yield from worked(partial(identify, step.t, step.mv, step.pv, point.mv, lags_only=True))
    except Refused as refused:
        if asked:
            raise
        notes.append(f"The model is the estimate from the overshoot: {refused.detail}.")
        return estimate
    if not found.explained and not asked:
        notes.append("The model is the estimate from the overshoot: none of up to second order explains the step.")
        return estimate
    notes += found.notes
    plant = found.model
    assert not isinstance(plant, TransferFunction)  # lags_only
    if isinstance(plant, Integrating):
        raise Refused(Reason.NOT_SELF_REGULATING, f"the set-point step fits an integrating plant best: {plant}")
    if (plant.K > 0) != facts.reverse:
        raise Refused(Reason.WRONG_SIGN, f"the set-point step fits a gain of {plant.K:.4g}, of the wrong sign")
    zeta = plant.zeta if isinstance(plant, SOPDT) else None
    return EstimatedModel(plant.K, plant.T, plant.L, "record", estimate.k5, estimate.ke, zeta, found.fit_pct)


def _designed(options: Options, model: EstimatedModel, ultimate: Ultimate | None) -> Plan[Designed]:
    """The design of the fifth stage, computed while the loop goes on: 50 ms of processor time can become seconds in a
    process that shares its interpreter with many requests, and the lease would be used up."""
    rule = rule_of(options.method)
    return (yield from worked(partial(design, rule, model.plant(), ultimate, options.method_options)))
