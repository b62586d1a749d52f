"""ASGI middleware for authentication, authorization and rate limits. Every refusal is a problem (RFC 9457).

A path that no rule names needs the scope `operate` for a request that changes something, `read` for the rest.
"""

from __future__ import annotations

import ipaddress
import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

from sqlalchemy.exc import SQLAlchemyError
from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Send
from starlette.types import Scope as AsgiScope

from loopwright.service.api import problems
from loopwright.service.api.gate.bodies import Bodies, BodyRefused, begins_with
from loopwright.service.api.gate.concurrency import (
    DECIDES,
    SAFE_METHODS,
    Full,
    Places,
    RequestKind,
    Turn,
    changes_nothing,
    is_page,
    kind_of,
    stops_a_test,
)
from loopwright.service.api.gate.cookies import not_proved, token_of
from loopwright.service.api.gate.key_checks import KeyChecks, TooOften
from loopwright.service.api.gate.limits import Buckets, RequestLimits, retry_after
from loopwright.service.loops.shared_reading import asked_at
from loopwright.service.security.keys import Scope
from loopwright.service.security.principal import LOCAL, Principal, current
from loopwright.service.security.sessions import BrowserSessions
from loopwright.service.store.database import urgent
from loopwright.service.store.keyring import REVOKED_WITHIN_S, Keyring

log = logging.getLogger(__name__)

PUBLIC = frozenset({"/healthz", "/docs", "/openapi.json"})
"""Paths that need no key, because their answers say nothing about this installation. So do the files of the page;
POST /session checks the key in its body."""
ALWAYS = frozenset({"/healthz", "/readyz", "/metrics"})
"""Paths that are answered however busy the service is, because then operators ask for them."""
_ADMIN = ("/audit",)
_SMALL = (*DECIDES, RequestKind.SIGN_IN, RequestKind.PAGE)

_KEYS_AWAY = "the database with the keys does not answer"


def scope_for(method: str, path: str) -> Scope | None:
    """The scope that a request needs; None for a public path."""
    if path in PUBLIC or is_page(path) or (path == "/session" and method == "POST"):
        return None
    if path == "/session":
        return Scope.READ
    if path.startswith(_ADMIN):
        return Scope.ADMIN
    return Scope.READ if method in SAFE_METHODS or changes_nothing(path) else Scope.OPERATE


@dataclass(frozen=True)
class Policy:
    """keyring: None to ask for no keys. local_only: without keys, refuse host names other than this machine's.
    sessions: of the browsers that have signed in with a key."""

    keyring: Keyring | None = None
    limits: RequestLimits = field(default_factory=RequestLimits)
    local_only: bool = False
    sessions: BrowserSessions = field(default_factory=BrowserSessions)


