"""Routes for one job: its state, events and samples, its abort and the decision about its proposal."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Body, Header, Query, Response
from fastapi.responses import StreamingResponse

from loopwright.service.api import problems
from loopwright.service.api.aborts import BODY, SaidBy
from loopwright.service.api.event_views import STREAMED_EVENT, StoredEventView, event_view
from loopwright.service.api.events import event_stream, still_permitted
from loopwright.service.api.job_views import AcceptDecision, Decision, JobView, SamplesView, signed_by
from loopwright.service.api.paging import LARGEST, LINK, Cursor, Limit, more
from loopwright.service.api.routes import JobId, new_router
from loopwright.service.api.samples import Reading, csv_text, json_text, parts
from loopwright.service.api.services import Services
from loopwright.service.api.shown_jobs import ShownJobs
from loopwright.service.api.web.compressed import takes_gzip
from loopwright.service.security.principal import current
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store.jobs import Job

_NOT_YET: problems.Responses = {
    202: {
        "model": JobView,
        "description": "The gateway that has the loop has not answered yet; `decision_request` of the job says what "
        "becomes of it",
    }
}


def router(services: Services, shown: ShownJobs) -> APIRouter:
    """A router with /jobs/{job_id} and what is asked of that job."""
    jobs, policy = services.jobs, services.policy
    routes = new_router("jobs")

    @routes.get("/jobs/{job_id}", summary="A job", responses=problems.responses(404))
    def get_job(job_id: JobId) -> JobView:
        return shown.one(jobs.store.get(job_id))

    @routes.get(
        "/jobs/{job_id}/events",
        summary="The events of a job, as server-sent events",
        response_class=StreamingResponse,
        responses={
            200: {
                "content": {"text/event-stream": {"schema": STREAMED_EVENT}},
                "description": "Events. The data of each is a JobEventView; its kind is the event's name too",
            },
            204: {"description": "The job is over and the client has received every event; it should not reconnect"},
            **problems.responses(404, 422),
        },
    )
    def stream_job_events(
        job_id: JobId,
        last_event_id: Annotated[
            int,
            Header(
                ge=0,
                le=LARGEST,
                description="Number of the last event received; only later events are sent",
                examples=[7],
            ),
        ] = 0,
    ) -> Response:
        row = jobs.store.get(job_id)
        over = row.state not in ACTIVE
        if over and last_event_id and not jobs.store.events(job_id, last_event_id, limit=1):
            return Response(status_code=204)
        permitted = still_permitted(policy.keyring, policy.sessions, current.get())
        stream = event_stream(jobs, job_id, last_event_id, permitted, shown.progress_elsewhere, services.streams_over)
        return StreamingResponse(stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    @routes.get(
        "/jobs/{job_id}/log",
        summary="The stored events of a job, the first one first",
        responses={**LINK, **problems.responses(404, 422)},
    )
    def list_job_events(
        job_id: JobId, response: Response, limit: Limit = 200, cursor: Cursor = None
    ) -> list[StoredEventView]:
        jobs.store.get(job_id)
        found = jobs.store.events(job_id, cursor or 0, limit + 1)
        if len(found) > limit:
            more(response, f"/jobs/{job_id}/log", found[limit - 1].seq, limit=limit)
        return [event_view(each) for each in found[:limit]]

    @routes.get(
        "/jobs/{job_id}/samples",
        summary="The samples of a job",
        response_model=SamplesView,
        description="The answer is streamed, and compressed with gzip if the client accepts it, because a job of "
        "days has millions of samples.",
        responses={
            200: {"content": {"text/csv": {"example": "stage,t_s,sp,pv,mv,mode\nrelay,12.3,50,50.2,45,3\n"}}},
            304: {"description": "No samples have come since the answer with this ETag"},
            **problems.responses(404, 422),
        },
    )
    def get_samples(
        job_id: JobId,
        stage: Annotated[str | None, Query(description="Only samples of this stage", examples=["baseline"])] = None,
        format: Annotated[
            Literal["json", "csv"], Query(description="json: one list per column; csv: one row per sample")
        ] = "json",
        accept_encoding: Annotated[str, Header(include_in_schema=False)] = "",
        if_none_match: Annotated[
            str, Header(description="The ETag of an earlier answer; 304 where no samples have come since")
        ] = "",
    ) -> Response:
        jobs.store.get(job_id)
        of = Reading(jobs.store, job_id, stage)
        if of.etag in (each.strip() for each in if_none_match.split(",")):
            return Response(status_code=304, headers={"ETag": of.etag})
        as_csv = format == "csv"
        text, media_type = (csv_text(of.blocks()), "text/csv") if as_csv else (json_text(of), "application/json")
        compress = takes_gzip(accept_encoding)
        headers = {"ETag": of.etag, "Vary": "Accept-Encoding"} | ({"Content-Encoding": "gzip"} if compress else {})
        return StreamingResponse(parts(text, compress), media_type=media_type, headers=headers)

    @routes.post(
        "/jobs/{job_id}/abort",
        summary="Stop a job; its loop is restored",
        status_code=202,
        responses=problems.responses(404, 409, 422),
        openapi_extra=BODY,
    )
    def abort_job(job_id: JobId, by: SaidBy) -> JobView:
        return shown.one(jobs.abort(job_id, by))

    def decided(row: Job, wanted: JobState, response: Response) -> JobView:
        """The view of a job after a decision, which another gateway may not have carried out yet."""
        if row.state is not wanted:
            response.status_code = 202
            response.headers["Location"] = f"/jobs/{row.id}"
        return shown.one(row)

    @routes.post(
        "/jobs/{job_id}/accept",
        summary="Write the proposed gains to the controller permanently",
        responses={**_NOT_YET, **problems.responses(404, 409, 422, 503)},
    )
    def accept_job(
        job_id: JobId, response: Response, decision: Annotated[AcceptDecision | None, Body()] = None
    ) -> JobView:
        given = decision or AcceptDecision()
        row = jobs.decisions.accept(job_id, signed_by(given), given.auto_rollback)
        return decided(row, JobState.ACCEPTED, response)

    @routes.post(
        "/jobs/{job_id}/rollback",
        summary="Decline the proposal, or write the previous gains back after it was accepted",
        responses={**_NOT_YET, **problems.responses(404, 409, 422, 503)},
    )
    def roll_back_job(
        job_id: JobId, response: Response, decision: Annotated[Decision | None, Body()] = None
    ) -> JobView:
        row = jobs.decisions.rollback(job_id, signed_by(decision))
        return decided(row, JobState.ROLLED_BACK, response)

    return routes
