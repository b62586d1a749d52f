"""The door of the API as ASGI middleware: who asks, may they, and is it too much. Everything it refuses is a problem.

Closed by default: what is not known to need less needs `operate` (changes) or `read` (the rest).
"""

from __future__ import annotations

import ipaddress
import logging
import time
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy.exc import SQLAlchemyError
from starlette.datastructures import Headers
from starlette.responses import Response

from loopwright.service.api import problems
from loopwright.service.api.gate.bodies import Bodies, BodyRefused, begins_with
from loopwright.service.api.gate.key_checks import KeyChecks, TooOften
from loopwright.service.api.gate.limits import Buckets, RequestLimits, retry_after
from loopwright.service.api.gate.places import (
    DECIDES,
    SAFE_METHODS,
    Full,
    Places,
    RequestKind,
    Turn,
    changes_nothing,
    kind_of,
)
from loopwright.service.loops.shared_reading import asked_at
from loopwright.service.security.keys import Scope
from loopwright.service.security.principal import LOCAL, Principal, current
from loopwright.service.store.database import urgent
from loopwright.service.store.keyring import Keyring

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


def scope_for(method: str, path: str) -> Scope | None:
    """What a request needs; None: nothing."""
    if path in PUBLIC:
        return None
    if path.startswith(_ADMIN):
        return Scope.ADMIN
    return Scope.READ if method in SAFE_METHODS or changes_nothing(path) else Scope.OPERATE


@dataclass(frozen=True)
class Policy:
    """keyring None: no keys are asked for, and only names of this machine are answered to."""

    keyring: Keyring | None = None
    limits: RequestLimits = field(default_factory=RequestLimits)
    local_only: bool = False


class Gate:
    """Wraps the application.

    In this order: the key, how often its holder asks, the body, a place among requests of the same kind. A body that
    does not come takes nobody's place.
    """

    def __init__(self, app: App, policy: Policy) -> None:
        self._app = app
        self._policy = policy
        limits = policy.limits
        # Apart: who reads too much may still stop a test.
        self._asked, self._decided = (Buckets(limits.rate_per_s, limits.burst) for _ in range(2))
        self._checks = None if policy.keyring is None else KeyChecks(policy.keyring, limits)
        self._bodies = Bodies(limits)
        self._places = Places(limits)

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        found = await self._who(scope)
        if isinstance(found, Response):
            await found(scope, receive, send)
            return
        token, arrived = current.set(found), asked_at.set(time.monotonic())
        try:
            await self._let_in(scope, receive, send, found)
        finally:
            asked_at.reset(arrived)
            current.reset(token)

    async def _let_in(self, scope: AsgiScope, receive: Receive, send: Send, who: Principal) -> None:
        kind, client = kind_of(scope["method"], scope["path"]), who.key_id or who.address or "unknown"
        if kind is None:
            await self._app(scope, receive, send)
            return
        urgent.set(kind in DECIDES)
        try:
            self._refuse_often(kind, client)
            self._places.check(kind, client)
            body = await self._bodies.whole(scope, receive, client, small=kind in DECIDES)
            if body is not None:
                receive = begins_with(body, receive)
            async with self._places.taken(kind, client) as turn:
                await self._app(scope, receive, _until_it_begins(send, turn))
        except (Full, BodyRefused) as refused:
            await _refusal(refused.status, str(refused), 1.0)(scope, receive, send)
        except TooOften as refused:
            await _refusal(429, str(refused), refused.wait_s)(scope, receive, send)

    def _refuse_often(self, kind: RequestKind, client: str) -> None:
        if kind is RequestKind.WATCH:
            return
        if wait := (self._decided if kind in DECIDES else self._asked).take(client):
            raise TooOften("too many requests from this caller", wait)

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
        assert self._checks is not None
        try:
            row = await self._checks.row(key, anyone.address or "unknown")
        except TooOften as often:
            return _refusal(429, str(often), often.wait_s)
        except SQLAlchemyError:
            log.exception("the keys cannot be read")
            return _refusal(503, "the database with the keys does not answer", 5.0)
        if row is None:
            return _unauthorized("this key is not known, was revoked or has expired")
        scope["principal"], has = row.name, Scope(row.scope)
        if not has.includes(needed):
            return problems.problem(
                403,
                f"this needs the scope {needed.value}; the key {row.name!r} has {has.value}",
                headers={"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{needed.value}"'},
            )
        return Principal(row.name, has, row.id, anyone.address)


def _until_it_begins(send: Send, turn: Turn) -> Send:
    """The work is done when the answer begins: a client that is slow to take it keeps nobody waiting."""

    async def sending(message: Message) -> None:
        turn.over()
        await send(message)

    return sending


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


def _refusal(status: int, why: str, wait_s: float) -> Response:
    """With the connection's end where the rest of a body may still come: it would be read as the next request."""
    headers = {"Retry-After": retry_after(wait_s)} if status in (429, 503) else {"Connection": "close"}
    return problems.problem(status, why, headers=headers)
