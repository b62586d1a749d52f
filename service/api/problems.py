"""Errors of the API as application/problem+json (RFC 9457), with reason and advice if there are any."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from sqlalchemy.exc import DataError, SQLAlchemyError
from starlette.exceptions import HTTPException

from loopwright.service.api.bodies import BadBody
from loopwright.service.api.openapi_document import DocumentedResponse, HeaderField, MediaType, Schema, schemas_of
from loopwright.service.api.parameters import UnknownParameter
from loopwright.service.errors import Conflict, Locked, NotKnown, RemoteSetpoint, Stopping, UnknownLoop
from loopwright.service.execution.computing.pool import NotWanted
from loopwright.service.inputs.model_json import BadModel
from loopwright.service.inputs.request import BadLimits
from loopwright.service.inputs.validation import place, words
from loopwright.service.jobs.journal import temporary
from loopwright.service.offline.tunings import BadTuning
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.store.damage import is_damage
from loopwright.service.store.idempotency_effects import StillAnswering
from loopwright.service.store.job_rows import NoSuchJob
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Busy
from loopwright.tuning.reasons import ADVICE, Ended, Reason, Refused

MEDIA_TYPE = "application/problem+json"
Responses = dict[int | str, dict[str, Any]]
"""The type of the argument `responses` of a FastAPI route."""
CLIENT_GONE = 499
"""The status that nginx logs when the client has disconnected; nobody reads the answer."""


class ProblemReason(StrEnum):
    """Reasons of the API itself, beside those for which a retune ends."""

    BAD_REQUEST = "bad_request"
    UNAUTHORIZED = "unauthorized"
    FORBIDDEN = "forbidden"
    NOT_FOUND = "not_found"
    UNKNOWN_LOOP = "unknown_loop"
    UNKNOWN_JOB = "unknown_job"
    UNKNOWN_BATCH = "unknown_batch"
    UNKNOWN_ALARM = "unknown_alarm"
    METHOD_NOT_ALLOWED = "method_not_allowed"
    REQUEST_TIMEOUT = "request_timeout"
    CONFLICT = "conflict"
    LOOP_BUSY = "loop_busy"
    WRONG_STATE = "wrong_state"
    STILL_ANSWERING = "still_answering"
    TOO_LARGE = "too_large"
    UNSUPPORTED_MEDIA_TYPE = "unsupported_media_type"
    INVALID = "invalid"
    TOO_MANY_REQUESTS = "too_many_requests"
    INTERNAL_ERROR = "internal_error"
    NOT_READY = "not_ready"


_BY_STATUS = {
    400: ProblemReason.BAD_REQUEST, 401: ProblemReason.UNAUTHORIZED, 403: ProblemReason.FORBIDDEN,
    404: ProblemReason.NOT_FOUND, 405: ProblemReason.METHOD_NOT_ALLOWED, 408: ProblemReason.REQUEST_TIMEOUT,
    409: ProblemReason.CONFLICT, 413: ProblemReason.TOO_LARGE, 415: ProblemReason.UNSUPPORTED_MEDIA_TYPE,
    422: ProblemReason.INVALID, 429: ProblemReason.TOO_MANY_REQUESTS, 503: ProblemReason.NOT_READY,
}  # fmt: skip
"""What the status says alone."""
TYPE = "urn:loopwright:problem:"
"""What the type of a problem begins with; its reason follows."""


class InvalidValue(BaseModel):
    """An invalid value of a request."""

    where: str = Field(description="Path of the value", examples=["body.model.K"])
    why: str = Field(description="Why the value is invalid", examples=["K must not be 0: PV would not answer MV"])


class Problem(BaseModel):
    """RFC 9457 problem details."""

    type: str = Field(description=f"URI of the kind of problem: {TYPE} and the reason", examples=[f"{TYPE}loop_busy"])
    title: str = Field(description="Title of the HTTP status", examples=["Conflict"])
    status: int = Field(description="HTTP status", examples=[409])
    detail: str = Field(
        description="Explanation of this occurrence",
        examples=["loop TIC-101 is locked by night shift since 2026-01-31T12:00:00.000Z: valve"],
    )
    reason: Reason | ProblemReason = Field(
        description="Reason code: why a retune would end, or of the API itself", examples=["node_lost"]
    )
    advice: str | None = Field(default=None, description="What the client or the operator should do")
    job: str | None = Field(default=None, description="URL of the active job", examples=["/jobs/4f0c2a9be113"])
    state: JobState | None = Field(
        default=None, description="State of the job, where the state does not permit what was asked"
    )
    errors: list[InvalidValue] | None = Field(default=None, description="The invalid values of the request")


def problem(
    status: int,
    detail: str,
    *,
    reason: Reason | ProblemReason | None = None,
    headers: dict[str, str] | None = None,
    job: str | None = None,
    state: JobState | None = None,
    errors: Sequence[InvalidValue] = (),
) -> JSONResponse:
    """The response with the problem.

    reason: None for what the status says alone. job: URL of the active job. state: of the job that is asked for.
    """
    why = reason or _BY_STATUS.get(status, ProblemReason.INTERNAL_ERROR)
    body = Problem(
        type=f"{TYPE}{why.value}",
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        reason=why,
        advice=ADVICE[why] if isinstance(why, Reason) else None,
        job=job,
        state=state,
        errors=list(errors) or None,
    )
    content = body.model_dump(mode="json", exclude_none=True)
    return JSONResponse(content, status_code=status, media_type=MEDIA_TYPE, headers=headers)


def of_http(error: HTTPException) -> JSONResponse:
    headers = dict(error.headers) if error.headers else None
    return problem(error.status_code, str(error.detail), headers=headers)


def of_database(error: SQLAlchemyError) -> JSONResponse:
    if is_damage(cause := getattr(error, "orig", None)):
        return problem(503, f"the service's data are damaged ({cause}): no work is taken; /readyz says what to do")
    if not temporary(error):
        return problem(500, f"{type(error).__name__} of the database", reason=Reason.INTERNAL)
    detail = "the database does not answer; jobs that run go on, ask again"
    return problem(503, detail, headers={"Retry-After": "5"})


def still_answering(error: StillAnswering) -> JSONResponse:
    return problem(409, str(error), reason=ProblemReason.STILL_ANSWERING, headers={"Retry-After": "1"})


def install(app: FastAPI) -> None:
    """Adds handlers that turn every exception of a route into a problem."""

    @app.exception_handler(RequestValidationError)
    async def _invalid(_request: Request, error: RequestValidationError) -> JSONResponse:
        errors = [InvalidValue(where=place(each["loc"]), why=words(each)) for each in error.errors()]
        detail = "; ".join(f"{each.where}: {each.why}" for each in errors)
        return problem(422, detail, reason=Reason.BAD_INPUT, errors=errors)

    @app.exception_handler(BadBody)
    @app.exception_handler(UnknownParameter)
    async def _body(_request: Request, error: BadBody | UnknownParameter) -> JSONResponse:
        errors = [InvalidValue(where=error.where, why=error.detail)]
        return problem(422, f"{error.where}: {error.detail}", reason=Reason.BAD_INPUT, errors=errors)

    @app.exception_handler(HTTPException)
    async def _http(_request: Request, error: HTTPException) -> JSONResponse:
        return of_http(error)

    @app.exception_handler(BadLimits)
    async def _limits(_request: Request, error: BadLimits) -> JSONResponse:
        return problem(422, str(error), reason=Reason.BAD_LIMITS)

    @app.exception_handler(BadModel)
    @app.exception_handler(BadTuning)
    async def _input(_request: Request, error: Exception) -> JSONResponse:
        return problem(422, str(error), reason=Reason.BAD_INPUT)

    @app.exception_handler(UnknownLoop)
    async def _unknown_loop(_request: Request, error: UnknownLoop) -> JSONResponse:
        return problem(404, str(error), reason=ProblemReason.UNKNOWN_LOOP)

    @app.exception_handler(NoSuchJob)
    async def _unknown_job(_request: Request, error: NoSuchJob) -> JSONResponse:
        return problem(404, str(error), reason=ProblemReason.UNKNOWN_JOB)

    @app.exception_handler(Busy)
    async def _busy(_request: Request, error: Busy) -> JSONResponse:
        url = f"/jobs/{error.job_id}"
        return problem(409, str(error), reason=ProblemReason.LOOP_BUSY, job=url, headers={"Location": url})

    @app.exception_handler(IllegalMove)
    async def _wrong_state(_request: Request, error: IllegalMove) -> JSONResponse:
        return problem(409, str(error), reason=ProblemReason.WRONG_STATE, state=error.now)

    @app.exception_handler(Conflict)
    async def _conflict(_request: Request, error: Exception) -> JSONResponse:
        return problem(409, str(error))

    @app.exception_handler(NotWanted)
    async def _gone(_request: Request, _error: NotWanted) -> Response:
        return Response(status_code=CLIENT_GONE)

    @app.exception_handler(Locked)
    @app.exception_handler(RemoteSetpoint)
    async def _not_permitted(_request: Request, error: Refused) -> JSONResponse:
        return problem(409, error.detail, reason=error.reason)

    @app.exception_handler(StillAnswering)
    async def _answering(_request: Request, error: StillAnswering) -> JSONResponse:
        return still_answering(error)

    @app.exception_handler(Stopping)
    @app.exception_handler(FolderInUse)
    async def _stopping(_request: Request, error: Exception) -> JSONResponse:
        return problem(503, str(error), reason=Reason.SERVICE_STOPPED)

    @app.exception_handler(NotKnown)
    async def _not_known(_request: Request, error: NotKnown) -> JSONResponse:
        return problem(503, str(error), headers={"Retry-After": "5"})

    @app.exception_handler(DataError)
    async def _unkeepable(_request: Request, error: DataError) -> JSONResponse:
        detail = f"the database cannot look for a name or number in the request: {error.orig}"
        return problem(422, detail, reason=Reason.BAD_INPUT)

    @app.exception_handler(SQLAlchemyError)
    async def _database(_request: Request, error: SQLAlchemyError) -> JSONResponse:
        return of_database(error)

    @app.exception_handler(Ended)
    async def _ended(_request: Request, error: Ended) -> JSONResponse:
        asked_too_much = error.reason is Reason.COMPUTATION_LIMIT
        return problem(422 if asked_too_much else 503, error.detail, reason=error.reason)

    @app.exception_handler(Exception)
    async def _defect(_request: Request, error: Exception) -> JSONResponse:
        return problem(500, f"{type(error).__name__}: {error}", reason=Reason.INTERNAL)


RETRY_AFTER: HeaderField = {"description": "Seconds to wait before another request", "schema": {"type": "integer"}}
_REFERENCE: MediaType = {"schema": {"$ref": "#/components/schemas/Problem"}}


def responses(*statuses: int) -> Responses:
    """The documented error responses of a route with these statuses.

    They refer to the schema that `schemas` adds: with a model, FastAPI would make a field for each of them, one by one.
    """
    content = {MEDIA_TYPE: _REFERENCE, "application/json": _REFERENCE}
    return {status: {"content": content, "description": HTTPStatus(status).phrase} for status in statuses}


def schemas() -> dict[str, Schema]:
    """The schemas of a problem by name, for the components of an OpenAPI document."""
    return schemas_of(Problem)


def documented(*statuses: int) -> dict[int, DocumentedResponse]:
    """The same responses for an OpenAPI document that FastAPI has already generated."""
    found: dict[int, DocumentedResponse] = {}
    for status in statuses:
        found[status] = {"content": {MEDIA_TYPE: _REFERENCE}, "description": HTTPStatus(status).phrase}
        if status in (429, 503):
            found[status]["headers"] = {"Retry-After": RETRY_AFTER}
    return found
