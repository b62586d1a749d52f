"""The FastAPI application: routes that translate between HTTP and the jobs."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import partial
from importlib.metadata import version
from typing import Annotated, Literal

from fastapi import Body, FastAPI, Header, Path, Query, Request, Response
from fastapi.responses import RedirectResponse, StreamingResponse

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.api import alarms as alarms_api
from loopwright.service.api import (
    decisions,
    fleet,
    gateways,
    history,
    job_figures,
    locks,
    observation,
    openapi,
    operations,
    previews,
    problems,
    reports,
    sessions,
    sparklines,
    tunings,
    webhooks,
)
from loopwright.service.api import live as live_api
from loopwright.service.api.aborts import BODY, SaidBy, stopping
from loopwright.service.api.bodies import JsonRoute, signed_test
from loopwright.service.api.event_views import STREAMED_EVENT, StoredEventView, event_view
from loopwright.service.api.events import event_stream, still_permitted
from loopwright.service.api.gate.access_log import Access, count_failures_of
from loopwright.service.api.gate.gate import Gate, Policy
from loopwright.service.api.gate.key_checks import KeyChecks
from loopwright.service.api.heads import Head
from loopwright.service.api.idempotency import Idempotent
from loopwright.service.api.job_views import (
    AcceptDecision,
    AcknowledgedView,
    Decision,
    JobView,
    LiveErrorView,
    LiveView,
    LoopDetail,
    RestoreUnconfirmedView,
    SamplesView,
    job_view,
    live_view,
    loop_view,
    signed_by,
)
from loopwright.service.api.paging import LARGEST, LINK, Cursor, Limit, more
from loopwright.service.api.routes import add, name_of
from loopwright.service.api.samples import Reading, csv_text, json_text, parts
from loopwright.service.api.watch_views import MonitoringView
from loopwright.service.api.web.compressed import takes_gzip
from loopwright.service.api.web.pages import Pages
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.jobs.fleet import Fleet
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.live.live import Live
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import OwnGateway
from loopwright.service.live.snapshot import JobProgress
from loopwright.service.loops.shared_reading import SharedReading
from loopwright.service.security.principal import current
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store import decision_requests, watches
from loopwright.service.store.idempotency import IdempotencyKeys
from loopwright.service.store.job_figures import with_record
from loopwright.service.store.jobs import Job
from loopwright.service.store.live_jobs import acceptances, latest_jobs
from loopwright.service.telemetry.lateness import watched_event_loop
from loopwright.tuning.reasons import Ended

Tag = Annotated[str, Path(description="Tag of the loop", examples=["TIC-101"])]
MAX_EVENTS = 2000
"""Events read for the view of a job. Those of the stages come first; failed decisions may follow without end."""
JobId = Annotated[str, Path(description="Id of the job", examples=["4f0c2a9be113"])]


def create_app(
    jobs: Jobs,
    policy: Policy | None = None,
    checks: Mapping[str, operations.Check] | None = None,
    pool: Pool | None = None,
    sdo_retries: Mapping[str, int] | None = None,
    listening: Listening | None = None,
    live: Live | None = None,
    figures: KeptFigures | None = None,
    alarms: AlarmWatch | None = None,
    own: OwnGateway | None = None,
    others: OtherGateways | None = None,
    streams_over: Callable[[], bool] = lambda: False,
) -> FastAPI:
    """The application for these jobs, which it stops when the server shuts down.

    checks: the parts of /readyz by name; None for the default ones.  pool: processes that compute tunings; None for a
    new pool.  sdo_retries: SDO retries by bus, as counted in this process.  listening: None for one that knows only
    what is stored.  live: None for a stream of its own.  figures: None for those that this pool computes when asked.
    alarms: None for one that looks only when it is asked.
    own, others: this gateway, and those that share its database; None for one without a URL.
    streams_over: whether the streams of jobs are to end, although their jobs have not.
    """

    policy = policy or Policy()
    keyring = policy.keyring
    many = Fleet(jobs)
    readings = SharedReading(jobs.directory.live)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        many.boot()
        async with watched_event_loop():
            yield
        many.close()
        jobs.stop()

    app = FastAPI(
        title="Loopwright",
        version=version("loopwright"),
        description="Retunes PI and PID loops. Gains are in ISA form, MV is in percent, times are plant time in "
        "seconds unless they are called wall time. A retune ends with a proposal; the loop keeps its gains until the "
        "proposal is accepted.",
        lifespan=lifespan,
        openapi_url=None,  # FastAPI would encode the document for each request; operations.py does it once
        docs_url=None,  # the page would load scripts from a CDN
        redoc_url=None,
        redirect_slashes=False,  # FastAPI redirects to the host that it sees, which behind a proxy is another
        generate_unique_id_function=name_of,
    )
    app.router.route_class = JsonRoute
    app.add_middleware(Idempotent, keys=IdempotencyKeys(jobs.store))
    key_checks = None if keyring is None else KeyChecks(keyring, policy.limits)
    gateway = jobs.store.host if jobs.store.shared else None
    app.add_middleware(Gate, policy=policy, checks=key_checks, stopping=partial(stopping, jobs), gateway=gateway)
    app.add_middleware(Head)
    app.add_middleware(Access)
    problems.install(app)
    openapi.install(app)
    checks = operations.checks(jobs) if checks is None else checks
    listening = listening or Listening(jobs.directory.loops, jobs.store, on=False)
    others = others or OtherGateways(jobs.store)
    own = own or OwnGateway(jobs, listening)
    alarms = alarms or AlarmWatch(jobs, listening, others)
    operations.install(app, jobs, checks, {} if sdo_retries is None else sdo_retries, alarms)
    alarms_api.install(app, alarms)
    webhooks.install(app, jobs.store)

    def views(rows: Sequence[Job]) -> list[JobView]:
        events = jobs.store.events_by_job([row.id for row in rows], limit=MAX_EVENTS)
        loops = {row.loop for row in rows}
        latest = latest_jobs(jobs.store, loops.pop() if len(loops) == 1 else None)
        asked = decision_requests.latest(jobs.store, [row.id for row in rows])
        recorded = with_record(jobs.store, [row.id for row in rows])
        watched = watches.of_jobs(jobs.store, [row.id for row in rows])
        found = []
        for row in rows:
            of_it = jobs.running(row.id), latest.get(row.loop), asked.get(row.id), elsewhere(row), row.id in recorded
            found.append(job_view(row, events[row.id], *of_it, watched.get(row.id)))
        return found

    def elsewhere(row: Job) -> JobProgress | None:
        """How far a job of another gateway has come; None where it has not said so."""
        if row.host == jobs.store.host or row.state not in ACTIVE:
            return None
        others.look()
        return others.progress(row.id, row.host)

    def view(row: Job) -> JobView:
        return views([row])[0]

    fleet.install(app, jobs, many, views, listening, others)

    def here(tag: str) -> tuple[LiveView | None, LiveErrorView | None]:
        try:
            state = readings.of(tag)
        except Ended as ended:
            return None, LiveErrorView.of(ended)
        return (live_view(state) if state else None), None

    def there(config: LoopConfig, host: str) -> tuple[LiveView | None, LiveErrorView | None]:
        others.look()
        return gateways.live_there(config, host, others)

    @app.get(
        "/loops/{tag}", tags=["loops"], summary="A loop and its present state", responses=problems.responses(404, 503)
    )
    def get_loop(tag: Tag) -> LoopDetail:
        config, host = jobs.directory.owner(tag)
        unconfirmed = next(iter(jobs.aftercare.unconfirmed(tag)), None)
        elsewhere = host != jobs.store.host
        present, away = there(config, host) if elsewhere else here(tag)
        last = others.values(tag, host) if elsewhere else own.values(tag, time.time())
        gains = None if present is None else present.gains.gains()
        accepted = acceptances(jobs.store, tag).get(tag)
        watched = None if accepted is None else watches.of_jobs(jobs.store, [accepted.job_id]).get(accepted.job_id)
        shown = loop_view(
            config,
            host,
            jobs.store.busy().get(tag),
            latest_jobs(jobs.store, tag).get(tag),
            accepted,
            None if present is None or present.on_trial else gains,
            jobs.locking.locks().get(tag),
        )
        return LoopDetail(
            **dict(shown),
            live=present,
            live_error=away,
            last_data=None if present is not None else gateways.last_data(last),
            restore_unconfirmed=RestoreUnconfirmedView.of(unconfirmed) if unconfirmed else None,
            not_acknowledged=jobs.aftercare.not_acknowledged(tag),
            disturbed_by=jobs.directory.disturbed_by(tag),
            knowledge=jobs.knowledge.of(tag, gains),
            monitoring=None if watched is None else MonitoringView.of(watched, JobState.ACCEPTED),
        )

    @app.post(
        "/loops/{tag}/acknowledge",
        tags=["loops"],
        summary="Take responsibility for a loop whose restoration is not confirmed, or whose PV was found to be false",
        responses=problems.responses(404, 409, 422),
    )
    def acknowledge_loop(tag: Tag, decision: Annotated[Decision | None, Body()] = None) -> AcknowledgedView:
        found = jobs.aftercare.acknowledge(tag, signed_by(decision))
        return AcknowledgedView(loop=tag, jobs=[f"/jobs/{job_id}" for job_id in found])

    @app.post(
        "/loops/{tag}/retune",
        tags=["loops"],
        summary="Start a retune",
        status_code=202,
        responses=problems.responses(404, 409, 422, 503),
        openapi_extra={"requestBody": {"required": True}},
    )
    def retune_loop(
        tag: Tag, request: Request, response: Response, options: Annotated[RetuneRequest | None, Body()] = None
    ) -> JobView:
        row = jobs.start(tag, signed_test(options))
        response.headers["Location"] = str(request.url_for("get_job", job_id=row.id).path)
        return view(row)

    @app.get("/jobs/{job_id}", tags=["jobs"], summary="A job", responses=problems.responses(404))
    def get_job(job_id: JobId) -> JobView:
        return view(jobs.store.get(job_id))

    @app.get(
        "/jobs/{job_id}/events",
        tags=["jobs"],
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
        permitted = still_permitted(keyring, policy.sessions, current.get())
        stream = event_stream(jobs, job_id, last_event_id, permitted, elsewhere, streams_over)
        return StreamingResponse(stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    @app.get(
        "/jobs/{job_id}/log",
        tags=["jobs"],
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

    @app.get(
        "/jobs/{job_id}/samples",
        tags=["jobs"],
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

    @app.post(
        "/jobs/{job_id}/abort",
        tags=["jobs"],
        summary="Stop a job; its loop is restored",
        status_code=202,
        responses=problems.responses(404, 409, 422),
        openapi_extra=BODY,
    )
    def abort_job(job_id: JobId, by: SaidBy) -> JobView:
        return view(jobs.abort(job_id, by))

    not_yet: problems.Responses = {
        202: {
            "model": JobView,
            "description": "The gateway that has the loop has not answered yet; `decision_request` of the job says "
            "what becomes of it",
        }
    }

    def decided(row: Job, wanted: JobState, response: Response) -> JobView:
        """The view of a job after a decision, which another gateway may not have carried out yet."""
        if row.state is not wanted:
            response.status_code = 202
            response.headers["Location"] = f"/jobs/{row.id}"
        return view(row)

    @app.post(
        "/jobs/{job_id}/accept",
        tags=["jobs"],
        summary="Write the proposed gains to the controller permanently",
        responses={**not_yet, **problems.responses(404, 409, 422, 503)},
    )
    def accept_job(
        job_id: JobId, response: Response, decision: Annotated[AcceptDecision | None, Body()] = None
    ) -> JobView:
        given = decision or AcceptDecision()
        row = jobs.decisions.accept(job_id, signed_by(given), given.auto_rollback)
        return decided(row, JobState.ACCEPTED, response)

    @app.post(
        "/jobs/{job_id}/rollback",
        tags=["jobs"],
        summary="Decline the proposal, or write the previous gains back after it was accepted",
        responses={**not_yet, **problems.responses(404, 409, 422, 503)},
    )
    def roll_back_job(
        job_id: JobId, response: Response, decision: Annotated[Decision | None, Body()] = None
    ) -> JobView:
        row = jobs.decisions.rollback(job_id, signed_by(decision))
        return decided(row, JobState.ROLLED_BACK, response)

    app.mount("/ui", Pages(), name="page")
    for path in ("/", "/ui"):
        app.add_route(path, lambda _: RedirectResponse("/ui/"), include_in_schema=False)
    add(app, sessions.router(jobs.store, key_checks, policy.sessions))
    add(app, decisions.router(jobs))
    add(app, locks.router(jobs.locking))
    pool = pool or Pool()
    add(app, history.router(jobs.directory, listening))
    add(app, sparklines.router(jobs.directory, listening))
    add(app, observation.router(jobs, readings, listening, pool))
    live = live or Live(jobs, listening, alarms, others)
    add(app, gateways.router(jobs.directory, own, others))
    add(app, live_api.router(live, jobs.directory, keyring, policy.sessions))
    add(app, previews.router(jobs, many, pool))
    add(app, tunings.router(jobs, pool))
    figures = figures or KeptFigures(jobs.store, pool)
    add(app, job_figures.router(jobs, figures))
    add(app, reports.router(jobs, figures, pool, view))
    count_failures_of(app.routes)
    return app
