"""Previews what a retune would do to a loop; pure, from the configuration, the request and the loop's present state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pydantic import BaseModel, Field

from loopwright.service.inputs.config import Limits, LoopConfig
from loopwright.service.inputs.request import RetuneRequest, narrow
from loopwright.service.planning.durations import Span, durations
from loopwright.service.planning.excitation_preview import ExcitationPreview, excitation_previews
from loopwright.service.planning.expected import NOTHING_EXPECTED, ExpectedPv, Reach
from loopwright.service.planning.facts import time_budget_s
from loopwright.service.planning.moves import Before, Moves, moves, stages_asked
from loopwright.service.planning.obstacles import Now, Obstacle, Occupied, obstacles
from loopwright.service.results import KnowledgeView, Result, TransferModelView
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason


@dataclass(frozen=True, slots=True)
class LastProposal:
    """The last retune of this loop that ended in a proposal.

    ended_at: the end of the job, UTC, ISO 8601.
    Ku, Pu_s: the ultimate gain, percent per PV unit, and period, s; None where the model has none.
    plant_time_s: the plant time that the job took, s.
    """

    job_id: str
    ended_at: str | None
    method: str
    structure: str
    Ku: float | None
    Pu_s: float | None
    plant_time_s: float

    @classmethod
    def of(cls, job_id: str, ended_at: str | None, plant_time_s: float, result: Result) -> LastProposal:
        """Makes it from the result of a job that ended in a proposal."""
        if isinstance(result.model, TransferModelView):
            structure = result.model.structure
        else:
            structure = "fopdt" if result.model is None or result.model.zeta is None else "sopdt"
        point = result.ultimate
        Ku, Pu_s = (None, None) if point is None else (point.Ku, point.Pu_s)
        return cls(job_id, ended_at, result.method, structure, Ku, Pu_s, plant_time_s)


class ObstacleView(BaseModel):
    """Something for which a retune would not start, or would end before anything is moved."""

    reason: str = Field(description="From the closed list of reasons, or busy", examples=["wrong_mode"])
    detail: str = Field(description="The numbers", examples=["the controller is in mode manual, not automatic"])
    advice: str = Field(description="What to do about it")
    job: str | None = Field(
        default=None, description="URL of the job that has the loop", examples=["/jobs/4f0c2a9be113"]
    )


class StagePreview(BaseModel):
    """What one stage would move. Absolute values are null where the present ones are not known."""

    stage: str = Field(examples=["relay"])
    what: str = Field(description="What is moved, in a sentence")
    mv_low_pct: float | None = Field(description="The test moves MV down to this at most, percent", examples=[25.0])
    mv_high_pct: float | None = Field(description="The test moves MV up to this at most, percent", examples=[100.0])
    mv_move_pct: float = Field(description="The largest move of MV away from where it is, percent", examples=[50.0])
    sp_low: float | None = Field(description="Set-point at least, PV units", examples=[50.0])
    sp_high: float | None = Field(description="Set-point at most, PV units", examples=[52.0])
    sp_move: float = Field(description="The largest step of the set-point, PV units", examples=[2.0])
    pv_move: float | None = Field(
        description="How far PV goes at most from the present set-point, in manual from its present value, by the "
        "model that is known, PV units; null: there is none",
        examples=[2.8],
    )
    pv_low: float | None = Field(description="PV is expected not to go below this, PV units; null likewise")
    pv_high: float | None = Field(description="PV is expected not to go above this, PV units; null likewise")
    duration_low_s: float = Field(description="Expected at least, plant time, s", examples=[7.0])
    duration_high_s: float = Field(description="Expected at most, plant time, s", examples=[30.0])


class WatchedLimits(BaseModel):
    """Limits whose violation ends the test at once; the gains and the set-point are then restored."""

    pv: Limits = Field(description="PV units; watched in the controller under the relay, and here at every sample")
    mv: Limits = Field(description="Percent; the narrower of the job's and the controller's own")
    max_time_s: float | None = Field(description="Plant time, s; null: depends on a sample time not known now")


class KnownPlant(BaseModel):
    """What is known of the loop before the test."""

    t95_s: float = Field(description="Time in which the plant covers 95 % of a step, s, from the configuration")
    noise_std: float | None = Field(
        description="Standard deviation of the noise of PV, PV units, from the configuration; null: not given"
    )
    model: str | None = Field(description="Structure of the last model found on this loop", examples=["sopdt"])
    model_job: str | None = Field(description="URL of the job that found it", examples=["/jobs/4f0c2a9be113"])
    model_at: str | None = Field(description="End of that job, UTC, ISO 8601, wall time")
    Ku: float | None = Field(description="Ultimate gain of that model, MV percent per PV unit", examples=[9.3])
    Pu_s: float | None = Field(description="Ultimate period of that model, s", examples=[14.4])
    last_plant_time_s: float | None = Field(description="Plant time that the job took, s", examples=[86.0])


class Preview(BaseModel):
    """What a retune with these options would do now. Nothing was moved to find it out."""

    loop: str = Field(examples=["TIC-101"])
    method: str = Field(examples=["fast"])
    dry_run: bool = Field(description="A rehearsal in memory, which moves nothing on the loop")
    would_start: bool = Field(description="True: there are no obstacles, as far as is known now")
    obstacles: list[ObstacleView] = Field(description="Every reason for which the retune would be refused")
    summary: list[str] = Field(description="The same in sentences")
    stages: list[StagePreview] = Field(description="In their order")
    sp: float | None = Field(description="Set-point now, PV units; null: not known", examples=[50.0])
    pv: float | None = Field(description="Process value now, PV units; null: not known", examples=[49.9])
    mv: float | None = Field(description="Controller output now, percent; null: not known", examples=[50.0])
    first_mv_move_pct: float | None = Field(
        description="Initial amplitude of the relay, or size of the first pulse of the manual output, percent of MV; "
        "null: there is neither",
        examples=[12.5],
    )
    largest_mv_move_pct: float = Field(description="The largest move of MV in any stage, percent", examples=[50.0])
    largest_sp_move: float = Field(
        description="The largest step of the set-point in any stage, PV units", examples=[2.0]
    )
    largest_pv_move: float | None = Field(
        description="How far PV goes at most in any stage, PV units; null: not known, there is no model of every stage",
        examples=[2.8],
    )
    mv_low_pct: float | None = Field(
        description="The test moves MV down to this at most in any stage, percent; null: the present MV is not known",
        examples=[24.0],
    )
    mv_high_pct: float | None = Field(description="Likewise up to this", examples=[75.0])
    pv_low: float | None = Field(
        description="PV is expected not to go below this in any stage, PV units; null as of largest_pv_move",
        examples=[48.2],
    )
    pv_high: float | None = Field(description="Likewise not above this", examples=[53.1])
    pv_known_by: str | None = Field(
        description="The model that this is computed from, in words; null: none is known of the loop",
        examples=["the model known from job 4f0c2a9be113"],
    )
    duration_low_s: float = Field(description="Shortest expected time of all stages, plant time, s", examples=[40.0])
    duration_high_s: float = Field(description="Longest expected time of all stages, plant time, s", examples=[160.0])
    duration_basis: str = Field(description="What the estimate is made from")
    watched: WatchedLimits
    at_the_end: str = Field(description="State of the loop after the test")
    on_abort: str = Field(description="State of the loop after an abort, a limit or a failure")
    known: KnownPlant
    excitations: list[ExcitationPreview] = Field(
        description="Method fast: the excitations that may follow each other, and what each would tell; else empty"
    )


def preview(
    config: LoopConfig,
    request: RetuneRequest,
    now: Now,
    last: LastProposal | None,
    knowledge: KnowledgeView | None = None,
    expected: ExpectedPv = NOTHING_EXPECTED,
) -> Preview:
    """Returns the preview of one loop.

    knowledge: what is known of the loop from its tests and from operation.
    expected: how far PV is expected to go, by the model that is known.
    now: without a state in it the figures are the largest that the configured limits permit.
    last: the last retune of the loop that ended in a proposal; None where there is none.
    """
    narrowed, _ = narrow(config, request)
    state = None if request.dry_run else now.state
    permitted = _permitted(narrowed, state)
    limited = narrowed.model_copy(update={"mv_limits": permitted})
    pu_s = request.entered_Pu_s or (last.Pu_s if last else None)
    sample_time_s = state.sample_time_s if state else None
    rate = narrowed.test.sp_rate_max_per_s
    ramp_s = narrowed.sp_deviation / rate if rate else 0.0
    mode = state.mode if state else Mode.AUTOMATIC
    times = durations(request, stages_asked(narrowed, request, mode), config.t95_s, sample_time_s, pu_s, ramp_s)
    mv, sp = (_finite(state.mv), _finite(state.sp)) if state else (None, None)
    before = Before(
        state.gains if state else None, mv, mode, state.reverse_acting if state else True, expected.begins_with_pct
    )
    moved = [] if request.dry_run else moves(limited, request, before)
    rest = _finite(state.pv) if state and mode is Mode.MANUAL else sp
    stages = [
        _stage(each, times[each.stage], permitted, mv, sp, rest, expected.stages.get(each.stage)) for each in moved
    ]
    in_the_way = obstacles(config, request, now)
    in_the_way += [Obstacle(Reason.BAD_LIMITS, text) for text in expected.broken]
    moving = [each for each in stages if each.mv_move_pct or each.sp_move]
    found = Preview(
        loop=config.tag,
        method=request.method,
        dry_run=request.dry_run,
        would_start=not in_the_way,
        obstacles=[_obstacle(each, now) for each in in_the_way],
        summary=[],
        stages=stages,
        sp=sp,
        pv=_finite(state.pv) if state else None,
        mv=mv,
        first_mv_move_pct=next((_rounded(each.first_mv) for each in moved if each.first_mv is not None), None),
        largest_mv_move_pct=max((each.mv_move_pct for each in stages), default=0.0),
        largest_sp_move=max((each.sp_move for each in stages), default=0.0),
        largest_pv_move=_all_known([each.pv_move for each in stages], max),
        mv_low_pct=_end([each.mv_low_pct for each in stages], min),
        mv_high_pct=_end([each.mv_high_pct for each in stages], max),
        pv_low=_all_known([each.pv_low for each in moving], min),
        pv_high=_all_known([each.pv_high for each in moving], max),
        pv_known_by=expected.source or None,
        duration_low_s=_rounded(sum(each.duration_low_s for each in stages)),
        duration_high_s=_rounded(sum(each.duration_high_s for each in stages)),
        duration_basis=_basis(request, config, last),
        watched=WatchedLimits(pv=narrowed.pv_limits, mv=permitted, max_time_s=_budget_s(request, limited, state)),
        at_the_end=_at_the_end(request),
        on_abort=_on_abort(request, state, config.pv_unit, ramped=rate is not None),
        known=_known(config, last),
        excitations=excitation_previews(limited, request, state, knowledge),
    )
    return found.model_copy(update={"summary": _summary(found, config.pv_unit)})


def _permitted(config: LoopConfig, state: LoopState | None) -> Limits:
    """Returns the narrower of the job's and the controller's MV limits; the job's where the two do not overlap."""
    limits = config.mv_limits
    if state is None:
        return limits
    low, high = max(limits.low, state.mv_low), min(limits.high, state.mv_high)
    return limits.model_copy(update={"low": low, "high": high}) if low < high else limits


