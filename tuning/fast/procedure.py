"""The fast procedure as one plan made of plans.

    listen - relay (biased, 4 to 10 switches) - fit and design - verify (set-point step) - fit and design again

The relay is ended by the uncertainty of what would be proposed, not by a count. The gains proposed are those designed
on the whole record, relay and set-point step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from tuning.assess import assess
from tuning.design import Predicted, Ultimate
from tuning.fast.design import Wish
from tuning.fast.evidence import LEAST_LISTENED
from tuning.fast.experiment import Experiment
from tuning.fast.verdict import Judged, judge
from tuning.gains import Gains
from tuning.margins import ultimate_point
from tuning.models import sign
from tuning.plan import Note, Plan, StageDone, StageStarted
from tuning.reasons import Ended, Reason, Refused
from tuning.stages.common import Facts, Trace
from tuning.stages.preflight import preflight

__all__ = ["FAST", "FAST_STAGES", "FastOptions", "FastProposal", "fast"]

FAST = "fast"
FAST_STAGES = ("preflight", "relay", "design", "verify", "redesign")
SWITCHES = (4, 6, 8, 10)
NOT_YET = (Reason.UNCERTAIN, Reason.AMBIGUOUS)
"""What more of the same record may mend."""
LEAST_SAMPLES = 2 * LEAST_LISTENED
"""At rest, for the noise and the offset."""


@dataclass(frozen=True, slots=True)
class FastOptions:
    """What to design for, see `tuning.fast.design.Wish`; how to test.

    amplitude: of the relay's higher side, MV units; by default half of what MV permits, adapted after the first wave.
    verify: the set-point step under the new gains; without it the relay switches six times at least, as with careful.
    """

    Ms: float = 1.6
    derivative: bool = False
    Mt: float | None = None
    noise_gain: float | None = None
    amplitude: float | None = None
    careful: bool = False
    verify: bool = True

    def wish(self) -> Wish:
        """Raises Refused, BAD_INPUT."""
        return Wish(self.Ms, self.derivative, self.Mt, self.noise_gain)

    def __post_init__(self) -> None:
        self.wish()
        if self.amplitude is not None and not (math.isfinite(self.amplitude) and self.amplitude > 0.0):
            raise Refused(Reason.BAD_INPUT, f"amplitude must be a positive number, not {self.amplitude!r}")


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A step of the load that the record shows. t_s: since the relay's start.  size: MV units at the plant's input."""

    t_s: float
    size: float


@dataclass(frozen=True, slots=True)
class Found:
    """What one evaluation of the record came to.

    num, den (highest power first), L_s: the plant.  cause: why it is not enough, None if it is.  uncertainty,
    ambiguity: of Ms.  residual: in noises at rest.
    """

    structure: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    L_s: float
    gains: Gains
    Ms: float
    uncertainty: float
    ambiguity: float
    residual: float
    loads: tuple[LoadStep, ...]
    drift: bool
    switches: int
    period_s: float
    cause: str | None
    detail: str


@dataclass(frozen=True, slots=True)
class FastProposal:
    """What the operator decides on. Gains in ISA form, MV per PV unit and seconds."""

    method: str
    chosen: Mapping[str, float]
    found: Found
    old_gains: Gains
    gains: Gains
    predicted: Predicted
    ultimate: Ultimate | None
    notes: tuple[str, ...]


