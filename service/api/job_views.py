"""The views of jobs and loops. Units are in the descriptions; times are plant time unless they are called wall time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, Field

from loopwright.service.api.watch_views import MonitoringView
from loopwright.service.inputs.config import Limits, LoopConfig, PermittedTest
from loopwright.service.inputs.validation import STRICT
from loopwright.service.jsonable import JsonObject, number
from loopwright.service.results import (
    FIVE_STAGE,
    ComparisonView,
    EvidenceView,
    FastResult,
    FiveStageResult,
    GainsView,
    KnowledgeView,
    ModelView,
    PredictedView,
    RehearsedOnView,
    StepView,
    TransferModelView,
    UltimateView,
    VerificationView,
    empty_result,
)
from loopwright.service.security.principal import signed
from loopwright.service.states.acceptance_watch import AcceptanceWatch
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.states.loop_state import LoopState, gains_of, same_gains
from loopwright.service.store.clock import stamp
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import ADVICE, Ended, Reason

if TYPE_CHECKING:  # the command line reads views, and has no store
    from loopwright.service.jobs.active_job import Running
    from loopwright.service.jobs.aftercare import UnconfirmedRestoration
    from loopwright.service.live.snapshot import JobProgress
    from loopwright.service.store.decision_requests import DecisionRequest
    from loopwright.service.store.jobs import Job, JobEvent
    from loopwright.service.store.live_jobs import Acceptance, JobInBrief
    from loopwright.service.store.tables import LoopLockRow


class LockView(BaseModel):
    """A lock, which keeps tests and decisions from a loop."""

    reason: str = Field(examples=["valve is being overhauled"])
    by: str = Field(description="Who locked the loop, as given in the request", examples=["night shift"])
    since: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])

    @classmethod
    def of(cls, row: LoopLockRow) -> LockView:
        return cls(reason=row.reason, by=row.by, since=row.since)


class LastJobView(BaseModel):
    """The latest job of a loop; dry runs do not count."""

    url: str = Field(examples=["/jobs/4f0c2a9be113"])
    state: JobState
    at: str = Field(
        description="When the job ended, or else began, or was made: UTC, ISO 8601",
        examples=["2026-01-31T12:00:00.000Z"],
    )
    reason: Reason | None = Field(description="Why there is no proposal; reason code from the closed list")
    stage: str | None = Field(description="The present or last stage", examples=["relay"])

    @classmethod
    def of(cls, job: JobInBrief) -> LastJobView:
        return cls(url=f"/jobs/{job.id}", state=job.state, at=job.at, reason=job.reason, stage=job.stage)


class AcceptedView(BaseModel):
    """The gains that were accepted last and not rolled back."""

    url: str = Field(description="URL of the job that proposed them", examples=["/jobs/4f0c2a9be113"])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    by: str = Field(description="Who accepted, as given in the request", examples=["operator A"])
    Ms: float | None = Field(description="Maximum sensitivity asked for; null: there is none", examples=[1.6])
    gains: GainsView

    @classmethod
    def of(cls, found: Acceptance) -> AcceptedView:
        gains = GainsView.of(found.gains)
        return cls(url=f"/jobs/{found.job_id}", at=found.at, by=found.by, Ms=found.Ms, gains=gains)


class LiveErrorView(BaseModel):
    """Why the present state of a loop cannot be read."""

    reason: Reason = Field(description="Reason code from the closed list", examples=["node_lost"])
    detail: str = Field(description="What happened, with the numbers")
    advice: str = Field(description="What the operator should do")

    @classmethod
    def of(cls, ended: Ended) -> LiveErrorView:
        return cls(reason=ended.reason, detail=ended.detail, advice=ended.advice)


class LoopView(BaseModel):
    """A configured loop."""

    tag: str = Field(description="Name of the loop", examples=["TIC-101"])
    description: str = Field(examples=["Reactor outlet temperature"])
    bus: str = Field(description="Address of the CAN bus", examples=["socketcan:vcan0"])
    controller_node: int = Field(description="CANopen node id of the controller", examples=[32])
    plant_node: int | None = Field(description="CANopen node id of a simulated plant", examples=[16])
    channel: int = Field(description="Channel of the controller, from 1", examples=[1])
    pv_unit: str = Field(description="Unit of PV and SP", examples=["degC"])
    mv_limits: Limits = Field(description="Permitted MV, percent")
    pv_limits: Limits = Field(description="Permitted PV, PV units")
    t95_s: float = Field(description="Time in which the plant covers 95 % of a step, s", examples=[9.1])
    sp_deviation: float = Field(description="Permitted set-point step, PV units", examples=[2.0])
    setpoint_from: Literal["operator", "remote"] = Field(
        description="Who moves the set-point in normal operation: an operator, or (remote) another controller. Method "
        "setpoint is refused for a remote set-point",
        examples=["operator"],
    )
    outer_loop: str | None = Field(
        description="Tag of the controller that moves a remote set-point; null: not named in loops.yaml",
        examples=["TIC-100"],
    )
    test: PermittedTest = Field(description="What a test may do to the loop, from loops.yaml")
    area: str | None = Field(description="Area of the site, as named in loops.yaml", examples=["distillation"])
    notes: str = Field(description="Notes for the operator")
    gateway: str = Field(description="Name of the gateway that is connected to the bus of the loop", examples=["local"])
    active_job: str | None = Field(description="URL of the job that is using the loop", examples=["/jobs/4f0c2a9be113"])
    last_job_state: JobState | None = Field(description="State of the latest job of the loop; dry runs do not count")
    last_job: LastJobView | None = Field(description="The latest job; null: there is none")
    accepted: AcceptedView | None = Field(description="The gains accepted last; null: there are none")
    gains_differ: bool | None = Field(
        description="Whether the gains in effect, as read last, are other than `accepted`; null: none were accepted, "
        "or those in effect are not known"
    )
    locked: LockView | None = Field(description="The lock of the loop; null: the loop is not locked")


class LiveView(BaseModel):
    """The present state of a loop, read from the controller or from the job that is using the loop."""

    sp: float = Field(description="Set-point, PV units", examples=[50.0])
    pv: float | None = Field(description="Process value, PV units", examples=[49.8])
    mv: float | None = Field(description="Controller output, percent", examples=[41.2])
    mode: str = Field(description="off, manual, automatic or experiment", examples=["automatic"])
    gains: GainsView = Field(description="Gains in effect; the accepted gains while another tuner has gains on trial")
    on_trial: bool = Field(description="True while gains are on trial under the tuner's lease")
    mv_low: float = Field(description="The controller's own lower output limit, percent", examples=[0.0])
    mv_high: float = Field(description="The controller's own upper output limit, percent", examples=[100.0])
    sample_time_s: float = Field(description="Sampling period, s", examples=[0.1])
    reverse_acting: bool = Field(description="True: MV falls as PV rises")
    node_state: str = Field(
        description="operational, or the state of a node of the loop that is not operational",
        examples=["operational", "node 20h is pre-operational"],
    )
    fail_action: str = Field(
        description="What the plant's I/O does with MV when the controller fails; empty: not known",
        examples=["it holds MV where it is"],
    )


class RestoreUnconfirmedView(BaseModel):
    """A loop whose restoration after a job is not confirmed. The service checks the loop until the restoration is
    confirmed, or until `POST /loops/TAG/acknowledge`."""

    job: str = Field(description="URL of the job", examples=["/jobs/4f0c2a9be113"])
    reason: Reason | None = Field(description="Reason code from the closed list", examples=["node_not_operational"])
    detail: str = Field(description="Result of the latest check")
    advice: str = Field(description="The detail, and what the operator should do")

    @classmethod
    def of(cls, found: UnconfirmedRestoration) -> RestoreUnconfirmedView:
        return cls(job=f"/jobs/{found.job_id}", reason=found.reason, detail=found.detail, advice=found.words)


class LastDataView(BaseModel):
    """The last values of a loop."""

    pv: float | None = Field(description="Process value, PV units", examples=[49.8])
    sp: float | None = Field(description="Set-point, PV units", examples=[50.0])
    mv: float | None = Field(description="Controller output, percent", examples=[41.2])
    mode: str | None = Field(description="off, manual, automatic or experiment", examples=["automatic"])
    age_s: float | None = Field(description="How long ago, wall time, s", examples=[12.5])


class LoopDetail(LoopView):
    live: LiveView | None = Field(
        description="The present state; null: the loop, or the gateway that has it, is not reached (`live_error`). Of "
        "a loop of another gateway it is what that one wrote into the database last, a second ago; gains and limits "
        "were read within the last minute"
    )
    live_error: LiveErrorView | None = Field(description="Why the present state cannot be read; null: it is not so")
    last_data: LastDataView | None = Field(
        description="The last values of a loop whose present state is not known (`live` is null); of a loop of "
        "another gateway, what that one has said last. null: the present state is known, or there was none"
    )
    restore_unconfirmed: RestoreUnconfirmedView | None = Field(
        description="The unconfirmed restoration; null: there is none"
    )
    not_acknowledged: str | None = Field(
        default=None,
        description="Which test has found PV to be false, and how that is acknowledged: until then no test begins; "
        "null: there is none",
        examples=["job 4f0c2a9be113 found PV of loop TIC-101 to be false, and nobody has acknowledged that: ..."],
    )
    disturbed_by: str | None = Field(
        description="Which neighbours are under test and may disturb the loop: loops of the same area, and those whose "
        "outer_loop this loop is; null: none",
        examples=["TIC-102 is under test (job 4f0c2a9be113)"],
    )
    knowledge: KnowledgeView | None = Field(
        description="What is known of the loop from its tests and from normal operation; null: nothing is"
    )
    monitoring: MonitoringView | None = Field(
        default=None,
        description="The monitoring of the loop since `accepted`; null: there is none",
    )


class AcknowledgedView(BaseModel):
    """The jobs for which somebody has taken over the loop: its restoration was not confirmed, or its PV false."""

    loop: str = Field(examples=["TIC-101"])
    jobs: list[str] = Field(
        description="URLs of the jobs; empty: there was nothing to answer for", examples=[["/jobs/4f0c2a9be113"]]
    )


class StageView(BaseModel):
    stage: str = Field(examples=["relay"])
    state: str = Field(description="running, done or ended", examples=["done"])
    result: Mapping[str, object] | None = Field(description="Result of the stage; times in s, gains in ISA form")
    plant_time_s: float | None = Field(description="Plant time the stage took, s", examples=[120.5])


class DecidedView(BaseModel):
    """What was decided last about the proposal of a job."""

    what: Literal["accept", "rollback"]
    by: str = Field(description="Who decided, as given in the request", examples=["operator A"])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])


class DecisionRequestView(BaseModel):
    """A decision that was asked at another gateway than the one that has the loop, and has not been carried out."""

    what: Literal["accept", "rollback"]
    by: str = Field(description="Who has asked, as given in the request", examples=["operator A"])
    at: str = Field(
        description="UTC, ISO 8601, wall time by the clock of the database", examples=["2026-01-31T12:00:00.000Z"]
    )
    gateway: str = Field(description="Name of the gateway at which it was asked", examples=["gw-1"])
    state: Literal["waiting", "under_way", "refused", "expired", "withdrawn", "cut_off"] = Field(
        description="waiting: its gateway has not begun it; under_way; refused: it ended with an error; expired, "
        "withdrawn: it was not begun, and will not be; cut_off: its gateway ended in the middle, and whether the gains "
        "were written is not known"
    )
    detail: str | None = Field(description="Why it was refused")

    @classmethod
    def of(cls, found: DecisionRequest | None, state: JobState) -> DecisionRequestView | None:
        """state: of the job. Returns None for a request that was carried out, or whose aim was reached otherwise."""
        if found is None or found.what == "writes_over" or found.state == "done":
            return None
        if state is JobState.ROLLED_BACK or (state is JobState.ACCEPTED and found.what == "accept"):
            return None
        return cls.model_validate(
            {
                "what": found.what.value,
                "by": found.by,
                "at": stamp(datetime.fromtimestamp(found.asked_s, UTC)),
                "gateway": found.asked_at,
                "state": found.state.value,
                "detail": (found.answer.detail or None) if found.answer else None,
            }
        )


class StoppingView(BaseModel):
    """The request by which somebody has stopped a job."""

    by: str = Field(description="Who has stopped it, as given in the request", examples=["operator A"])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])


class JobLinks(BaseModel):
    """Where to find what belongs to a job, and what may be done about it now."""

    loop: str = Field(examples=["/loops/TIC-101"])
    events: str = Field(description="Its events, as they happen", examples=["/jobs/4f0c2a9be113/events"])
    log: str = Field(description="Its events so far, as a list", examples=["/jobs/4f0c2a9be113/log"])
    samples: str = Field(examples=["/jobs/4f0c2a9be113/samples"])
    record: str | None = Field(description="The record with the model; null: there is none")
    report: str | None = Field(description="The report, as HTML; null: the job is not over")
    alternatives: str | None = Field(description="Gains by other methods; null: there is no model")
    designs: str | None = Field(description="Gains from robust to fast; null: there is no model")
    accept: str | None = Field(description="POST here accepts the proposal; null: there is none to accept")
    rollback: str | None = Field(
        description="POST here declines the proposal, or puts the previous gains back; null: there is nothing to put "
        "back"
    )
    abort: str | None = Field(description="POST here stops the job; null: it is over")

    @classmethod
    def of(cls, row: Job, state: JobState, has_model: bool, has_record: bool) -> JobLinks:
        here, over = f"/jobs/{row.id}", state not in ACTIVE

        def when(permitted: bool, what: str) -> str | None:
            return f"{here}/{what}" if permitted else None

        return cls(
            loop=f"/loops/{row.loop}",
            events=f"{here}/events",
            log=f"{here}/log",
            samples=f"{here}/samples",
            record=when(has_record, "record"),
            report=when(over, "report"),
            alternatives=when(over and has_model, "alternatives"),
            designs=when(over and has_model, "designs"),
            accept=when(state is JobState.PROPOSED, "accept"),
            rollback=when(state in (JobState.PROPOSED, JobState.ACCEPTED), "rollback"),
            abort=when(not over, "abort"),
        )


class JobView(BaseModel):
    """A job: its request, its progress and its result."""

    id: str = Field(examples=["4f0c2a9be113"])
    url: str = Field(examples=["/jobs/4f0c2a9be113"])
    links: JobLinks
    loop: str = Field(examples=["TIC-101"])
    state: JobState = Field(
        description="State of the job. no_gain: the loop is already tuned as well as requested, which is a success; "
        "rehearsed: a dry run that found gains without a test of the loop",
        examples=["running"],
    )
    dry_run: bool
    gateway: str = Field(description="Name of the gateway that runs the job", examples=["local"])
    attempts: int = Field(
        description="Number of starts of the job; more than 1 after a crash of the service", examples=[1]
    )
    request: Mapping[str, object] = Field(description="The options of the request")
    by: str = Field(examples=["night shift"])
    created_at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    started_at: str | None = Field(description="UTC, ISO 8601, wall time")
    ended_at: str | None = Field(description="UTC, ISO 8601, wall time")
    stage: str | None = Field(description="The present or last stage", examples=["ultimate"])
    progress: float = Field(
        ge=0,
        le=1,
        description="Fraction of the expected plant time, 0 to 1. Of a job of another gateway it is up to 2 s old, as "
        "are the times below; while that gateway says nothing, they are those at the start of its present stage",
        examples=[0.42],
    )
    remaining_plant_time_s: float | None = Field(description="Expected plant time to the end, s", examples=[310.0])
    remaining_wall_time_s: float | None = Field(
        description="The same in wall time, s, at the pace that the plant had so far in this attempt; null: not known",
        examples=[310.0],
    )
    plant_time_s: float = Field(description="Plant time so far, s", examples=[224.0])
    stages: list[StageView]
    method: str = Field(description="Method that computes the gains", examples=["fast"])
    design: dict[str, float] = Field(description="Design parameters of the method in effect; the names carry the units")
    ultimate: UltimateView | None
    model: ModelView | TransferModelView | None = Field(
        description="The process model, in the form of five-stage or of fast"
    )
    previous_gains: GainsView | None
    new_gains: GainsView | None = Field(
        description="The gains proposed or rehearsed, or of a job with no_gain those found no better"
    )
    comparison: ComparisonView | None = Field(
        description="Comparison of the present and the new gains on the model; null: there are no new gains"
    )
    rehearsed_on: RehearsedOnView | None = Field(
        description="The plant and the gains of a dry run; null: the job is no dry run"
    )
    predicted: PredictedView | None = Field(description="Predicted performance of the new gains on the model")
    predicted_previous: PredictedView | None = Field(
        description="Predicted performance of the previous gains on the same model, only for method fast; null: the "
        "loop is not stable with them. `comparison` has more figures, for every method"
    )
    model_from: str | None = Field(
        description="Where the model of method fast or setpoint comes from, in words; null: there is none",
        examples=["pulses of the set-point, and the set-point step under the new gains"],
    )
    evidence: EvidenceView | None = Field(description="Evidence from the record of method fast, also for a refused job")
    verification: VerificationView | None = Field(description="Measured step that verifies the model of method fast")
    tested_on_loop: bool | None = Field(
        description="Whether the new gains were on the loop for a set-point step; null: there are none, or of a dry "
        "run",
        examples=[True],
    )
    tested_b: float | None = Field(
        description="Set-point weight b that was on the loop for that step, where it is not that of the new gains; "
        "null: it is, or there was no step",
        examples=[1.0],
    )
    step_before: StepView | None = Field(
        description="Measured set-point step with the previous gains; only for five-stage"
    )
    step_after: StepView | None = Field(description="Measured set-point step with the new gains, from rest")
    notes: list[str]
    reason: Reason | None = Field(
        description="Why there is no proposal; reason code from the closed list", examples=["not_at_rest"]
    )
    detail: str | None = Field(description="The numbers behind the reason")
    advice: str | None = Field(description="What the operator should do about the reason")
    restored: Mapping[str, object] | None = Field(description="State of the loop as read back at the end")
    decided: DecidedView | None = Field(description="The latest decision; null: nothing was decided")
    decision_request: DecisionRequestView | None = Field(
        description="The latest decision about the job that was asked at another gateway and was not carried out; "
        "null: there is none"
    )
    superseded_by: str | None = Field(
        description="URL of the loop's latest job, where it came after this proposal and nothing was decided; null: "
        "this is no such proposal",
        examples=["/jobs/4f0c2a9be113"],
    )
    monitoring: MonitoringView | None = Field(
        default=None,
        description="The monitoring of the loop since the gains were accepted; null: they were not",
    )
    stopping: StoppingView | None = Field(description="The request to stop the job; null: there was none")
    sample_time_s: float | None = Field(
        description="Sampling period of the controller as the job found it, s; null: the job has not read the loop",
        examples=[0.1],
    )
    mode_found: str | None = Field(
        description="Mode of the loop as the job found it: manual or automatic; null: the job has not read the loop",
        examples=["automatic"],
    )
    record: Literal["kept", "deleted", "none"] = Field(
        description="kept: `GET /jobs/ID/record` has the record of the job; deleted: its samples were deleted, the "
        "result stays; none: the job is not over, or it ended before its second sample"
    )


class SamplesView(BaseModel):
    """Samples of a job as columns of equal length. Values are float32, as on the bus."""

    job: str
    stage: list[str] = Field(description="Stage of each sample")
    t_s: list[float] = Field(description="Plant time, s")
    sp: list[float] = Field(description="PV units")
    pv: list[float] = Field(description="PV units")
    mv: list[float] = Field(description="Percent")
    mode: list[int] = Field(description="0 off, 1 manual, 2 automatic, 3 experiment")


class Decision(BaseModel):
    """The person who decides, for the audit trail."""

    model_config = STRICT

    by: str | None = Field(
        default=None, max_length=100, description="The default is the name of the key", examples=["operator A"]
    )


class AcceptDecision(Decision):
    """The person who accepts, and what the monitoring of the loop may do."""

    auto_rollback: bool = Field(
        default=True,
        description="Put the previous gains back automatically if, while the loop is monitored, PV leaves its limits "
        "or an oscillation near the crossover grows over three periods, and nobody has changed gains or mode since",
    )


def signed_by(decision: Decision | None) -> str:
    """The name under which a decision is noted."""
    return signed(None if decision is None else decision.by)


def loop_view(
    config: LoopConfig,
    host: str,
    active: str | None,
    last: JobInBrief | None,
    accepted: Acceptance | None,
    in_effect: Gains | None,
    lock: LoopLockRow | None,
) -> LoopView:
    """active: the id of the job that is using the loop.  in_effect: None where the gains are not known, or on trial."""
    fields = config.model_dump(exclude={"noise_std_hint"})
    return LoopView(
        **fields,
        gateway=host,
        active_job=None if active is None else f"/jobs/{active}",
        last_job_state=None if last is None else last.state,
        last_job=None if last is None else LastJobView.of(last),
        accepted=None if accepted is None else AcceptedView.of(accepted),
        gains_differ=None if accepted is None or in_effect is None else not same_gains(accepted.gains, in_effect),
        locked=None if lock is None else LockView.of(lock),
    )


def live_view(state: LoopState) -> LiveView:
    return LiveView(
        sp=state.sp,
        pv=_finite(state.pv),
        mv=_finite(state.mv),
        mode=state.mode.name.lower(),
        gains=GainsView.of(state.gains),
        on_trial=state.on_trial,
        mv_low=state.mv_low,
        mv_high=state.mv_high,
        sample_time_s=state.sample_time_s,
        reverse_acting=state.reverse_acting,
        node_state=state.node_state,
        fail_action=state.fail_action,
    )


def job_view(
    row: Job,
    events: Sequence[JobEvent],
    running: Running | None,
    latest: JobInBrief | None = None,
    request: DecisionRequest | None = None,
    elsewhere: JobProgress | None = None,
    has_record: bool = False,
    watch: AcceptanceWatch | None = None,
) -> JobView:
    """The view of a job from its row and events, and from the live progress while it runs.

    latest: the latest job of the loop, without dry runs.  request: the latest decision asked at another gateway.
    elsewhere: how far the job has come on the gateway that runs it, where that is another one and has said so.
    has_record: whether its samples are stored.  watch: of the loop since its gains were accepted.
    """
    state = row.state
    later = latest is not None and latest.id != row.id and state is JobState.PROPOSED
    method = str(row.request.get("method", FIVE_STAGE))
    kept = _record(state, events, has_record)
    result = row.result or empty_result(method)
    verification = _verification(result, events)
    progress, remaining, wall, plant_time = _progress(state, row, events, running, elsewhere)
    return JobView(
        id=row.id,
        url=f"/jobs/{row.id}",
        links=JobLinks.of(row, state, result.model is not None, kept == "kept"),
        loop=row.loop,
        state=state,
        dry_run=row.dry_run,
        gateway=row.host,
        attempts=row.attempt,
        request=row.request,
        by=row.by,
        created_at=row.created_at,
        started_at=row.started_at,
        ended_at=row.ended_at,
        stage=elsewhere.stage if elsewhere is not None and elsewhere.stage is not None else row.stage,
        progress=progress,
        remaining_plant_time_s=remaining,
        remaining_wall_time_s=wall,
        plant_time_s=plant_time,
        stages=_stages(events, row),
        method=method,
        design=result.design,
        ultimate=result.ultimate,
        model=result.model,
        previous_gains=GainsView.of(gains_of(row.previous_gains)) if row.previous_gains else result.previous_gains,
        new_gains=result.new_gains,
        comparison=result.comparison,
        rehearsed_on=result.rehearsed_on,
        predicted=result.predicted,
        predicted_previous=result.predicted_previous if isinstance(result, FastResult) else None,
        model_from=result.model_from if isinstance(result, FastResult) else None,
        evidence=_evidence(result, events),
        verification=verification,
        tested_on_loop=_tested(result, row),
        tested_b=_tested_b(result, verification),
        step_before=result.step_before if isinstance(result, FiveStageResult) else None,
        step_after=result.step_after,
        notes=[note for event in events if (note := event.note()) is not None] + result.notes,
        reason=row.reason,
        detail=row.detail,
        advice=ADVICE[row.reason] if row.reason else None,
        restored=row.restored,
        decided=_decided(events),
        decision_request=DecisionRequestView.of(request, row.state),
        superseded_by=f"/jobs/{latest.id}" if later and latest is not None else None,
        monitoring=None if watch is None else MonitoringView.of(watch, row.state),
        stopping=next((_stopping(event) for event in reversed(events) if event.kind == "abort_requested"), None),
        sample_time_s=None if row.found is None else number(row.found["sample_time_s"]),
        mode_found=None if row.found is None else str(row.found["mode"]),
        record=kept,
    )


def _progress(
    state: JobState, row: Job, events: Sequence[JobEvent], running: Running | None, elsewhere: JobProgress | None
) -> tuple[float, float | None, float | None, float]:
    """Fraction, remaining plant and wall time, and present plant time. For a job of a gateway that says nothing they
    are those at its last stage start."""
    if running is not None:
        live, pace = running.progress_now(), running.pace()
        left = live.remaining_s
        return live.fraction, left, None if left is None or pace is None else left / pace, live.plant_time_s
    if state not in ACTIVE:
        return 1.0, 0.0, 0.0, row.plant_time_s
    if elsewhere is not None:
        far = elsewhere
        return far.progress, far.remaining_plant_time_s, far.remaining_wall_time_s, far.plant_time_s
    begun = next((begun for event in reversed(events) if (begun := event.stage_begun())), None)
    if begun is None:
        return 0.0, None, None, row.plant_time_s
    remaining = begun.expected_s + begun.remaining_s
    total = row.plant_time_s + remaining
    return (min(0.99, row.plant_time_s / total) if total > 0 else 0.0), remaining, None, row.plant_time_s


def _stages(events: Sequence[JobEvent], row: Job) -> list[StageView]:
    over = row.ended_at is not None
    times = row.stage_times_s or {}
    stages: dict[str, StageView] = {}
    for event in events:
        if begun := event.stage_begun():
            stages[begun.stage] = StageView(
                stage=begun.stage,
                state="ended" if over else "running",
                result=None,
                plant_time_s=times.get(begun.stage),
            )
        elif (done := event.stage_ended()) and done.stage in stages:
            stages[done.stage].state, stages[done.stage].result = "done", done.result
    return list(stages.values())


def _evidence(result: FastResult | FiveStageResult, events: Sequence[JobEvent]) -> EvidenceView | None:
    """The evidence of the result; for a refused job, whose result has none, that of its latest design stage."""
    if isinstance(result, FastResult) and result.evidence is not None:
        return result.evidence
    found = _stage_result(events, ("redesign", "design"), "reason")
    return None if found is None else EvidenceView.model_validate(found)


def _verification(result: FastResult | FiveStageResult, events: Sequence[JobEvent]) -> VerificationView | None:
    if isinstance(result, FastResult) and result.verification is not None:
        return result.verification
    found = _stage_result(events, ("verify",), "tested")
    return None if found is None else VerificationView.of_stage(found)


def _tested(result: FastResult | FiveStageResult, row: Job) -> bool | None:
    if result.new_gains is None or row.dry_run:
        return None
    return result.step_after is not None or (isinstance(result, FastResult) and result.verification is not None)


def _tested_b(result: FastResult | FiveStageResult, verification: VerificationView | None) -> float | None:
    if verification is None or result.new_gains is None or verification.b == result.new_gains.b:
        return None
    return verification.b


def _stage_result(events: Sequence[JobEvent], stages: Sequence[str], field: str) -> JsonObject | None:
    """The last result of the first of these stages that has one. Only results with the field `field` count."""
    for stage in stages:
        for event in reversed(events):
            done = event.stage_ended()
            if done and done.stage == stage and done.result and field in done.result:
                return done.result
    return None


def _decided(events: Sequence[JobEvent]) -> DecidedView | None:
    for event in reversed(events):
        state = event.data.get("state") if event.kind == "state" else None
        if state in (JobState.ACCEPTED, JobState.ROLLED_BACK):
            what: Literal["accept", "rollback"] = "accept" if state == JobState.ACCEPTED else "rollback"
            return DecidedView(what=what, by=str(event.data.get("by", "")), at=event.at)
    return None


def _record(state: JobState, events: Sequence[JobEvent], has_record: bool) -> Literal["kept", "deleted", "none"]:
    if has_record and state not in ACTIVE:
        return "kept"
    return "deleted" if any(event.kind == "samples_deleted" for event in events) else "none"


def _stopping(event: JobEvent) -> StoppingView:
    return StoppingView(by=str(event.data.get("by", "")), at=event.at)


def _finite(value: float) -> float | None:
    return value if value == value and abs(value) != float("inf") else None
