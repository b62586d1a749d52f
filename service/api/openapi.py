"""What every operation shares is written into the OpenAPI document in one place: the key it needs, and what the door
may answer instead of it."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from loopwright.service.api import problems
from loopwright.service.api.gate.gate import ALWAYS, scope_for
from loopwright.service.api.idempotency import HEADER, MAX_CHARACTERS, PATTERN
from loopwright.service.store.idempotency import KEPT_H

_KEY = "key"
_METHODS = ("get", "post", "put", "patch", "delete")
_IDEMPOTENCY_KEY = {
    "name": HEADER,
    "in": "header",
    "required": False,
    "description": "Any text that the client gives to no other request, a UUID say. Repeated with the same key within "
    f"{KEPT_H} h, the request does nothing again and is answered as it was the first time. With another path or body: "
    "422; while the first is still being answered: 409 with Retry-After",
    "schema": {"type": "string", "pattern": PATTERN, "maxLength": MAX_CHARACTERS + 2},
    "example": "7f1c4f5e-2b8f-4a36-9f3a-5d0b3c1e8a77",
}


def install(app: FastAPI) -> None:
    """Completes the document that the application makes of itself."""
    make = app.openapi

    def complete() -> dict[str, Any]:
        if app.openapi_schema is None:
            _complete(make())
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = complete  # type: ignore[method-assign]


def _complete(document: dict[str, Any]) -> None:
    schemas = document.setdefault("components", {})
    schemas["securitySchemes"] = {
        _KEY: {
            "type": "http",
            "scheme": "bearer",
            "description": "An API key, made by `loopwright key create`. Not asked for on a service that listens on "
            "its own machine only, unless it was started with --auth.",
        }
    }
    for never_answered in ("HTTPValidationError", "ValidationError"):
        schemas["schemas"].pop(never_answered, None)
    for path, item in document["paths"].items():
        for method in _METHODS:
            if method in item:
                _one(path, method, item[method])


def _one(path: str, method: str, operation: dict[str, Any]) -> None:
    needed = scope_for(method.upper(), path)
    more: tuple[int, ...] = (403,)  # without keys, a name that is not this machine's
    if needed is not None:
        operation["security"] = [{_KEY: []}]
        operation["description"] = "\n\n".join(
            part for part in (operation.get("description"), f"Scope: {needed.value}.") if part
        )
        more += (401,)
    if method != "get":
        more += (408, 413)  # the body did not come, or is too long
    if method == "post":
        operation.setdefault("parameters", []).append(_IDEMPOTENCY_KEY)
        more += (409, 422)
    if "requestBody" in operation:
        more += (400, 415)  # cut off; not JSON by its header
    if operation.get("parameters"):
        more += (422,)  # text that no database keeps
    if path not in ALWAYS:
        more += (429, 503)
    elif needed is not None:
        more += (429, 503)  # too many wrong keys; the keys cannot be read
    for status, documented in problems.documented(*more).items():
        if status == 422:  # FastAPI documents its own object, which the service never answers with
            operation["responses"][str(status)] = documented
        operation["responses"].setdefault(str(status), documented)