def _stage(
    each: Moves,
    time: Span,
    mv_limits: Limits,
    mv: float | None,
    sp: float | None,
    rest: float | None,
    reach: Reach | None,
) -> StagePreview:
    moves_mv, moves_sp = max(each.mv_down, each.mv_up) > 0.0, max(each.sp_up, each.sp_down) > 0.0
    low, high = time
    still = not (moves_mv or moves_sp)
    known = None if still or rest is None else reach
    return StagePreview(
        stage=each.stage,
        what=each.what,
        mv_low_pct=_rounded(max(mv_limits.low, mv - each.mv_down)) if mv is not None and moves_mv else None,
        mv_high_pct=_rounded(min(mv_limits.high, mv + each.mv_up)) if mv is not None and moves_mv else None,
        mv_move_pct=_rounded(max(each.mv_down, each.mv_up)),
        sp_low=_rounded(sp - each.sp_down) if sp is not None and moves_sp else None,
        sp_high=_rounded(sp + each.sp_up) if sp is not None and moves_sp else None,
        sp_move=_rounded(max(each.sp_up, each.sp_down)),
        pv_move=0.0 if still else None if reach is None else _rounded(reach.farthest),
        pv_low=None if known is None or rest is None else _rounded(rest - known.down),
        pv_high=None if known is None or rest is None else _rounded(rest + known.up),
        duration_low_s=_rounded(low),
        duration_high_s=_rounded(high),
    )


