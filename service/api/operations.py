"""Routes for operations: liveness, readiness, metrics, audit trail, and the documentation."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from typing import Annotated

from fastapi import FastAPI, Query, Response
from fastapi.responses import HTMLResponse, JSONResponse
from pydantic import BaseModel, Field

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.api import metrics, problems
from loopwright.service.api.docs_page import POLICY, page
from loopwright.service.api.openapi_document import as_document
from loopwright.service.api.paging import LINK, Cursor, Limit, more
from loopwright.service.api.routes import add, new_router
from loopwright.service.jobs.aftercare import UnconfirmedRestoration
from loopwright.service.jobs.manager import Jobs
from loopwright.service.loops.bus_watch import BusWatch
from loopwright.service.store import audit
from loopwright.service.store.tables import AuditRow

Check = Callable[[], str | None]
"""Returns a note, or None, when the part is ready; raises an exception with the reason when it is not."""
CHECK_S = 2.0
BEHIND_S = 1.0
FRESH_S = 2.0
"""Age up to which an answer is reused, so that frequent requests do not open the buses as often."""


class Alive(BaseModel):
    status: str = Field(description="alive", examples=["alive"])


class ReadinessPart(BaseModel):
    """A part that the service needs."""

    ready: bool
    detail: str | None = Field(
        description="Why the part is not ready; a note if it is ready",
        examples=["CAN interface 'can0' cannot be opened"],
    )


class Ready(BaseModel):
    """The readiness of the service."""

    ready: bool = Field(description="True when every part is ready")
    parts: dict[str, ReadinessPart] = Field(
        description="The parts: database, engine, samples (with the retention), each bus by its address, and each loop "
        "whose restoration is not confirmed"
    )


class AuditView(BaseModel):
    """A change in the audit trail."""

    number: int = Field(description="Sequence number; the latest change has the largest one", examples=[17])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    key: str = Field(
        description="Name of the key; `local`: a request without a key from this machine; `cli:USER`: a command on "
        "this machine; `service`: the service itself",
        examples=["control room"],
    )
    key_id: str | None = Field(description="Id of the key", examples=["0f3ac2d9be11"])
    address: str | None = Field(description="Network address of the caller", examples=["10.0.0.7"])
    gateway: str | None = Field(
        description="Name of the gateway at which it was asked; null: no other shares the database, or the service "
        "itself did it",
        examples=["gw-1"],
    )
    by: str | None = Field(description="Name of the person, as given in the request", examples=["night shift"])
    what: str = Field(
        description="retune, abort, accept, rollback, accept_failed, rollback_failed, batch, batch_abort, "
        "acknowledge, acknowledge_alarm, lock, unlock, samples_delete, clock_jump, restore, key_create, key_revoke, "
        "sign_in, sign_out, sign_in_refused",
        examples=["accept"],
    )
    subject: str = Field(
        description="Id of the job, the key, the alarm or the batch, or the tag of the loop",
        examples=["4f0c2a9be113"],
    )
    loop: str | None = Field(examples=["TIC-101"])
    before: Mapping[str, object] | None = Field(description="State and gains before the change; null: there were none")
    after: Mapping[str, object] | None = Field(description="State and gains after the change; for a retune the request")


class Readiness:
    """Checks every part, each within CHECK_S seconds. more: returns the parts that may change between requests."""

    def __init__(self, checks: Mapping[str, Check], more: Callable[[], Mapping[str, Check]] = dict) -> None:
        self._checks = checks
        self._more = more
        self._asking = asyncio.Lock()
        self._last: tuple[float, Ready] | None = None

    async def ask(self) -> Ready:
        async with self._asking:
            if self._last is None or time.monotonic() - self._last[0] > FRESH_S:
                checks = dict(self._checks)
                with suppress(Exception):  # the check of the database reports the error
                    checks |= await asyncio.wait_for(asyncio.to_thread(self._more), CHECK_S)
                views = await asyncio.gather(*(self._one(check) for check in checks.values()))
                parts = dict(zip(checks, views, strict=True))
                self._last = time.monotonic(), Ready(ready=all(part.ready for part in views), parts=parts)
            return self._last[1]

    @staticmethod
    async def _one(check: Check) -> ReadinessPart:
        try:
            note = await asyncio.wait_for(asyncio.to_thread(check), CHECK_S)
        except TimeoutError:
            return ReadinessPart(ready=False, detail=f"no answer within {CHECK_S:g} s")
        except Exception as error:  # any exception means that the part is not ready
            return ReadinessPart(ready=False, detail=str(error) or type(error).__name__)
        return ReadinessPart(ready=True, detail=note)


def checks(jobs: Jobs) -> dict[str, Check]:
    """The checks of the database, the engine, and each bus of the configured loops."""

    def database() -> None:
        jobs.store.ping()
        if jobs.journal.behind_s > BEHIND_S:
            raise RuntimeError(
                f"the database takes nothing for {jobs.journal.behind_s:.0f} s; reports of jobs wait in memory"
            )

    def engine() -> None:
        if jobs.stopping:
            raise RuntimeError(jobs.why_stopping)
        if not jobs.engine.alive():
            raise RuntimeError("the engine does not run: the log says why; restart the service")

    urls = sorted({loop.bus for loop in jobs.directory.loops.values()})
    return {"database": database, "engine": engine, **{f"bus {url}": BusWatch(url).check for url in urls}}


def loops_monitored(jobs: Jobs) -> dict[str, Check]:
    """A failing check for each loop of this host whose restoration is not confirmed, with the reason."""

    def part(found: UnconfirmedRestoration) -> Check:
        def check() -> None:
            raise RuntimeError(found.words)

        return check

    return {f"loop {found.loop}": part(found) for found in jobs.aftercare.unconfirmed()}


def install(
    app: FastAPI, jobs: Jobs, parts: Mapping[str, Check], sdo_retries: Mapping[str, int], alarms: AlarmWatch
) -> None:
    """Adds the routes. parts: the checks of /readyz.  sdo_retries: SDO retries by bus."""
    router = new_router("operations")
    readiness = Readiness(parts, lambda: loops_monitored(jobs))
    counted = metrics.registry(jobs.directory.loops, jobs.store, sdo_retries, alarms.counts)

    @router.get("/healthz", summary="Whether the process is alive")
    async def get_health() -> Alive:
        return Alive(status="alive")

    @router.get(
        "/readyz",
        summary="Whether the service is ready: database, engine, each bus, and the restoration of each loop",
        response_model=Ready,
        responses={503: {"model": Ready, "description": "At least one part is not ready"}},
    )
    async def get_readiness() -> JSONResponse:
        found = await readiness.ask()
        return JSONResponse(found.model_dump(), status_code=200 if found.ready else 503)

    @router.get(
        "/metrics",
        summary="Metrics for Prometheus",
        response_class=Response,
        responses={200: {"content": {"text/plain": {}}, "description": "Metrics in the text format of Prometheus"}},
    )
    def get_metrics() -> Response:
        return Response(metrics.exposition(counted), media_type=metrics.MEDIA_TYPE)

    @router.get("/audit", summary="The audit trail, latest change first", responses={**LINK, **problems.responses(422)})
    def list_changes(
        response: Response,
        limit: Limit = 100,
        cursor: Cursor = None,
        what: Annotated[str | None, Query(description="Only this kind of change", examples=["accept"])] = None,
        loop: Annotated[str | None, Query(description="Only changes of this loop", examples=["TIC-101"])] = None,
    ) -> list[AuditView]:
        rows = audit.trail(jobs.store.engine, limit + 1, cursor, None if what is None else [what], loop)
        if len(rows) > limit:
            more(response, "/audit", rows[limit - 1].number, what=what, loop=loop, limit=limit)
        return [_view(row) for row in rows[:limit]]

    add(app, router)

    # Encoded once: clients need no key for them, and each encoding holds the interpreter lock for milliseconds.
    made_once = cache(lambda: (json.dumps(app.openapi()).encode(), page(as_document(app.openapi())).encode()))

    @app.get("/openapi.json", include_in_schema=False)
    def document() -> Response:
        return Response(made_once()[0], media_type="application/json")

    @app.get("/docs", include_in_schema=False)
    def docs() -> HTMLResponse:
        return HTMLResponse(made_once()[1], headers={"Content-Security-Policy": POLICY})


def _view(row: AuditRow) -> AuditView:
    return AuditView(**{name: getattr(row, name) for name in AuditView.model_fields})
