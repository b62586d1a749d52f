"""What the stretches of a loop's history tell of its gains, and the answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from pydantic import Field

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jsonable import json_object
from loopwright.service.listening.bins import Rows
from loopwright.service.observing.resolution import wall_period_s
from loopwright.service.observing.stretches import HeardStretch, heard_stretches
from loopwright.service.planning.facts import facts_of
from loopwright.service.results import (
    ComparisonView,
    Figures,
    KnowledgeView,
    KnownGainsView,
    PredictedView,
    RangeView,
    TransferModelView,
    UltimateView,
)
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.analysis.comparison import Comparison, predicted
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.proposal import comparison_of, identified_model, load_disturbances, ultimate
from loopwright.tuning.fast.evaluation.robustness import KnownMs
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.gains import Gains
from loopwright.tuning.operation.history import SetpointChange
from loopwright.tuning.operation.known import known_plant
from loopwright.tuning.operation.observation import Observation, observe
from loopwright.tuning.reasons import Reason, Refused

NEVER_TRIED = (
    "These gains were never tested on this loop: they come from what operators did, and hold for the range of PV and "
    "MV given. The request `retune` puts them on trial with a set-point step, and ends with a proposal."
)
WAIT = "Wait for further or larger set-point changes, or retune by setpoint or fast, which move the loop themselves."
ADVICE = {
    Reason.SETPOINT_IS_DRIVEN: "Put the loop to a local set-point that operators move, or retune it by fast.",
    Reason.DISTURBED: "Wait for set-point changes in steadier times, or retune by setpoint or fast.",
    Reason.UNEXPLAINED: "Look for a sticking valve, a limit of MV or another loop; then wait for further set-point "
    "changes, or retune by fast.",
    Reason.PV_ALTERED: "Have the sensor, or what passes its value on, renew it at every sample, unrounded and without "
    "wrong samples; then wait for further set-point changes, or retune by fast.",
    Reason.NOT_POSSIBLE: "Ask for what the message says is possible.",
    Reason.NOT_ROBUST: "Keep the present gains, or retune by fast.",
}
TRUSTED = (None, Reason.UNCERTAIN, Reason.AMBIGUOUS)
"""What an observation came to where its model is right as far as it is known."""
_UNIX = "seconds since 1970 UTC, wall time"


class ObservationState(StrEnum):
    """What an observation came to."""

    PROPOSAL = "proposal"
    NO_GAIN = "no_gain"
    MISSING = "missing"


class ObservedChangeView(Figures):
    """A set-point change of normal operation."""

    at_s: float = Field(description=f"Its first move, {_UNIX}", examples=[1769860830.5])
    sp_before: float = Field(description="Set-point before it, PV units")
    size: float = Field(description="Largest deviation of the set-point from before, PV units")


class ObservedLoadView(Figures):
    """A step of the load that the fit found within a set-point change."""

    at_s: float = Field(description=f"Its time, {_UNIX}")
    size: float = Field(description="Size at the plant's input, MV percent")


class DataView(Figures):
    """What there was to look at."""

    from_s: float | None = Field(description=f"Begin of the first stretch in automatic, {_UNIX}; null: there is none")
    to_s: float | None = Field(description=f"End of the last one, {_UNIX}; null: there is none")
    stretches: int = Field(description="Stretches in automatic under known gains and set-point, without a gap")
    duration_s: float = Field(description="Their length together, plant time, s")
    sample_s: float = Field(description="Length of one sample that was looked at, plant time, s", examples=[0.5])
    no_data: str | None = Field(description="Why there is no data of the loop at present; null: there is")
    disturbed_by: list[str] = Field(
        description="Tags of neighbours (of the same area, or whose outer_loop this loop is) that were under test; "
        "these times are left out, as those of tests of the loop itself are",
        examples=[["TIC-102"]],
    )


class OperationView(Figures):
    """What set-point changes of normal operation tell of the gains of a loop."""

    state: ObservationState = Field(
        description="proposal: gains that are worth a trial; no_gain: the present gains are as good as asked; missing: "
        "not known well enough, see `reason` and `detail`"
    )
    reason: Reason | None = Field(description="Reason why there is no proposal; null: there is one")
    detail: str = Field(description="What is missing, or the comparison in a sentence")
    advice: str | None = Field(description="What to do about it")
    known: str = Field(description="What is known, in words", examples=["Ms known to +-0.03 from 3 set-point changes"])
    pv_range: RangeView | None = Field(description="Range of PV during the changes used, for which the model holds")
    mv_range: RangeView | None = Field(description="Range of MV during the changes used, MV units (a loop: percent)")
    model: TransferModelView | None = Field(description="Model of the plant with standard errors; null: none")
    residual: float | None = Field(description="Residual of the model as a ratio to the noise at rest", examples=[1.0])
    present: KnownGainsView
    proposed: KnownGainsView | None = Field(description="Designed gains; null: not known well enough")
    ultimate: UltimateView | None = Field(description="The ultimate point of the model")
    predicted: PredictedView | None = Field(description="Predicted performance of the designed gains")
    predicted_previous: PredictedView | None = Field(
        description="Predicted performance of the present gains; null: not known, or not stable"
    )
    comparison: ComparisonView | None = Field(description="Present and designed gains on the model")


class ObservationView(OperationView):
    """What normal operation tells of the gains of a loop. Nothing was moved or written on it."""

    loop: str = Field(examples=["TIC-101"])
    pv_unit: str = Field(description="Unit of PV and SP", examples=["degC"])
    method: Literal["observe"] = "observe"
    data: DataView
    changes_used: list[ObservedChangeView] = Field(description="Set-point changes that one plant explains")
    changes_dropped: list[ObservedChangeView] = Field(
        description="Set-point changes that do not fit these: disturbed, or of an older plant"
    )
    loads: list[ObservedLoadView] = Field(description="Load disturbances that were found and allowed for")
    tested_on_loop: Literal[False] = Field(default=False, description="Always false: nothing was tested on the loop")
    tested_text: str | None = Field(description="That sentence, where gains are proposed", examples=[NEVER_TRIED])
    knowledge: KnowledgeView | None = Field(
        default=None,
        description="What is known of the loop with this and from its tests; null: nothing is",
    )
    retune: dict[str, object] | None = Field(
        description="Body for POST /loops/{tag}/retune that tries the proposed gains on the loop",
        examples=[{"method": "fast", "start": "design", "Ms": 1.6, "model": {"num": [2.0], "den": [3.0, 1.0]}}],
    )


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked of which loop.

    config, state: the loop's configuration and its state as read.
    spec: what the gains are designed for.
    rows, together, tests: the history, see `heard_stretches`.
    no_data: why the loop is not heard at present.
    disturbed_by: the neighbours whose tests are among these.
    """

    config: LoopConfig
    state: LoopState
    spec: DesignSpec
    rows: Rows
    together: int
    tests: Sequence[tuple[float, float]]
    no_data: str | None
    disturbed_by: tuple[str, ...] = ()

    @property
    def sample_s(self) -> float:
        """The length of one sample of the stretches, plant time, s."""
        return self.together * self.state.sample_time_s

    def heard(self) -> list[HeardStretch]:
        """The stretches, oldest first."""
        return heard_stretches(self.rows, self.state.sample_time_s, self.together, self.tests)


