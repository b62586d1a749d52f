"""Routes for one loop: its present state, the acknowledgement of how it was left, and its retune."""

from __future__ import annotations

import time
from typing import Annotated

from fastapi import APIRouter, Body, Request, Response

from loopwright.service.api import gateways, problems
from loopwright.service.api.bodies import signed_test
from loopwright.service.api.job_views import (
    AcknowledgedView,
    Decision,
    JobView,
    LiveErrorView,
    LiveView,
    LoopDetail,
    RestoreUnconfirmedView,
    live_view,
    loop_view,
    signed_by,
)
from loopwright.service.api.routes import Tag, new_router
from loopwright.service.api.services import Services
from loopwright.service.api.shown_jobs import ShownJobs
from loopwright.service.api.watch_views import MonitoringView
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.loops.shared_reading import SharedReading
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store import watches
from loopwright.service.store.live_jobs import acceptances, latest_jobs
from loopwright.tuning.reasons import Ended


def router(services: Services, readings: SharedReading[LoopState | None], shown: ShownJobs) -> APIRouter:
    """A router with /loops/{tag} and what is asked of that loop. readings: of the loops of this gateway."""
    jobs, others, own = services.jobs, services.others, services.own
    routes = new_router("loops")

    def here(tag: str) -> tuple[LiveView | None, LiveErrorView | None]:
        try:
            state = readings.of(tag)
        except Ended as ended:
            return None, LiveErrorView.of(ended)
        return (live_view(state) if state else None), None

    def there(config: LoopConfig, host: str) -> tuple[LiveView | None, LiveErrorView | None]:
        others.look()
        return gateways.live_there(config, host, others)

    @routes.get("/loops/{tag}", summary="A loop and its present state", responses=problems.responses(404, 503))
    def get_loop(tag: Tag) -> LoopDetail:
        config, host = jobs.directory.owner(tag)
        unconfirmed = next(iter(jobs.aftercare.unconfirmed(tag)), None)
        elsewhere = host != jobs.store.host
        present, away = there(config, host) if elsewhere else here(tag)
        last = others.values(tag, host) if elsewhere else own.values(tag, time.time())
        gains = None if present is None else present.gains.gains()
        accepted = acceptances(jobs.store, tag).get(tag)
        watched = None if accepted is None else watches.of_jobs(jobs.store, [accepted.job_id]).get(accepted.job_id)
        listed = loop_view(
            config,
            host,
            jobs.store.busy().get(tag),
            latest_jobs(jobs.store, tag).get(tag),
            accepted,
            None if present is None or present.on_trial else gains,
            jobs.locking.locks().get(tag),
        )
        return LoopDetail(
            **dict(listed),
            live=present,
            live_error=away,
            last_data=None if present is not None else gateways.last_data(last),
            restore_unconfirmed=RestoreUnconfirmedView.of(unconfirmed) if unconfirmed else None,
            not_acknowledged=jobs.aftercare.not_acknowledged(tag),
            disturbed_by=jobs.directory.disturbed_by(tag),
            knowledge=jobs.knowledge.of(tag, gains),
            monitoring=None if watched is None else MonitoringView.of(watched, JobState.ACCEPTED),
        )

    @routes.post(
        "/loops/{tag}/acknowledge",
        summary="Take responsibility for a loop whose restoration is not confirmed, or whose PV was found to be false",
        responses=problems.responses(404, 409, 422),
    )
    def acknowledge_loop(tag: Tag, decision: Annotated[Decision | None, Body()] = None) -> AcknowledgedView:
        found = jobs.aftercare.acknowledge(tag, signed_by(decision))
        return AcknowledgedView(loop=tag, jobs=[f"/jobs/{job_id}" for job_id in found])

    @routes.post(
        "/loops/{tag}/retune",
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
        return shown.one(row)

    return routes
