"""Aborts as they come in: a test is asked to stop before the request waits for anything, and nothing in the request is
a reason not to stop it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from fastapi import Depends, Request
from pydantic import TypeAdapter, ValidationError

from loopwright.service.api import strict_json
from loopwright.service.api.job_views import Decision
from loopwright.service.jobs.manager import Jobs
from loopwright.service.security.principal import signed


@contextmanager
def stopping(jobs: Jobs, path: str) -> Iterator[None]:
    """Asks the jobs of the path of an abort that run here to stop; the abort is answered meanwhile. Who has stopped
    them is stored however it is answered."""
    _, what, name, _ = path.split("/")
    if what == "jobs":
        stopped, by = [name] if jobs.tell_to_stop(name) else [], signed(None)
    else:
        stopped, by = jobs.tell_all_of(name), f"batch {name}"
    try:
        yield
    finally:
        for job_id in stopped:
            jobs.record_stop(job_id, by)


_DECISION = TypeAdapter(Decision)


async def _said(request: Request) -> str:
    """Who aborts, as far as the body says so; it may be missing, anything, and of any content type."""
    try:
        body = strict_json.loads(await request.body())
        given = _DECISION.validate_python({"by": body.get("by")} if isinstance(body, dict) else body)
    except (strict_json.BadJson, ValidationError):
        return signed(None)
    return signed(given.by)


SaidBy = Annotated[str, Depends(_said)]
BODY = {
    "requestBody": {
        "description": "May be left out, and is read as far as it can be: nothing in a request is a reason not to stop",
        "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Decision"}}},
    }
}
"""The body of an abort in the document."""