class Gate:
    """Wraps the application.

    The gate checks the key, then the rate of its holder, then receives the body, then takes a place among the requests
    of the same kind. A body that does not arrive therefore takes nobody's place. A test hears of an abort before the
    body and the place are waited for.

    stopping: asks the tests of the path of an abort to stop, and lasts until that is answered.
    gateway: name of this gateway, where several share a database.
    """

    def __init__(
        self,
        app: ASGIApp,
        policy: Policy,
        checks: KeyChecks | None,
        stopping: Callable[[str], AbstractContextManager[None]],
        gateway: str | None = None,
    ) -> None:
        self._app = app
        self._stopping = stopping
        self._gateway = gateway
        self._policy = policy
        limits = policy.limits
        # Decisions have buckets of their own: a client that reads too much may still stop a test.
        self._asked, self._decided = (Buckets(limits.rate_per_s, limits.burst) for _ in range(2))
        self._checks = checks
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
        found = replace(found, gateway=self._gateway)
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
            with self._stopping(scope["path"]) if stops_a_test(scope["method"], scope["path"]) else nullcontext():
                await self._in_turn(scope, receive, send, kind, client)
        except (Full, BodyRefused) as refused:
            await _refusal(refused.status, str(refused), 1.0)(scope, receive, send)
        except TooOften as refused:
            await _refusal(429, str(refused), refused.wait_s)(scope, receive, send)

    async def _in_turn(self, scope: AsgiScope, receive: Receive, send: Send, kind: RequestKind, client: str) -> None:
        self._places.check(kind, client)
        body = await self._bodies.whole(scope, receive, client, small=kind in _SMALL)
        if body is not None:
            receive = begins_with(body, receive)
        async with self._places.taken(kind, client) as turn:
            await self._app(scope, receive, _until_it_begins(send, turn))

    def _refuse_often(self, kind: RequestKind, client: str) -> None:
        if kind is RequestKind.WATCH:
            return
        if wait := (self._decided if kind in DECIDES else self._asked).take(client):
            raise TooOften("too many requests from this caller", wait)

    async def _who(self, scope: AsgiScope) -> Principal | Response:
        """The principal of the request, or the refusal. scope["principal"] gets the name for the log."""
        headers = Headers(scope=scope)
        client = scope.get("client")
        anyone = Principal(LOCAL, Scope.ADMIN, address=client[0] if client else None)
        if self._checks is None:
            if self._policy.local_only and (why := _not_local(headers)):
                return problems.problem(403, why)
            scope["principal"] = anyone.name
            return anyone
        needed = scope_for(scope["method"], scope["path"])
        if needed is None:
            return replace(anyone, scope=Scope.READ)
        if not headers.get("authorization") and (token := token_of(headers, scope["scheme"])):
            return await self._signed_in(token, headers, scope, needed, anyone.address)
        kind, _, key = headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer" or not key:
            return _unauthorized("this needs an API key: Authorization: Bearer KEY")
        try:
            stops = stops_a_test(scope["method"], scope["path"])
            row = await self._checks.row(key, anyone.address or "unknown", stops)
        except TooOften as often:
            return _refusal(429, str(often), often.wait_s)
        except SQLAlchemyError:
            log.exception("the keys cannot be read")
            return _refusal(503, _KEYS_AWAY, 5.0)
        if row is None:
            return _unauthorized("this key is not known, was revoked or has expired")
        scope["principal"], has = row.name, Scope(row.scope)
        if not has.includes(needed):
            return _insufficient(needed, row.name, has)
        return Principal(row.name, has, row.id, anyone.address)

    async def _signed_in(
        self, token: str, headers: Headers, scope: AsgiScope, needed: Scope, address: str | None
    ) -> Principal | Response:
        """The principal of a request with the cookie of a session, or the refusal."""
        sessions = self._policy.sessions
        session = sessions.of(token)
        if session is not None and sessions.unchecked_s(session) > REVOKED_WITHIN_S:
            assert self._checks is not None
            stops = stops_a_test(scope["method"], scope["path"])
            try:
                if not await self._checks.still_valid(session.key_id, stops):
                    sessions.end_of_key(session.key_id)
                    session = None
                elif not stops:  # an abort may have been let in without the database
                    sessions.checked(session)
            except SQLAlchemyError:
                log.exception("the keys cannot be read")
                return _refusal(503, _KEYS_AWAY, 5.0)
        if session is None:
            return _unauthorized("this session is over, or its key is no longer valid: sign in again at /ui/")
        scope["principal"] = session.name
        if scope["method"] not in SAFE_METHODS and (why := not_proved(headers, session.csrf)):
            return problems.problem(403, why)
        if not session.scope.includes(needed):
            return _insufficient(needed, session.name, session.scope)
        return Principal(session.name, session.scope, session.key_id, address, session.id)


def _until_it_begins(send: Send, turn: Turn) -> Send:
    """A send function that ends the turn when the answer begins, so that a slow client does not block others."""

    async def sending(message: Message) -> None:
        turn.over()
        await send(message)

    return sending


def _not_local(headers: Headers) -> str | None:
    """Why a request without a key is refused, None if it is not. A web page in a browser on this machine must not
    command a loop, neither by DNS rebinding nor by a cross-site request."""
    host = headers.get("host", "")
    if not is_loopback(host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host):
        return f"without keys only names of this machine are answered to, not {host!r}"
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{host}":
        return f"a page of {origin} may not use this service"
    return None


def is_loopback(host: str) -> bool:
    """Whether a host name or an address is a loopback one."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _insufficient(needed: Scope, name: str, has: Scope) -> Response:
    return problems.problem(
        403,
        f"this needs the scope {needed.value}; the key {name!r} has {has.value}",
        headers={"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{needed.value}"'},
    )


def _unauthorized(why: str) -> Response:
    return problems.problem(401, why, headers={"WWW-Authenticate": 'Bearer realm="loopwright"'})


def _refusal(status: int, why: str, wait_s: float) -> Response:
    """A refusal. It closes the connection where the rest of a body may follow and be read as the next request."""
    headers = {"Retry-After": retry_after(wait_s)} if status in (429, 503) else {"Connection": "close"}
    return problems.problem(status, why, headers=headers)