def observed(question: Question) -> ObservationView:
    """The answer; a computation of seconds."""
    return _observed(question, question.heard())[0]


def observed_plant(question: Question, now_s: float) -> tuple[ObservationView, ObservedPlant | NothingKnown]:
    """The answer, and the plant as a test may take it as known; a computation of seconds.

    now_s: wall time, s since 1970 UTC.
    """
    heard = question.heard()
    view, found = _observed(question, heard)
    if found.reason is not None:
        return view, NothingKnown(view.detail)
    latest = max(_at_s(each, heard, each.move) for each in found.used)
    sample_time_s = question.state.sample_time_s
    # a simulated plant runs faster than the wall clock
    period_s = wall_period_s(question.rows.bins) or sample_time_s
    return view, known_plant(found, sample_time_s, (now_s - latest) / period_s * sample_time_s)


def _observed(question: Question, heard: Sequence[HeardStretch]) -> tuple[ObservationView, Observation]:
    if question.config.setpoint_from == "remote":
        outer = question.config.outer_loop or "another controller"
        text = f"the set-point comes from {outer} (setpoint_from: remote in loops.yaml), which follows what PV does"
        return _answered(question, heard, Observation(Reason.SETPOINT_IS_DRIVEN, text), None)
    if not heard:
        why = f"{question.no_data}" if question.no_data else "there are no data in automatic under known gains yet"
        return _answered(question, heard, Observation(Reason.UNCERTAIN, why), None)
    try:
        facts = facts_of(question.config, question.state)
        found = observe([each.stretch for each in heard], question.state.reverse_acting, question.spec)
        compared = None
        if found.reason is None and found.evaluation is not None:
            compared = comparison_of(found.evaluation, facts, question.spec, False)
    except Refused as refused:
        return _answered(question, heard, Observation(refused.reason, refused.detail), None)
    return _answered(question, heard, found, compared)


def _answered(
    question: Question, heard: Sequence[HeardStretch], found: Observation, compared: Comparison | None
) -> tuple[ObservationView, Observation]:
    return _answer(question, heard, found, compared), found


def _answer(
    question: Question, heard: Sequence[HeardStretch], found: Observation, compared: Comparison | None
) -> ObservationView:
    config, evaluation = question.config, found.evaluation
    common = operation_fields(found, compared, question.state.gains)
    proposal = common["state"] is ObservationState.PROPOSAL
    fields: dict[str, object] = {
        "loop": config.tag,
        "pv_unit": config.pv_unit,
        "data": _data(question, heard),
        "changes_used": [_change(each, heard) for each in found.used],
        "changes_dropped": [_change(each, heard) for each in found.dropped],
        "loads": [] if evaluation is None else _loads(evaluation, found.used, heard),
        "tested_text": NEVER_TRIED if proposal else None,
        "retune": _trial(evaluation, question.spec) if evaluation and proposal else None,
    }
    return ObservationView.model_validate(json_object(common | fields))