def _end(values: Sequence[float | None], end: Callable[[Sequence[float]], float]) -> float | None:
    """The smallest or largest of what is known; None where nothing is."""
    known = [each for each in values if each is not None]
    return end(known) if known else None


def _all_known(values: Sequence[float | None], end: Callable[[Sequence[float]], float]) -> float | None:
    """The same; None also where one is not known."""
    return None if None in values else _end(values, end)


def _obstacle(found: Obstacle, now: Now) -> ObstacleView:
    job = f"/jobs/{now.active_job}" if found.reason is Occupied.BUSY else None
    return ObstacleView(reason=found.reason.value, detail=found.detail, advice=found.advice, job=job)


def _budget_s(request: RetuneRequest, config: LoopConfig, state: LoopState | None) -> float | None:
    if request.max_time_s is not None or state is None:
        return request.max_time_s
    return time_budget_s(request.method, config.t95_s, state.sample_time_s)


def _basis(request: RetuneRequest, config: LoopConfig, last: LastProposal | None) -> str:
    if request.dry_run:
        return "a dry run takes no time of the plant"
    if (Pu_s := request.entered_Pu_s) is not None:
        return f"Pu {Pu_s:g} s as entered, and T95 {config.t95_s:g} s of the configuration"
    if last is not None and last.Pu_s:
        return f"Pu {last.Pu_s:.4g} s of the model that job {last.job_id} found, and T95 {config.t95_s:g} s"
    return f"T95 {config.t95_s:g} s of the configuration alone, which leaves the period uncertain by a factor of ten"


