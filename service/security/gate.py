"""The door of the API as ASGI middleware: who asks, may they, and is it too much. Everything it refuses is a problem.

Closed by default: what is not known to need less needs `operate` (changes) or `read` (the rest).
"""

from __future__ import annotations

import ipaddress
import logging
import re
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass, field, replace
from typing import Any

from fastapi.concurrency import run_in_threadpool
from sqlalchemy.exc import SQLAlchemyError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response

from service.api import problems
from service.security.keyring import Keyring
from service.security.keys import Scope
from service.security.limits import Buckets, RequestLimits, retry_after
from service.security.principal import LOCAL, Principal, current

log = logging.getLogger(__name__)

AsgiScope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[AsgiScope, Receive, Send], Awaitable[None]]

PUBLIC = frozenset({"/healthz", "/docs", "/openapi.json"})
"""Say nothing about this installation."""
ALWAYS = frozenset({"/healthz", "/readyz", "/metrics"})
"""Answered however busy the service is: that is when somebody looks."""
_ADMIN = ("/audit",)
_CHANGES_NOTHING = re.compile(r"/tunings|/loops/[^/]+/retune/preview|/retunes/preview")
"""Paths of a POST that only answers."""
_SAFE = ("GET", "HEAD", "OPTIONS")


def scope_for(method: str, path: str) -> Scope | None:
    """What a request needs; None: nothing."""
    if path in PUBLIC:
        return None
    if path.startswith(_ADMIN):
        return Scope.ADMIN
    return Scope.READ if method in _SAFE or _CHANGES_NOTHING.fullmatch(path) else Scope.OPERATE


@dataclass(frozen=True)
class Policy:
    """keyring None: no keys are asked for, and only names of this machine are answered to."""

    keyring: Keyring | None = None
    limits: RequestLimits = field(default_factory=RequestLimits)
    local_only: bool = False


class Gate:
    """Wraps the application."""

    def __init__(self, app: App, policy: Policy) -> None:
        self._app = app
        self._policy = policy
        limits = policy.limits
        self._callers = Buckets(limits.rate_per_s, limits.burst)
        self._bad_keys = Buckets(limits.bad_keys_per_s, limits.bad_keys_burst)
        self._most = {
            "requests": limits.at_once,
            "streams": limits.streams_at_once,
            "computations": limits.computations_at_once,
        }
        self._now = dict.fromkeys(self._most, 0)

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        found = await self._who(scope)
        if isinstance(found, Response):
            await found(scope, receive, send)
            return
        refused = self._too_much(scope, found)
        if refused is not None:
            await refused(scope, receive, send)
            return
        token = current.set(found)
        kind = _kind(scope["path"])
        self._now[kind] += 1
        try:
            await self._pass(scope, receive, send)
        finally:
            self._now[kind] -= 1
            current.reset(token)

    async def _who(self, scope: AsgiScope) -> Principal | Response:
        """Who asks, or the refusal; scope["principal"] names them for the log."""
        headers, keyring = Headers(scope=scope), self._policy.keyring
        client = scope.get("client")
        anyone = Principal(LOCAL, Scope.ADMIN, address=client[0] if client else None)
        if keyring is None:
            if self._policy.local_only and (why := _not_local(headers)):
                return problems.problem(403, why)
            scope["principal"] = anyone.name
            return anyone
        needed = scope_for(scope["method"], scope["path"])
        if needed is None:
            return replace(anyone, scope=Scope.READ)
        kind, _, key = headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer" or not key:
            return _unauthorized("this needs an API key: Authorization: Bearer KEY")
        row = keyring.known(key)
        if row is None:
            address = anyone.address or "unknown"
            if wait := self._bad_keys.wait_s(address):
                return _wait(429, "too many wrong keys from this address", wait)
            try:
                row = await run_in_threadpool(keyring.check, key)
            except SQLAlchemyError:
                log.exception("the keys cannot be read")
                return _wait(503, "the database with the keys does not answer", 5.0)
            if row is None:
                self._bad_keys.take(address)
                return _unauthorized("this key is not known, was revoked or has expired")
        scope["principal"], has = row.name, Scope(row.scope)
        if not has.includes(needed):
            return problems.problem(
                403,
                f"this needs the scope {needed.value}; the key {row.name!r} has {has.value}",
                headers={"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{needed.value}"'},
            )
        return Principal(row.name, has, row.id, anyone.address)

    def _too_much(self, scope: AsgiScope, who: Principal) -> Response | None:
        if scope["path"] in ALWAYS:
            return None
        if wait := self._callers.take(who.key_id or who.address or "unknown"):
            return _wait(429, "too many requests from this caller", wait)
        kind = _kind(scope["path"])
        if self._now[kind] >= self._most[kind]:
            return _wait(503, f"{self._now[kind]} {kind} are being answered already, no more are taken", 1.0)
        return None

    async def _pass(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        most = self._policy.limits.body_bytes
        why = f"the body is longer than the {most} bytes permitted"
        length = Headers(scope=scope).get("content-length", "0")
        if not length.isdigit() or int(length) > most:
            await problems.problem(413, why)(scope, receive, send)
            return
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > most:  # sent in chunks, without saying how much it will be
                raise HTTPException(413, why)
            return message

        await self._app(scope, counted, send)


def _kind(path: str) -> str:
    if path.endswith("/events"):
        return "streams"
    return "computations" if _CHANGES_NOTHING.fullmatch(path) or path.endswith("/alternatives") else "requests"


def _not_local(headers: Headers) -> str | None:
    """Without keys, a web page in a browser on this machine must not be able to command a loop: neither under a name
    that was made to point here, nor as a request across sites."""
    host = headers.get("host", "")
    if not is_loopback(host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host):
        return f"without keys only names of this machine are answered to, not {host!r}"
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{host}":
        return f"a page of {origin} may not use this service"
    return None


def is_loopback(host: str) -> bool:
    """Whether a name or address is this machine's own."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _unauthorized(why: str) -> Response:
    return problems.problem(401, why, headers={"WWW-Authenticate": 'Bearer realm="loopwright"'})


def _wait(status: int, why: str, wait_s: float) -> Response:
    return problems.problem(status, why, headers={"Retry-After": retry_after(wait_s)})
