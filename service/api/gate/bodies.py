"""Request bodies are received whole before the application is called, within limits of time and memory."""

from __future__ import annotations

import asyncio
from collections import Counter

from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope

from loopwright.service.api.gate.limits import RequestLimits

SMALL = 16 << 10
"""Bytes. A shorter body does not count towards the limit of all bodies; the body of a decision must not be longer."""


class BodyRefused(Exception):
    """The body is too long (413), did not arrive (400, 408), or there is no memory for it (429, 503)."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class Bodies:
    """The bodies that are being received. An object belongs to one event loop."""

    def __init__(self, limits: RequestLimits) -> None:
        self._limits = limits
        self._held: Counter[str] = Counter()

    async def whole(self, scope: Scope, receive: Receive, client: str, small: bool) -> bytes | None:
        """The body; None for a request without a body. small: the request is a decision. Raises BodyRefused."""
        headers = Headers(scope=scope)
        length = headers.get("content-length", "0")
        maximum = min(SMALL, self._limits.body_bytes) if small else self._limits.body_bytes
        too_long = BodyRefused(413, f"the body is longer than the {maximum} bytes permitted")
        if not length.isdigit() or int(length) > maximum:
            raise too_long
        if not int(length) and "transfer-encoding" not in headers:
            return None
        held = 0
        body = bytearray()
        try:
            async with asyncio.timeout(self._limits.body_s):
                while True:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        raise BodyRefused(400, "the connection ended before the body did")
                    body += message.get("body", b"")
                    if len(body) > maximum:  # a chunked body does not announce its length
                        raise too_long
                    if len(body) > SMALL:
                        self._hold(client, len(body) - held)
                        held = len(body)
                    if not message.get("more_body", False):
                        return bytes(body)
        except TimeoutError:
            why = f"{len(body)} bytes of the body came in {self._limits.body_s:g} s, and not its end"
            raise BodyRefused(408, why) from None
        finally:
            self._held[client] -= held
            if not self._held[client]:
                del self._held[client]

    def _hold(self, client: str, more: int) -> None:
        room = self._limits.bodies_bytes
        if self._held.total() + more > room:
            raise BodyRefused(503, f"bodies of {room} bytes are being received already, no more are taken")
        if self._held[client] + more > room // 2:
            raise BodyRefused(429, f"bodies of {room // 2} bytes of this client are being received already, its share")
        self._held[client] += more


def begins_with(body: bytes, receive: Receive) -> Receive:
    """An ASGI receive function that gives the body first, then what the server sends."""
    given = False

    async def receiving() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return receiving
