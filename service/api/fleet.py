"""Routes for the list of loops, the lists of jobs, and batches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal

from fastapi import Body, FastAPI, Path, Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.aborts import BODY, SaidBy
from loopwright.service.api.bodies import signed_test
from loopwright.service.api.job_views import JobView, LoopView, loop_view
from loopwright.service.api.paging import LINK, Cursor, JobLimit, Limit, listed, more
from loopwright.service.api.routes import Tag, add, new_router
from loopwright.service.jobs.fleet import BadFleet, Fleet, FleetRequest
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.states.job_state import JobState
from loopwright.service.store.batches import BatchOver, BatchState, NoSuchBatch, Part, StopReason
from loopwright.service.store.jobs import Job
from loopwright.service.store.live_jobs import acceptances, latest_jobs
from loopwright.service.store.tables import BatchRow
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Reason

BatchId = Annotated[str, Path(description="Id of the batch", examples=["9d1b7c02aa45"])]
LoopFilter = Literal["busy", "idle"] | JobState


class RetuneLoopView(BaseModel):
    """A loop in a batch."""

    loop: str = Field(examples=["TIC-101"])
    state: str = Field(
        description="waiting, skipped (the loop was never begun, or not again after a stop of the service), or the "
        "state of its job",
        examples=["proposed"],
    )
    job: str | None = Field(description="URL of the loop's job; null: there is no job", examples=["/jobs/4f0c2a9be113"])
    reason: Reason | None = Field(
        description="Why there is no proposal; reason code from the closed list", examples=["not_at_rest"]
    )
    detail: str | None = Field(description="The numbers behind the reason, or why there is no job")


class BatchSummary(BaseModel):
    """A batch."""

    id: str = Field(examples=["9d1b7c02aa45"])
    url: str = Field(examples=["/batches/9d1b7c02aa45"])
    state: BatchState = Field(
        description="running; stopping: no more loops are begun, some jobs still run; done: every loop was begun or "
        "skipped; stopped: by failures or with the service; aborted: by an operator",
        examples=["running"],
    )
    gateway: str = Field(description="Name of the gateway that runs the batch", examples=["local"])
    by: str = Field(examples=["night shift"])
    created_at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    ended_at: str | None = Field(description="UTC, ISO 8601, wall time")
    request: Mapping[str, object] = Field(description="The options of the request")
    counts: dict[str, int] = Field(description="Number of loops by state", examples=[{"waiting": 12, "running": 4}])
    failures: int = Field(
        description="Number of loops that ended without a proposal; aborted and no_gain are not counted", examples=[1]
    )
    stop_reason: StopReason | None = Field(description="Why no more loops are begun", examples=["failures"])
    detail: str | None = Field(description="The stop reason in words")


class BatchView(BatchSummary):
    loops: list[RetuneLoopView] = Field(description="In the order in which they are begun")


def install(
    app: FastAPI,
    jobs: Jobs,
    fleet: Fleet,
    views: Callable[[Sequence[Job]], list[JobView]],
    listening: Listening,
    others: OtherGateways,
) -> None:
    """Adds the routes.

    views: makes the API's view of each job.  listening, others: know the gains that were read last.
    """

    def gains_of(tag: str, host: str) -> Gains | None:
        if host == jobs.store.host:
            return listening.gains_of(tag)
        settings = None if others.values(tag, host).on_trial else others.settings(tag, host)
        return None if settings is None else settings.gains.gains()

    router = new_router()

    @router.get(
        "/loops",
        response_model=list[LoopView],
        tags=["loops"],
        summary="The configured loops of every gateway, sorted by tag",
        responses={**LINK, **problems.responses(422)},
    )
    def list_loops(
        response: Response,
        state: Annotated[
            LoopFilter | None,
            Query(description="Only busy loops (used by a job), idle loops, or loops whose latest job has this state"),
        ] = None,
        limit: Limit = 1000,
        cursor: Annotated[
            str | None, Query(max_length=64, description="Cursor from the URL of the next page, unchanged")
        ] = None,
    ) -> Response:
        busy, last, locks = jobs.store.busy(), latest_jobs(jobs.store), jobs.locking.locks()
        accepted = acceptances(jobs.store)
        others.look()
        found: list[LoopView] = []
        for config, host in sorted(jobs.directory.everywhere(), key=lambda one: one[0].tag):
            if cursor is not None and config.tag <= cursor:
                continue
            job = last.get(config.tag)
            if not _is(state, config.tag in busy, None if job is None else job.state):
                continue
            if len(found) == limit:
                more(response, "/loops", found[-1].tag, state=state, limit=limit)
                break
            of_it = busy.get(config.tag), job, accepted.get(config.tag), gains_of(config.tag, host)
            found.append(loop_view(config, host, *of_it, locks.get(config.tag)))
        return listed(response, found)

    @router.get(
        "/loops/{tag}/jobs",
        response_model=list[JobView],
        tags=["loops"],
        summary="The jobs of a loop, latest first",
        responses={**LINK, **problems.responses(404, 422)},
    )
    def list_jobs_of_loop(tag: Tag, response: Response, limit: JobLimit = 50, cursor: Cursor = None) -> Response:
        jobs.directory.owner(tag)
        rows = jobs.store.recent(tag, None, limit + 1, cursor)
        if len(rows) > limit:
            more(response, f"/loops/{tag}/jobs", rows[limit - 1].number, limit=limit)
        return listed(response, views(rows[:limit]))

    @router.get(
        "/jobs",
        response_model=list[JobView],
        tags=["jobs"],
        summary="The jobs of every loop, latest first",
        responses={**LINK, **problems.responses(422)},
    )
    def list_jobs(
        response: Response,
        loop: Annotated[str | None, Query(description="Only jobs of this loop", examples=["TIC-101"])] = None,
        state: Annotated[JobState | None, Query(description="Only jobs in this state")] = None,
        id_begins: Annotated[
            str | None,
            Query(alias="id", description="Only jobs whose id begins so", max_length=32, examples=["4f0c"]),
        ] = None,
        limit: JobLimit = 50,
        cursor: Cursor = None,
    ) -> Response:
        rows = jobs.store.recent(loop, state, limit + 1, cursor, id_begins)
        if len(rows) > limit:
            more(response, "/jobs", rows[limit - 1].number, loop=loop, state=state, id=id_begins, limit=limit)
        return listed(response, views(rows[:limit]))

    @router.post(
        "/batches",
        tags=["batches"],
        summary="Retune many loops",
        status_code=202,
        responses=problems.responses(422, 503),
    )
    def retune_loops(request: Request, response: Response, body: Annotated[FleetRequest, Body()]) -> BatchView:
        signed_test(body)
        row = fleet.start(body)
        response.headers["Location"] = str(request.url_for("get_batch", batch_id=row.id).path)
        return _view(*fleet.get(row.id))

    @router.get(
        "/batches",
        tags=["batches"],
        summary="The batches, latest first",
        responses={**LINK, **problems.responses(422)},
    )
    def list_batches(response: Response, limit: Limit = 20, cursor: Cursor = None) -> list[BatchSummary]:
        found = fleet.recent(limit + 1, cursor)
        if len(found) > limit:
            more(response, "/batches", found[limit - 1][0].number, limit=limit)
        return [_summary(row, parts) for row, parts in found[:limit]]

    @router.get(
        "/batches/{batch_id}",
        tags=["batches"],
        summary="A batch and its progress",
        responses=problems.responses(404),
    )
    def get_batch(batch_id: BatchId) -> BatchView:
        return _view(*fleet.get(batch_id))

    @router.post(
        "/batches/{batch_id}/abort",
        tags=["batches"],
        summary="Stop a batch: no more loops are begun, running jobs stop, and their loops are restored",
        status_code=202,
        responses=problems.responses(404, 409, 422),
        openapi_extra=BODY,
    )
    def abort_batch(batch_id: BatchId, by: SaidBy) -> BatchView:
        fleet.abort(batch_id, by)
        return _view(*fleet.get(batch_id))

    add(app, router)

    @app.exception_handler(BadFleet)
    async def _bad(_request: Request, error: BadFleet) -> JSONResponse:
        return problems.problem(422, str(error), reason=Reason.BAD_INPUT)

    @app.exception_handler(NoSuchBatch)
    async def _unknown(_request: Request, error: NoSuchBatch) -> JSONResponse:
        return problems.problem(404, str(error), reason=problems.ProblemReason.UNKNOWN_BATCH)

    @app.exception_handler(BatchOver)
    async def _over(_request: Request, error: BatchOver) -> JSONResponse:
        return problems.problem(409, str(error), reason=problems.ProblemReason.WRONG_STATE)


def _is(wanted: LoopFilter | None, busy: bool, last: str | None) -> bool:
    if wanted is None:
        return True
    if wanted in ("busy", "idle"):
        return busy == (wanted == "busy")
    return wanted == last


def _summary(row: BatchRow, parts: list[Part]) -> BatchSummary:
    may_begin = row.stop_reason is None
    return BatchSummary(
        id=row.id,
        url=f"/batches/{row.id}",
        state=BatchState(row.state),
        gateway=row.host,
        by=row.by,
        created_at=row.created_at,
        ended_at=row.ended_at,
        request=row.request,
        counts=dict(Counter(part.state(may_begin) for part in parts)),
        failures=sum(part.failed for part in parts),
        stop_reason=None if row.stop_reason is None else StopReason(row.stop_reason),
        detail=row.detail,
    )


def _view(row: BatchRow, parts: list[Part]) -> BatchView:
    may_begin = row.stop_reason is None
    loops = [
        RetuneLoopView(
            loop=part.loop,
            state=part.state(may_begin),
            job=None if part.job_id is None else f"/jobs/{part.job_id}",
            reason=None if part.reason is None else Reason(part.reason),
            detail=part.detail,
        )
        for part in parts
    ]
    return BatchView(**dict(_summary(row, parts)), loops=loops)