def operation_fields(found: Observation, compared: Comparison | None, present: Gains) -> dict[str, object]:
    """The fields of `OperationView`.

    compared: present and designed gains; None where no gains are proposed.
    """
    evaluation, used = found.evaluation, found.used
    trusted = evaluation if found.reason in TRUSTED else None
    state, reason, detail = ObservationState.MISSING, found.reason, found.detail
    if compared is not None:
        state = ObservationState.PROPOSAL if compared.gain else ObservationState.NO_GAIN
        reason, detail = None if compared.gain else Reason.NO_GAIN, compared.verdict
    designed = evaluation if compared is not None else None
    return {
        "state": state,
        "reason": reason,
        "detail": detail,
        "advice": None if state is not ObservationState.MISSING or reason is None else ADVICE.get(reason, WAIT),
        "known": _in_words(trusted, found),
        "pv_range": _range([each.stretch.pv[each.samples] for each in used]),
        "mv_range": _range([each.stretch.mv[each.samples] for each in used]),
        "model": None if evaluation is None else identified_model(evaluation.fit, evaluation.chosen.best),
        "residual": None if evaluation is None else evaluation.residual,
        "present": _known(None if trusted is None else found.known_Ms(present), present),
        "proposed": None if designed is None else _known(found.known_Ms(designed.best.gains), designed.best.gains),
        "ultimate": None if evaluation is None else ultimate(evaluation.model),
        "predicted": None if compared is None else predicted(compared.new),
        "predicted_previous": predicted(compared.previous)
        if compared is not None and compared.previous.stable
        else None,
        "comparison": compared,
    }


def _in_words(evaluation: Evaluation | None, found: Observation) -> str:
    if evaluation is None:
        return "Ms is not known"
    known, count = found.known_to, len(found.used)
    at_best = "at best " if found.reason is not None else ""
    behind = "" if found.valve is None else f", behind {found.valve.in_words}"
    return f"Ms known to +-{known:.2g} {at_best}from {count} set-point change{'s' * (count != 1)}{behind}"


def _known(found: KnownMs | None, gains: Gains) -> dict[str, object]:
    return {
        "gains": gains,
        "Ms": found.Ms if found else None,
        "uncertainty": found.uncertainty if found else None,
    }


def _data(question: Question, heard: Sequence[HeardStretch]) -> dict[str, object]:
    return {
        "from_s": float(heard[0].at_s[0]) if heard else None,
        "to_s": float(heard[-1].at_s[-1]) if heard else None,
        "stretches": len(heard),
        "duration_s": sum(len(each.stretch.sp) for each in heard) * question.sample_s,
        "sample_s": question.sample_s,
        "no_data": question.no_data,
        "disturbed_by": question.disturbed_by,
    }


def _at_s(change: SetpointChange, heard: Sequence[HeardStretch], sample: int) -> float:
    """The wall time of a sample of the stretch that a change belongs to."""
    at_s = next(each.at_s for each in heard if each.stretch is change.stretch)
    return float(at_s[min(max(sample, 0), len(at_s) - 1)])


def _change(change: SetpointChange, heard: Sequence[HeardStretch]) -> dict[str, object]:
    return {
        "at_s": _at_s(change, heard, change.move),
        "sp_before": float(change.stretch.sp[change.move - 1]),
        "size": change.size,
    }


def _loads(
    evaluation: Evaluation, changes: Sequence[SetpointChange], heard: Sequence[HeardStretch]
) -> list[dict[str, object]]:
    """The load disturbances, with the time at which each acts on the plant's input."""
    fit = evaluation.fit
    found: list[dict[str, object]] = []
    for seen, entered, size in load_disturbances(fit, evaluation.chosen.best):
        piece = next(n for n, each in enumerate(fit.pieces) if seen < each.stop)
        if piece == 0:  # in the time at rest, which is no change
            continue
        change = changes[piece - 1]
        sample = change.first + round(entered) - fit.pieces[piece].start
        found.append({"at_s": _at_s(change, heard, sample), "size": size})
    return found


def _range(columns: Sequence[np.ndarray[tuple[int], np.dtype[np.float64]]]) -> dict[str, float] | None:
    if not columns:
        return None
    return {"low": float(min(map(np.min, columns))), "high": float(max(map(np.max, columns)))}


def _trial(evaluation: Evaluation, spec: DesignSpec) -> dict[str, object]:
    model = evaluation.model
    given = {"num": list(model.num), "den": list(model.den), "dead_time_s": model.L}
    asked = {"Ms": spec.Ms, "derivative": spec.derivative, "aim": spec.aim, **spec.requirements}
    return {"method": FAST, "start": "design", **asked, "model": given}
