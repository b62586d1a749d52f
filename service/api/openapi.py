"""Completes the OpenAPI document with what all operations share: the security scheme, the scope of the key, the header
Idempotency-Key, and the errors that middleware answers with."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from loopwright.service.api import problems
from loopwright.service.api.event_views import schemas as event_schemas
from loopwright.service.api.gate.gate import ALWAYS, scope_for
from loopwright.service.api.idempotency import HEADER, MAX_CHARACTERS, PATTERN
from loopwright.service.api.openapi_document import Document, HeaderField, Operation, Parameter, as_document
from loopwright.service.store.idempotency import KEPT_H

_KEY = "key"
_METHODS = ("get", "post", "put", "patch", "delete")
_IDEMPOTENCY_KEY: Parameter = {
    "name": HEADER,
    "in": "header",
    "required": False,
    "description": "A unique text chosen by the client, for example a UUID. A request that is repeated with the same "
    f"key within {KEPT_H} h is not executed again and gets the first answer. The same key with another path or body "
    "gets 422; a repetition while the first request is still being answered gets 409 with Retry-After",
    "schema": {"type": "string", "pattern": PATTERN, "maxLength": MAX_CHARACTERS + 2},
    "example": "7f1c4f5e-2b8f-4a36-9f3a-5d0b3c1e8a77",
}


_LOCATION: HeaderField = {"description": "URL of the job or the retune", "schema": {"type": "string"}}


def install(app: FastAPI) -> None:
    """Makes `app.openapi` return the completed document."""
    make = app.openapi

    def complete() -> dict[str, Any]:
        if app.openapi_schema is None:
            _complete(as_document(make()))
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = complete  # type: ignore[method-assign]


_TAGS = {
    "loops": "Loops, their present state, their history, and the start of a retune",
    "jobs": "Retunes of one loop: what they found, and the decision on it",
    "batches": "Retunes of many loops at once",
    "tunings": "Gains for a model, without a loop",
    "alarms": "The active alarms",
    "live": "Values as they are received, as a stream",
    "webhooks": "What the service calls by itself when a job awaits a decision or has ended",
    "operations": "The service itself: health, changes, keys and sessions",
}


def _complete(document: Document) -> None:
    document["info"] |= {
        "contact": {"name": "The developers of Loopwright"},
        "license": {"name": "Apache License 2.0", "identifier": "Apache-2.0"},
    }
    document["servers"] = [{"url": "/", "description": "The service that this document comes from"}]
    document["tags"] = [{"name": name, "description": text} for name, text in _TAGS.items()]
    schemas = document.setdefault("components", {})
    schemas["securitySchemes"] = {
        _KEY: {
            "type": "http",
            "scheme": "bearer",
            "description": "An API key, created by `loopwright key create`. A service that listens only on its own "
            "machine needs no key, unless it was started with --auth.",
        }
    }
    schemas["schemas"] = problems.schemas() | event_schemas() | schemas["schemas"]
    for never_answered in ("HTTPValidationError", "ValidationError"):
        schemas["schemas"].pop(never_answered, None)
    for path, item in document["paths"].items():
        for method in _METHODS:
            if method in item:
                _one(path, method, item[method])
    for item in document.get("webhooks", {}).values():
        item["post"]["responses"].pop("422", None)  # what the receiver answers is its own affair


def _one(path: str, method: str, operation: Operation) -> None:
    needed = scope_for(method.upper(), path)
    more: tuple[int, ...] = (403,)  # without keys, a host name that is not this machine's
    if needed is not None:
        operation["security"] = [{_KEY: []}]
        operation["description"] = "\n\n".join(
            part for part in (operation.get("description"), f"Scope: {needed.value}.") if part
        )
        more += (401,)
    operation.setdefault("description", operation.get("summary", ""))
    if "202" in operation["responses"]:
        operation["responses"]["202"]["headers"] = {"Location": _LOCATION}
    if method != "get":
        more += (408, 413)  # the body did not arrive, or is too long
    if method == "post":
        operation.setdefault("parameters", []).append(_IDEMPOTENCY_KEY)
        more += (409, 422)
    if "requestBody" in operation:
        more += (400, 415)  # the body was cut off; its content type is not JSON
    if operation.get("parameters"):
        more += (422,)  # text that the database cannot store
    if path not in ALWAYS:
        more += (429, 503)
    elif needed is not None:
        more += (429, 503)  # too many wrong keys; the keys cannot be read
    for status, documented in problems.documented(*more).items():
        if status == 422:  # FastAPI documents a schema that the service never answers with
            operation["responses"][str(status)] = documented
        operation["responses"].setdefault(str(status), documented)
        if "headers" in documented:
            operation["responses"][str(status)].setdefault("headers", documented["headers"])
