"""The route of the report of a job: one HTML file for printing and filing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse

from loopwright.service.api import problems
from loopwright.service.api.computed import computed
from loopwright.service.api.job_figures import figures_of
from loopwright.service.api.job_views import JobView
from loopwright.service.api.report.paper import POLICY, ReportSource, paper
from loopwright.service.api.routes import JobId, new_router
from loopwright.service.errors import UnknownLoop
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.job_figures import JobFigures
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.manager import Jobs
from loopwright.service.store.clock import now
from loopwright.service.store.jobs import Job
from loopwright.tuning.reasons import Failed

_HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def router(jobs: Jobs, figures: KeptFigures, pool: Pool, view: Callable[[Job], JobView]) -> APIRouter:
    """A router with GET /jobs/{job_id}/report.

    pool: writes the reports.
    view: the view of a job, as GET /jobs/{job_id} has it.
    """
    routes = new_router("jobs")

    @routes.get(
        "/jobs/{job_id}/report",
        summary="The report of a job that is over: one HTML file without scripts, to be printed or filed",
        response_class=HTMLResponse,
        responses={
            200: {"content": {"text/html": {}}, "description": "The report, which needs no other file"},
            **problems.responses(404, 409, 422, 503),
        },
    )
    async def get_job_report(job_id: JobId, http: Request) -> HTMLResponse:
        not_computed = None
        try:
            row, found = await figures_of(jobs, figures, job_id)
        except Failed as failed:  # all else is shown
            row, found = await run_in_threadpool(jobs.store.get, job_id), JobFigures(None, None)
            not_computed = failed.detail
        source = await run_in_threadpool(source_of, row, found, not_computed)
        text = await computed(pool, partial(paper, source), http, lambda: jobs.stopping)
        name = f'inline; filename="loopwright-{row.loop}-{row.id}.html"'
        return HTMLResponse(text, headers=_HEADERS | {"Content-Disposition": name})

    def source_of(row: Job, found: JobFigures, not_computed: str | None) -> ReportSource:
        """All that the report shows, with everything that it needs from the store."""
        loop: LoopConfig | None = None
        try:
            loop, _ = jobs.directory.owner(row.loop)
        except UnknownLoop:  # it is no longer configured
            loop = None
        blocks = list(jobs.store.blocks(row.id))
        events = jobs.store.events(row.id)
        return ReportSource(
            job=view(row),
            loop=loop,
            events=events,
            record=found.record,
            designs=found.designs,
            blocks=blocks,
            version=version("loopwright"),
            made_at=now(),
            not_computed=not_computed,
        )

    return routes
