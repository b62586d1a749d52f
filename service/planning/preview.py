"""Previews what a retune would do to a loop; pure, from the configuration, the request and the loop's present state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import BaseModel, Field

from loopwright.service.inputs.config import Limits, LoopConfig
from loopwright.service.inputs.request import FiveStages, RetuneRequest, narrow
from loopwright.service.planning.durations import Span, durations
from loopwright.service.planning.excitation_preview import ExcitationPreview, excitation_previews
from loopwright.service.planning.facts import time_budget_s
from loopwright.service.planning.moves import Before, Moves, moves, stages_asked
from loopwright.service.planning.obstacles import Now, Obstacle, Occupied, obstacles
from loopwright.service.results import KnowledgeView, Result, TransferModelView
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.fast.manual_procedure import MANUAL
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode


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
        description="How far PV is expected to go from the present set-point, in manual from its present value, PV "
        "units; null: not known before",
        examples=[2.8],
    )
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
        description="How far PV is expected to go from the present set-point, PV units; null: not known before",
        examples=[2.8],
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
) -> Preview:
    """Returns the preview of one loop.

    knowledge: what is known of the loop from its tests and from operation.
    now: without a state in it the figures are the largest that the configured limits permit.
    last: the last retune of the loop that ended in a proposal; None where there is none.
    """
    narrowed, _ = narrow(config, request)
    state = None if request.dry_run else now.state
    permitted = _permitted(narrowed, state)
    limited = narrowed.model_copy(update={"mv_limits": permitted})
    Ku, Pu_s = _entered(request)
    pu_s = Pu_s or (last.Pu_s if last else None)
    sample_time_s = state.sample_time_s if state else None
    rate = narrowed.test.sp_rate_max_per_s
    ramp_s = narrowed.sp_deviation / rate if rate else 0.0
    mode = state.mode if state else Mode.AUTOMATIC
    times = durations(request, stages_asked(narrowed, request, mode), config.t95_s, sample_time_s, pu_s, ramp_s)
    mv, sp = (_finite(state.mv), _finite(state.sp)) if state else (None, None)
    before = Before(
        state.gains if state else None, mv, Ku or (last.Ku if last else None), mode,
        state.reverse_acting if state else True,
    )  # fmt: skip
    moved = [] if request.dry_run else moves(limited, request, before)
    stages = [_stage(each, times[each.stage], permitted, mv, sp) for each in moved]
    in_the_way = obstacles(config, request, now)
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
        largest_pv_move=_largest_pv(stages),
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


def _stage(each: Moves, time: Span, mv_limits: Limits, mv: float | None, sp: float | None) -> StagePreview:
    moves_mv, moves_sp = max(each.mv_down, each.mv_up) > 0.0, max(each.sp_up, each.sp_down) > 0.0
    low, high = time
    return StagePreview(
        stage=each.stage,
        what=each.what,
        mv_low_pct=_rounded(max(mv_limits.low, mv - each.mv_down)) if mv is not None and moves_mv else None,
        mv_high_pct=_rounded(min(mv_limits.high, mv + each.mv_up)) if mv is not None and moves_mv else None,
        mv_move_pct=_rounded(max(each.mv_down, each.mv_up)),
        sp_low=_rounded(sp - each.sp_down) if sp is not None and moves_sp else None,
        sp_high=_rounded(sp + each.sp_up) if sp is not None and moves_sp else None,
        sp_move=_rounded(max(each.sp_up, each.sp_down)),
        pv_move=None if each.pv is None else _rounded(each.pv),
        duration_low_s=_rounded(low),
        duration_high_s=_rounded(high),
    )


def _largest_pv(stages: Sequence[StagePreview]) -> float | None:
    known = [each.pv_move for each in stages if each.pv_move is not None]
    return max(known, default=0.0) if len(known) == len(stages) else None


def _obstacle(found: Obstacle, now: Now) -> ObstacleView:
    job = f"/jobs/{now.active_job}" if found.reason is Occupied.BUSY else None
    return ObstacleView(reason=found.reason.value, detail=found.detail, advice=found.advice, job=job)


def _budget_s(request: RetuneRequest, config: LoopConfig, state: LoopState | None) -> float | None:
    if request.max_time_s is not None or state is None:
        return request.max_time_s
    return time_budget_s(request.method, config.t95_s, state.sample_time_s)


def _entered(request: RetuneRequest) -> tuple[float | None, float | None]:
    """Returns the ultimate gain and period of the request; None for each that was not entered."""
    return (request.Ku, request.Pu_s) if isinstance(request, FiveStages) else (None, None)


def _basis(request: RetuneRequest, config: LoopConfig, last: LastProposal | None) -> str:
    if request.dry_run:
        return "a dry run takes no time of the plant"
    if (Pu_s := _entered(request)[1]) is not None:
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
    if state is not None and state.when_silent:
        silent = f" If the controller itself falls silent, the plant's I/O {state.when_silent}."
    by_itself = "The controller does that by itself also when the service or the bus fails."
    at_once = " Where a test is cut short the set-point goes home at once, not by a ramp." if ramped else ""
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
    goes = "How far PV goes under the relay is not known beforehand."
    if found.largest_pv_move is not None:
        where = (
            "where it is now" if any(each.stage == MANUAL for each in found.stages) else "the set-point as it is now"
        )
        goes = f"PV is expected to go up to {found.largest_pv_move:.3g} {unit} from {where}."
    time, pv = duration_text(found.duration_low_s, found.duration_high_s), found.watched.pv
    lines = [
        f"A retune of {found.loop} by {found.method} moves MV {first}by at most {found.largest_mv_move_pct:.3g} %, "
        f"within {limits}, and the set-point by at most {found.largest_sp_move:.4g} {unit}.",
        f"It takes {time} of plant time; that is estimated from {found.duration_basis}.",
        f"{goes} It is watched within {pv.low:g} .. {pv.high:g} {unit}: beyond that the test ends.",
        f"After an abort, a limit or a failure: {found.on_abort}",
        f"At the end: {found.at_the_end}",
    ]
    lines += [f"{each.excitation}: {_told(each)}" for each in found.excitations if len(found.excitations) > 1]
    if found.mv is None:
        lines.insert(1, "The loop could not be read: these are the largest moves that the configured limits permit.")
    return lines


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
    """What a retune of many loops would do, from configuration and earlier jobs; no controller is asked."""

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
