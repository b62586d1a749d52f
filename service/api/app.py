"""The FastAPI application: who may come in, and the routes of each subject."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from importlib.metadata import version

from fastapi import FastAPI
from fastapi.responses import RedirectResponse

from loopwright.service.api import (
    alarms,
    decisions,
    fleet,
    gateways,
    history,
    job_figures,
    jobs,
    live,
    locks,
    loops,
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
from loopwright.service.api.aborts import stopping
from loopwright.service.api.bodies import JsonRoute
from loopwright.service.api.gate.access_log import Access, count_failures_of
from loopwright.service.api.gate.gate import Gate
from loopwright.service.api.gate.key_checks import KeyChecks
from loopwright.service.api.heads import Head
from loopwright.service.api.idempotency import Idempotent
from loopwright.service.api.routes import add, name_of
from loopwright.service.api.services import Services
from loopwright.service.api.shown_jobs import ShownJobs
from loopwright.service.api.web.pages import Pages
from loopwright.service.jobs.fleet import Fleet
from loopwright.service.loops.shared_reading import SharedReading
from loopwright.service.store.idempotency import IdempotencyKeys
from loopwright.service.telemetry.lateness import watched_event_loop


def create_app(services: Services) -> FastAPI:
    """The application, which stops its jobs when the server shuts down."""
    many = Fleet(services.jobs)
    policy = services.policy
    checks = None if policy.keyring is None else KeyChecks(policy.keyring, policy.limits)
    app = _without_routes(services, many)
    _add_gates(app, services, checks)
    problems.install(app)
    openapi.install(app)
    _add_routes(app, services, many, checks)
    app.mount("/ui", Pages(), name="page")
    for path in ("/", "/ui"):
        app.add_route(path, lambda _: RedirectResponse("/ui/"), include_in_schema=False)
    count_failures_of(app.routes)
    return app


def _without_routes(services: Services, many: Fleet) -> FastAPI:
    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        many.boot()
        async with watched_event_loop():
            yield
        many.close()
        services.jobs.stop()

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
    return app


def _add_gates(app: FastAPI, services: Services, checks: KeyChecks | None) -> None:
    """Adds what each request passes before its route; the last one added is the first that it comes to."""
    store = services.jobs.store
    gateway = store.host if store.shared else None
    app.add_middleware(Idempotent, keys=IdempotencyKeys(store))
    stops = partial(stopping, services.jobs)
    app.add_middleware(Gate, policy=services.policy, checks=checks, stopping=stops, gateway=gateway)
    app.add_middleware(Head)
    app.add_middleware(Access)


def _add_routes(app: FastAPI, services: Services, many: Fleet, checks: KeyChecks | None) -> None:
    """Adds the routes of each subject, in the order in which the document has them."""
    of_jobs, policy, pool = services.jobs, services.policy, services.pool
    directory, listening, others = of_jobs.directory, services.listening, services.others
    readings = SharedReading(directory.live)
    shown = ShownJobs(of_jobs, others)
    operations.install(app, of_jobs, services.checks, services.sdo_retries, services.alarms)
    alarms.install(app, services.alarms)
    webhooks.install(app, of_jobs.store)
    fleet.install(app, of_jobs, many, shown.all, listening, others)
    for routes in (
        loops.router(services, readings, shown),
        jobs.router(services, shown),
        sessions.router(of_jobs.store, checks, policy.sessions),
        decisions.router(of_jobs),
        locks.router(of_jobs.locking),
        history.router(directory, listening),
        sparklines.router(directory, listening),
        observation.router(of_jobs, readings, listening, pool),
        gateways.router(directory, services.own, others),
        live.router(services.live, directory, policy.keyring, policy.sessions),
        previews.router(of_jobs, many, pool),
        tunings.router(of_jobs, pool),
        job_figures.router(of_jobs, services.figures),
        reports.router(of_jobs, services.figures, pool, shown.one),
    ):
        add(app, routes)