def _at_the_end(request: RetuneRequest) -> str:
    if request.dry_run:
        return "Nothing on the loop has changed."
    return "The loop is as after an abort; the new gains are a proposal, which takes effect when a person accepts it."


def _on_abort(request: RetuneRequest, state: LoopState | None, unit: str, ramped: bool) -> str:
    if request.dry_run:
        return "Nothing on the loop has changed."
    silent = ""
    if state is not None and state.fail_action:
        silent = f" If the controller itself fails, the plant's I/O {state.fail_action}."
    by_itself = "The controller does that by itself also when the service or the bus fails."
    at_once = " Where a test is cut short the set-point returns at once, not by a ramp." if ramped else ""
    return f"{_home(state, unit)} {by_itself}{at_once}{_on_false_pv(state)}{silent}"


def _on_false_pv(state: LoopState | None) -> str:
    """Returns what becomes of a loop in automatic whose PV is found to be false; "" where it is as after an abort."""
    if state is not None and state.mode is not Mode.AUTOMATIC:
        return ""
    return (
        " Where PV is found to be false (it stands still, or jumps, as the plant cannot) the controller is in manual "
        "at the MV of before instead, until an operator acts."
    )


def _home(state: LoopState | None, unit: str) -> str:
    if state is None:
        return "The controller has its mode, set-point and gains as they were before."
    gains = _gains_text(state.gains)
    if state.mode is Mode.MANUAL:
        return f"The controller is in manual again, manual output {state.manual_output:.6g} %, with {gains}."
    return f"The controller is in {state.mode.name.lower()} again, set-point {state.sp:.6g} {unit}, with {gains}."


def _gains_text(gains: Gains) -> str:
    b = f", b {gains.b:.3g}" if gains.b != 1.0 else ""
    return f"the gains it has now (Kp {gains.Kp:.4g}, Ti {gains.Ti:.4g} s{b})"


def _known(config: LoopConfig, last: LastProposal | None) -> KnownPlant:
    return KnownPlant(
        t95_s=config.t95_s,
        noise_std=config.noise_std_hint,
        model=last.structure if last else None,
        model_job=f"/jobs/{last.job_id}" if last else None,
        model_at=last.ended_at if last else None,
        Ku=last.Ku if last else None,
        Pu_s=last.Pu_s if last else None,
        last_plant_time_s=last.plant_time_s if last else None,
    )


def _summary(found: Preview, unit: str) -> list[str]:
    if found.dry_run:
        return [f"A dry run of {found.loop} is computed in memory; nothing on the loop is moved."]
    first = "" if found.first_mv_move_pct is None else f"by {found.first_mv_move_pct:.3g} % at first and "
    limits = f"{found.watched.mv.low:g} .. {found.watched.mv.high:g} %"
    time, pv = duration_text(found.duration_low_s, found.duration_high_s), found.watched.pv
    lines = [
        f"A retune of {found.loop} by {found.method} moves MV {first}by at most {found.largest_mv_move_pct:.3g} %, "
        f"within {limits}, and the set-point by at most {found.largest_sp_move:.4g} {unit}.",
        f"It takes {time} of plant time; that is estimated from {found.duration_basis}.",
        f"{_goes(found, unit)} PV is watched within {pv.low:g} .. {pv.high:g} {unit}: beyond that the test ends.",
        f"After an abort, a limit or a failure: {found.on_abort}",
        f"At the end: {found.at_the_end}",
    ]
    lines += [f"{each.excitation}: {_told(each)}" for each in found.excitations if len(found.excitations) > 1]
    if found.mv is None:
        lines.insert(1, "The loop could not be read: these are the largest moves that the configured limits permit.")
    return lines


