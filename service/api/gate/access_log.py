"""ASGI middleware that logs and counts each request. It is the outermost one, so it sees what the gate refuses too."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Callable, Iterable

from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from loopwright.service.telemetry.logs import about
from loopwright.service.telemetry.metrics import IN_FLIGHT, REQUEST_SECONDS, REQUESTS

log = logging.getLogger(__name__)

_NO_ROUTE = "none"
_REFUSED = frozenset({400, 401, 408, 429, 503})
"""Status codes that a client can provoke as often as it likes, by too many or by incomplete requests."""
_REFUSED_EVERY_S = 1.0
_REMEMBERED = 1000
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


def count_failures_of(routes: Iterable[BaseRoute]) -> None:
    """Counts the answers 500 of these routes from 0 on: in a counter that begins with the first one Prometheus sees no
    increase, and the alert RequestsFail would say nothing of it."""
    for method in _METHODS:
        REQUESTS.labels(method, _NO_ROUTE, "500")
    for route in routes:
        if isinstance(route, Route):
            for method in route.methods or ():
                REQUESTS.labels(method, route.path, "500")


class Access:
    """Wraps the application. No cache keeps an answer that does not say otherwise. The query is not logged, because
    it may hold secrets. Refusals that a client can provoke without end are logged at most once a second for each
    address."""

    def __init__(self, app: ASGIApp, wall: Callable[[], float] = time.monotonic) -> None:
        self._app, self._wall = app, wall
        self._refused: dict[tuple[int, str | None], float] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status = 500
        request = f"{random.getrandbits(32):08x}"  # the id is no secret; os.urandom would cost a system call

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = list(message.get("headers", ()))
                if not any(name.lower() == b"cache-control" for name, _ in headers):
                    headers.append((b"cache-control", b"no-store"))
                message["headers"] = [
                    *headers,
                    (b"x-request-id", request.encode()),
                    (b"x-content-type-options", b"nosniff"),
                ]
            await send(message)

        started = time.perf_counter()
        try:
            with about(request=request), IN_FLIGHT.track_inprogress():
                await self._app(scope, receive, sending)
        finally:
            self._log(scope, status, time.perf_counter() - started, request)

    def _logged_just_now(self, status: int, address: str | None) -> bool:
        """Whether the same refusal was logged less than a second ago. The metrics count every refusal all the same."""
        if status not in _REFUSED:
            return False
        now = self._wall()
        if now - self._refused.get((status, address), -_REFUSED_EVERY_S) < _REFUSED_EVERY_S:
            return True
        if len(self._refused) >= _REMEMBERED:
            self._refused.clear()
        self._refused[status, address] = now
        return False

    def _log(self, scope: Scope, status: int, seconds: float, request: str) -> None:
        method = scope["method"] if scope["method"] in _METHODS else "other"
        # The template, not the path: a label must not have as many values as there are jobs.
        route = str(getattr(scope.get("route"), "path", _NO_ROUTE))
        REQUESTS.labels(method, route, str(status)).inc()
        if not route.endswith(("/events", "/live")):
            REQUEST_SECONDS.labels(route).observe(seconds)
        client = scope.get("client")
        address = client[0] if client else None
        if self._logged_just_now(status, address):
            return
        found = scope.get("path_params") or {}
        level = logging.DEBUG if method in ("GET", "HEAD") and status < 400 else logging.INFO
        log.log(
            level if status < 500 else logging.WARNING,
            "request",
            extra={
                "request": request,
                "method": method,
                "path": scope["path"],
                "status": status,
                "ms": round(seconds * 1e3, 1),
                "key": scope.get("principal"),
                "address": address,
                "job": found.get("job_id"),
                "loop": found.get("tag"),
            },
        )
