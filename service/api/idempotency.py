"""ASGI middleware for the header Idempotency-Key, accepted on every POST: a request that is repeated with the same key
gets the first answer again, and is not executed again.

The header follows the IETF draft "The Idempotency-Key HTTP Header Field"; the quotes that the draft requires are
optional here.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable
from typing import TypeVar

import anyio
from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError
from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.routing import compile_path
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from loopwright.service.api import problems
from loopwright.service.api.gate.bodies import begins_with
from loopwright.service.api.gate.concurrency import stops_a_test
from loopwright.service.security.principal import LOCAL
from loopwright.service.security.principal import current as principal
from loopwright.service.store import idempotency_effects
from loopwright.service.store.idempotency import KEPT_H, Answer, IdempotencyKeys, OtherRequest
from loopwright.service.store.idempotency_effects import Claim, StillAnswering

log = logging.getLogger(__name__)
T = TypeVar("T")

HEADER = "Idempotency-Key"
MAX_CHARACTERS = 128
_CHARACTERS = rf"[A-Za-z0-9._~:+/=-]{{1,{MAX_CHARACTERS}}}"
PATTERN = rf'^(?:{_CHARACTERS}|"{_CHARACTERS}")$'
_NEVER_KEPT = "/session"
"""Its answer holds the token of a session."""
_AT_ONCE = 4
"""Threads reserved for keys, so that requests which wait for a silent node cannot delay the key of an abort."""
_WORDS = f"letters, digits and . _ ~ : + / = -, 1 to {MAX_CHARACTERS} of them, with or without quotes around"


class Idempotent:
    """Wraps the application. The gate runs before this middleware."""

    def __init__(self, app: ASGIApp, keys: IdempotencyKeys) -> None:
        self._app = app
        self._keys = keys
        self._threads = anyio.CapacityLimiter(_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        taken = scope["type"] == "http" and scope["method"] == "POST" and scope["path"] != _NEVER_KEPT
        given = Headers(scope=scope).getlist(HEADER) if taken else []
        if not given:
            await self._app(scope, receive, send)
            return
        if len(given) > 1 or not re.fullmatch(PATTERN, given[0]):
            await problems.problem(422, f"{HEADER} must be one key: {_WORDS}")(scope, receive, send)
            return
        body = await _body(receive)
        if body is not None:
            await self._once(given[0].strip('"'), body, scope, receive, send)

    async def _once(self, key: str, body: bytes, scope: Scope, receive: Receive, send: Send) -> None:
        who = principal.get().key_id or LOCAL
        try:
            claim = await self._beside(lambda: self._keys.claim(who, key, _fingerprint(scope, body)))
        except OtherRequest:
            why = (
                f"{HEADER} {key} was given within the last {KEPT_H} h with another path or body: "
                "repeat that request as it was, or give this one a key of its own"
            )
            await problems.problem(422, why)(scope, receive, send)
        except StillAnswering as error:
            await problems.still_answering(error)(scope, receive, send)
        except SQLAlchemyError as error:
            if stops_a_test(scope["method"], scope["path"]):  # it does the same twice, and waits for nothing
                await self._app(scope, begins_with(body, receive), send)
            else:
                await problems.of_database(error)(scope, receive, send)
        else:
            answer = claim if isinstance(claim, Answer) else await self._answer(claim, body, scope, receive)
            await _response(answer)(scope, receive, send)

    async def _answer(self, claim: Claim, body: bytes, scope: Scope, receive: Receive) -> Answer:
        """The answer of the application, which is stored if it is final."""
        answer: Answer | None = None
        try:
            if claim.effect is None:
                token = idempotency_effects.current.set(claim)
                try:
                    answer = await _ask(self._app, scope, begins_with(body, receive))
                finally:
                    idempotency_effects.current.reset(token)
            else:
                answer = await self._after_the_cut(claim.effect, scope)
            return answer
        finally:
            with anyio.CancelScope(shield=True):
                await self._conclude(claim, answer)

    async def _conclude(self, claim: Claim, answer: Answer | None) -> None:
        """Stores a success or a conflict; a repetition of a refused request must not be executed later."""
        try:
            if answer is not None and (answer.status < 400 or answer.status == 409):
                stored = answer
                await self._beside(lambda: self._keys.keep(claim, stored))
            else:
                await self._beside(lambda: self._keys.let_go(claim))
        except SQLAlchemyError as error:  # the effect of the request is stored with the claim
            log.warning("the answer to %s %s could not be kept: %s", HEADER, claim.key, error)

    async def _after_the_cut(self, effect: str, scope: Scope) -> Answer:
        """The answer to a request that a killed service left unanswered: the resource that it created or changed."""
        get = {**scope, "method": "GET", "path": effect, "raw_path": effect.encode(), "query_string": b""}
        found = await _ask(self._app, get, begins_with(b"", _gone))
        if found.status != 200:
            return found
        created = not scope["path"].startswith(f"{effect}/")
        headers = found.headers | ({"location": effect} if created else {})
        status = await self._beside(lambda: _status(scope))
        return Answer(status, headers, found.body)

    async def _beside(self, work: Callable[[], T]) -> T:
        return await run_sync(work, limiter=self._threads)


def _fingerprint(scope: Scope, body: bytes) -> str:
    """The hash of path, query and body, which must be the same in a repetition."""
    found = hashlib.sha256(f"{scope['path']}\0".encode())
    found.update(scope.get("query_string", b"") + b"\0" + body)
    return found.hexdigest()


def _status(scope: Scope) -> int:
    """The status of success that the OpenAPI document gives for the operation."""
    for path, item in scope["app"].openapi()["paths"].items():
        if "post" in item and compile_path(path)[0].match(scope["path"]):
            return min(int(status) for status in item["post"]["responses"])
    return 200


async def _body(receive: Receive) -> bytes | None:
    """The whole body; None when the client disconnected before its end."""
    parts = []
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        parts.append(message.get("body", b""))
        if not message.get("more_body", False):
            return b"".join(parts)


async def _gone() -> Message:
    """An ASGI receive function for a client that has disconnected."""
    return {"type": "http.disconnect"}


async def _ask(app: ASGIApp, scope: Scope, receive: Receive) -> Answer:
    """The whole answer of the application; no POST answers with a stream."""
    status, headers, parts = 500, {}, []

    async def taken(message: Message) -> None:
        nonlocal status, headers
        if message["type"] == "http.response.start":
            status = message["status"]
            headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in message["headers"]}
        elif message["type"] == "http.response.body":
            parts.append(message.get("body", b""))

    await app(scope, receive, taken)
    return Answer(status, headers, b"".join(parts))


def _response(answer: Answer) -> Response:
    return Response(answer.body, answer.status, answer.headers)
