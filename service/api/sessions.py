"""The routes by which a browser signs in and out with an API key, and which say who is asking."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from importlib.metadata import version

from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field
from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.api import problems
from loopwright.service.api.gate.cookies import cookie_name, from_elsewhere
from loopwright.service.api.gate.key_checks import KeyChecks, TooOften
from loopwright.service.api.gate.limits import Buckets, retry_after
from loopwright.service.api.routes import new_router
from loopwright.service.inputs.validation import STRICT
from loopwright.service.security.keys import Scope, key_id_of
from loopwright.service.security.principal import Principal, current
from loopwright.service.security.sessions import LASTS_S, BrowserSessions
from loopwright.service.store import audit
from loopwright.service.store.store import Store
from loopwright.service.store.tables import KeyRow

log = logging.getLogger(__name__)

_UNKNOWN = "unknown"


class SignInRequest(BaseModel):
    """The API key with which a browser signs in."""

    model_config = STRICT

    key: str = Field(
        min_length=1, max_length=200, description="The API key. Only the answer's cookie is used afterwards",
        examples=["lw_0123456789ab_AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"],
    )  # fmt: skip


class SessionView(BaseModel):
    """The caller, and the service that answers."""

    name: str = Field(description="Name of the key; `local`: no keys are asked for", examples=["control room"])
    scope: Scope = Field(description="What the caller may do; each scope includes the one before", examples=["operate"])
    keys: bool = Field(description="Whether keys are asked for")
    gateway: str = Field(description="Name of the gateway that answers", examples=["local"])
    version: str = Field(description="Version of the service", examples=["0.1.0"])
    csrf: str | None = Field(
        default=None,
        description="What a request with the session's cookie sends as X-Loopwright-CSRF when it changes something; "
        "null: the caller has no session",
    )


class _Refusals:
    """Writes refused sign-ins into the audit log: of one address five, then one a minute; of all sixty, then ten a
    minute. The next one that is written says how many were not."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._of_address, self._of_all = Buckets(1 / 60, 5), Buckets(1 / 6, 60)
        self._unwritten = 0

    async def happened(self, address: str, key: str, name: str | None, why: str) -> None:
        if self._of_address.take(address) or self._of_all.take("all"):
            self._unwritten += 1
            return
        after: Mapping[str, object] = {"key": name, "why": why, "not_written_before": self._unwritten}
        self._unwritten = 0
        who = Principal(_UNKNOWN, Scope.READ, address=address)
        try:
            await run_in_threadpool(_write, self._store, who, "sign_in_refused", key_id_of(key) or _UNKNOWN, after)
        except (SQLAlchemyError, TimeoutError):
            log.warning("a refused sign-in from %s could not be written into the audit log", address)


def router(store: Store, checks: KeyChecks | None, open_sessions: BrowserSessions) -> APIRouter:
    """A router with GET, POST and DELETE /session. checks: None where no keys are asked for."""
    routes = new_router("operations")
    refusals = _Refusals(store)

    def view(who: Principal, csrf: str | None) -> SessionView:
        return SessionView(
            name=who.name, scope=who.scope, keys=checks is not None, gateway=store.host, version=version("loopwright"),
            csrf=csrf,
        )  # fmt: skip

    @routes.get("/session", summary="Who is asking, and what the caller may do", responses=problems.responses())
    def get_session() -> SessionView:
        who = current.get()
        found = open_sessions.use(who.session) if who.session else None
        return view(who, found.csrf if found else None)

    @routes.post(
        "/session",
        summary="Sign a browser in with an API key; the answer sets the cookie of the session",
        responses=problems.responses(401, 403, 409, 422, 429, 503),
    )
    async def sign_in(asked: SignInRequest, request: Request, response: Response) -> SessionView:
        if checks is None:
            raise HTTPException(409, "no keys are asked for here, so there is nothing to sign in to")
        if why := from_elsewhere(request.headers):
            raise HTTPException(403, why)
        address, key = current.get().address or _UNKNOWN, asked.key.strip()
        row = await _row(checks, key, address, refusals)
        who = Principal(row.name, Scope(row.scope), row.id, address)
        await run_in_threadpool(_write, store, who, "sign_in", row.id, {"name": row.name, "scope": row.scope})
        token, begun = open_sessions.begin(row.id, row.name, Scope(row.scope))
        scheme = request.scope["scheme"]
        response.set_cookie(
            cookie_name(request.headers, scheme), token, max_age=int(LASTS_S), path="/", secure=scheme == "https",
            httponly=True, samesite="strict",
        )  # fmt: skip
        return view(who, begun.csrf)

    @routes.delete(
        "/session", summary="Sign the browser out", status_code=204, responses=problems.responses(403, 409, 503)
    )
    def sign_out(request: Request, response: Response) -> None:
        who = current.get()
        if who.session is None or who.key_id is None:
            raise HTTPException(409, "this request came without a session, so there is nothing to sign out of")
        open_sessions.end(who.session)
        scheme = request.scope["scheme"]
        response.delete_cookie(
            cookie_name(request.headers, scheme), path="/", secure=scheme == "https", httponly=True, samesite="strict"
        )
        try:
            _write(store, who, "sign_out", who.key_id, {"name": who.name})
        except (SQLAlchemyError, TimeoutError):  # the session is over all the same
            log.warning("a sign-out of the key %r could not be written into the audit log", who.name)

    return routes


async def _row(checks: KeyChecks, key: str, address: str, refusals: _Refusals) -> KeyRow:
    """The row of a valid key. Raises HTTPException, and writes down that the sign-in was refused."""
    try:
        row = await checks.row(key, address)
        name = None if row is not None else await checks.name_of(key)
    except TooOften as often:
        await refusals.happened(address, key, None, str(often))
        wait = retry_after(often.wait_s)
        raise HTTPException(429, f"{often}: try again in {wait} s", {"Retry-After": wait}) from None
    if row is None:
        why = "this key is not known, was revoked or has expired"
        await refusals.happened(address, key, name, why)
        raise HTTPException(401, why)
    return row


def _write(store: Store, who: Principal, what: str, subject: str, after: Mapping[str, object]) -> None:
    token = current.set(who)
    try:
        with store.writing() as writing:
            audit.record(writing, what, subject, after=after)
    finally:
        current.reset(token)
