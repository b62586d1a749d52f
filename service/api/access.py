"""One line and one count for each request, as ASGI middleware. Outermost: it sees what the gate refuses, too."""

from __future__ import annotations

import logging
import secrets
import time

from service.logs import about
from service.metrics import IN_FLIGHT, REQUEST_SECONDS, REQUESTS
from service.security.gate import App, AsgiScope, Message, Receive, Send

log = logging.getLogger(__name__)

_NO_ROUTE = "none"
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class Access:
    """Wraps the application. The query is not logged: who knows what somebody puts there."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status = 500
        request = secrets.token_hex(4)

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [
                    *message.get("headers", ()),
                    (b"x-request-id", request.encode()),
                    (b"x-content-type-options", b"nosniff"),
                ]
            await send(message)

        started = time.perf_counter()
        try:
            with about(request=request), IN_FLIGHT.track_inprogress():
                await self._app(scope, receive, watched)
        finally:
            self._tell(scope, status, time.perf_counter() - started, request)

    @staticmethod
    def _tell(scope: AsgiScope, status: int, seconds: float, request: str) -> None:
        method = scope["method"] if scope["method"] in _METHODS else "other"
        # The template, not the path: a label must not have as many values as there are jobs.
        route = str(getattr(scope.get("route"), "path", _NO_ROUTE))
        REQUESTS.labels(method, route, str(status)).inc()
        if not route.endswith("/events"):
            REQUEST_SECONDS.labels(route).observe(seconds)
        found = scope.get("path_params") or {}
        level = logging.DEBUG if method in ("GET", "HEAD") and status < 400 else logging.INFO
        client = scope.get("client")
        log.log(
            level if status < 500 else logging.WARNING,
            "request",
            extra={
                "request": request,
                "method": method,
                "path": scope["path"],
                "status": status,
                "ms": round(seconds * 1e3, 1),
                "who": scope.get("principal"),
                "address": client[0] if client else None,
                "job": found.get("job_id"),
                "loop": found.get("tag"),
            },
        )