def fast(facts: Facts, options: FastOptions) -> Plan[FastProposal]:
    """The whole procedure on a loop in automatic and at rest. Raises Refused; restores nothing (the runner does)."""
    T95, wish = facts.T95_s, options.wish()
    expected = {"preflight": T95 / 2, "relay": T95, "design": 0.0, "verify": 1.5 * T95, "redesign": 0.0}
    todo = FAST_STAGES if options.verify else FAST_STAGES[:3]

    def started(stage: str) -> tuple[StageStarted]:
        after = todo[todo.index(stage) + 1 :]
        return (StageStarted(stage, expected[stage], sum(expected[s] for s in after)),)

    yield started("preflight")
    listened = Trace()
    point = yield from preflight(facts, LEAST_SAMPLES, listened)
    experiment = Experiment(facts, point, listened, options.amplitude)
    yield from experiment.tell(StageDone("preflight", point))

    yield from experiment.tell(*started("relay"))
    judged: Judged | None = None
    ended: Refused | None = None
    careful = options.careful or not options.verify
    for switches in SWITCHES[careful:]:
        in_time = yield from experiment.relay(switches)
        try:
            judged = yield from experiment.computed(partial(judge, experiment.evidence(), wish))
            ended = _wrong(facts, judged)
        except Refused as refused:
            ended = refused
        if ended is None or not in_time:
            break
        yield from experiment.tell(Note(f"after {switches} switches: {ended.detail}"))
    if ended is not None or judged is None:
        raise ended or Refused(Reason.STALLED, "the relay came to nothing")
    found = _found(judged)
    yield from experiment.tell(StageDone("relay", found), *started("design"), StageDone("design", found))

    if options.verify:
        yield from experiment.tell(*started("verify"))
        yield from experiment.step(judged.best.gains, judged.period)
        first = judged
        judged = yield from experiment.computed(partial(judge, experiment.evidence(), wish, first))
        ended = _wrong(facts, judged)
        if ended is not None and ended.reason in NOT_YET:
            yield from experiment.tell(Note(f"after the set-point step: {ended.detail}; it is stepped back"))
            yield from experiment.step_back()
            judged = yield from experiment.computed(partial(judge, experiment.evidence(), wish, first))
            ended = _wrong(facts, judged)
        found = _found(judged)
        yield (StageDone("verify", found), *started("redesign"), StageDone("redesign", found))
        if ended is not None:
            raise ended
    gains = judged.best.gains
    return FastProposal(
        method=FAST,
        chosen={"Ms": wish.Ms, **({"N": wish.N} if gains.Td else {})},
        found=found,
        old_gains=facts.old_gains,
        gains=gains,
        predicted=_predicted(judged),
        ultimate=_ultimate(judged),
        notes=tuple(_notes(found, experiment.trace.t[experiment.listened])),
    )


def _wrong(facts: Facts, judged: Judged) -> Refused | None:
    """Why this is not to be proposed."""
    model = judged.model
    if (sign(model) > 0.0) != facts.reverse:
        return Refused(
            Reason.WRONG_SIGN,
            f"the record fits a plant of {'positive' if sign(model) > 0.0 else 'negative'} gain; the controller acts "
            f"{'reverse' if facts.reverse else 'direct'}",
        )
    return None if judged.cause is None else Refused(Reason(judged.cause), judged.detail)


def _found(judged: Judged) -> Found:
    fit, best = judged.fit, judged.chosen.best
    evidence, structure, theta, c = fit.evidence, best.structure, best.theta, best.linear.coefficients
    order, count = structure.order, best.hypothesis.loads
    first = len(c) - order * count
    loads = tuple(
        LoadStep(
            (float(theta[structure.searched + i] - theta[structure.lags]) - evidence.listened) * evidence.Ts,
            float(c[first + i * order] / c[0]) * evidence.swing,
        )
        for i in range(count)
    )
    return Found(
        structure=structure.name,
        num=judged.model.num,
        den=judged.model.den,
        L_s=judged.model.L,
        gains=judged.best.gains,
        Ms=judged.Ms,
        uncertainty=judged.uncertainty,
        ambiguity=judged.ambiguity,
        residual=judged.residual,
        loads=loads,
        drift=best.hypothesis.drift,
        switches=len(evidence.switches),
        period_s=evidence.period * evidence.Ts,
        cause=judged.cause,
        detail=judged.detail,
    )


def _predicted(judged: Judged) -> Predicted:
    found = assess(judged.model, judged.best.gains, band=0.05)
    m, figures = found.margins, found.setpoint
    if figures is None:
        raise Refused(Reason.NOT_ROBUST, "the gains designed are not stable on their own model")
    return Predicted(m.Ms, m.GM, m.PM_deg, figures.overshoot_pct, figures.settling_s, figures.IAE)


def _ultimate(judged: Judged) -> Ultimate | None:
    try:
        return Ultimate(*ultimate_point(judged.model))
    except Ended:
        return None


def _notes(found: Found, start_s: float) -> list[str]:
    notes = [
        f"A step of the load of {load.size:+.3g} at the plant's input was found {load.t_s:.4g} s after the start of "
        f"the relay (at {start_s + load.t_s:.4g} s), and allowed for."
        for load in found.loads
    ]
    if found.drift:
        notes.append("PV drifted at a steady rate during the test; this was allowed for.")
    return notes
