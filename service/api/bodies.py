"""Routes whose request body must be strict JSON (see `service.api.strict_json`) with a JSON content type, and whose
query parameters must be known; and who signs the test that a body asks for."""

from __future__ import annotations

from collections.abc import Callable, Coroutine

from fastapi import HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute

from loopwright.service.api import strict_json
from loopwright.service.api.parameters import parameters_of, refuse_others
from loopwright.service.inputs.request import AnyRetune
from loopwright.service.security.principal import current

_SHORT = 16_384
"""Bytes. A longer body is parsed in a thread, because parsing it would block the event loop."""


class BadBody(HTTPException):
    """The body is not valid JSON. where: the path to the invalid value; empty if there is none."""

    def __init__(self, why: str, where: str = "") -> None:
        super().__init__(422, why)
        self.where = f"body.{where}" if where else "body"


def signed_test(options: AnyRetune | None) -> AnyRetune:
    """The options of a retune, which is not begun by a request without a body, nor, on the loop, for nobody. Raises
    BadBody."""
    if options is None:
        raise BadBody(
            'a retune needs a body: send Content-Type: application/json and {"by": "YOUR NAME"}, with the '
            'options if there are any; {"dry_run": true} rehearses it and needs no name'
        )
    named = bool((options.by or "").strip())
    if not named and not options.dry_run and current.get().key_id is None:
        raise BadBody(
            'a test of the loop is signed by a person, and no key names the caller: add "by": "YOUR NAME"',
            "by",
        )
    return options


class JsonRoute(APIRoute):
    """The class of every route: its body is strict JSON, its query parameters are those that it has."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[object, object, Response]]:
        handle = super().get_route_handler()
        takes_body, known = self.body_field is not None, parameters_of(self.dependant)

        async def strictly(request: Request) -> Response:
            if not self.path.endswith("/abort"):  # nothing in a request is a reason not to stop a test
                refuse_others(request, known)
            if not takes_body:
                return await handle(request)
            strict = _JsonRequest(request.scope, request.receive)
            if await strict.body():
                _check_type(request.headers.get("content-type", ""))
            return await handle(strict)

        return strictly


class _JsonRequest(Request):
    async def json(self) -> object:
        if not hasattr(self, "_json"):
            body = await self.body()
            try:
                if len(body) > _SHORT:
                    self._json = await run_in_threadpool(strict_json.loads, body)
                else:
                    self._json = strict_json.loads(body)
            except strict_json.BadJson as error:
                raise BadBody(error.why, error.where) from None
        return self._json


def _check_type(content_type: str) -> None:
    kind = content_type.partition(";")[0].strip().lower()
    if kind != "application/json" and not (kind.startswith("application/") and kind.endswith("+json")):
        said = f"not {kind[:60]}" if kind else "which is missing"
        raise HTTPException(415, f"the body must be JSON with the header Content-Type: application/json, {said}")