def _goes(found: Preview, unit: str) -> str:
    """How far MV and PV go, in sentences."""
    mv = ""
    if found.mv_low_pct is not None and found.mv_high_pct is not None:
        mv = f"MV moves between {found.mv_low_pct:.3g} and {found.mv_high_pct:.3g} % (present {found.mv:.3g} %)"
    if found.pv_low is not None and found.pv_high is not None:
        pv = f"PV is expected between {_pv(found.pv_low, found)} and {_pv(found.pv_high, found)} {unit}"
        return f"{mv}{', ' if mv else ''}{pv}, by {found.pv_known_by}."
    partly = [each for each in found.stages if each.pv_low is not None and each.pv_high is not None]
    pv = "How far PV goes is not known beforehand: no model of this loop tells it."
    if partly:
        of = "; ".join(f"{s.stage} {_pv(s.pv_low, found)} to {_pv(s.pv_high, found)} {unit}" for s in partly)
        pv = f"How far PV goes is known of some stages alone, by {found.pv_known_by}: {of}."
    return f"{mv}. {pv}" if mv else pv


def _pv(value: float | None, found: Preview) -> str:
    """PV with a hundredth of its way."""
    assert value is not None
    way = (found.largest_pv_move or max(each.pv_move or 0.0 for each in found.stages)) or 1.0
    return f"{value:.{max(0, 2 - math.floor(math.log10(way)))}f}"


def _told(each: ExcitationPreview) -> str:
    if each.duration_s is None or each.Ms_uncertainty is None:
        return each.when
    return (
        f"{each.when} It would tell Ms to +-{each.Ms_uncertainty:.2g} in {duration_text(0.0, each.duration_s)} "
        f"({each.information_per_pu:.3g} of information per ultimate period)."
    )


def duration_text(low_s: float, high_s: float) -> str:
    """Returns two times as text in a suitable unit; the first is left out where it is 0."""
    unit, name = next(((u, n) for u, n in ((3600.0, "h"), (60.0, "min")) if high_s >= 3.0 * u), (1.0, "s"))
    low, high = (f"{time / unit:.{0 if time >= 10.0 * unit else 1}f}" for time in (low_s, high_s))
    return f"{low} to {high} {name}" if low_s else f"up to {high} {name}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rounded(value: float) -> float:
    """Rounds to six digits, which are enough for an estimate."""
    return float(f"{value:.6g}")


class FleetPreview(BaseModel):
    """What a batch would do, from configuration and earlier jobs; no controller is asked."""

    count: int = Field(description="Number of loops", examples=[40])
    would_start: int = Field(description="Number of loops that would start, as far as is known", examples=[38])
    largest_mv_move_pct: float = Field(description="Largest move of MV on any of the loops, percent", examples=[66.7])
    largest_mv_move_loop: str = Field(description="Loop with the largest move of MV", examples=["TIC-101"])
    longest_s: float = Field(description="Longest time of one loop, plant time, s; at most", examples=[600.0])
    longest_loop: str = Field(description="Loop with the longest time", examples=["LIC-7"])
    summary: list[str] = Field(description="The same in sentences")
    loops: list[Preview] = Field(description="Preview of each loop, in the order in which the loops are begun")


def fleet_preview(loops: Sequence[Preview]) -> FleetPreview:
    """Returns the preview of all loops, of which there must be at least one."""
    boldest, longest = max(loops, key=lambda p: p.largest_mv_move_pct), max(loops, key=lambda p: p.duration_high_s)
    able = sum(each.would_start for each in loops)
    summary = [
        f"{len(loops)} loops are retuned by {loops[0].method}; {len(loops) - able} of them would be refused now.",
        f"MV is moved by at most {boldest.largest_mv_move_pct:.3g} % ({boldest.loop}).",
        f"One loop takes at most {duration_text(0.0, longest.duration_high_s)} of plant time ({longest.loop}).",
        "The controllers have not been asked; the preview of a single loop asks its controller.",
    ]
    return FleetPreview(
        count=len(loops),
        would_start=able,
        largest_mv_move_pct=boldest.largest_mv_move_pct,
        largest_mv_move_loop=boldest.loop,
        longest_s=longest.duration_high_s,
        longest_loop=longest.loop,
        summary=summary,
        loops=list(loops),
    )
