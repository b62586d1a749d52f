"""Errors of the API as application/problem+json (RFC 9457), with reason and advice if there are any."""

from __future__ import annotations

from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from pydantic.json_schema import models_json_schema
from sqlalchemy.exc import DataError, SQLAlchemyError
from starlette.exceptions import HTTPException

from loopwright.service.api.bodies import BadBody
from loopwright.service.api.openapi_document import DocumentedResponse, MediaType, Schema
from loopwright.service.errors import Conflict, Locked, NotKnown, RemoteSetpoint, Stopping, UnknownLoop
from loopwright.service.execution.computing.pool import NotWanted
from loopwright.service.inputs.model_json import BadModel
from loopwright.service.inputs.request import BadLimits
from loopwright.service.inputs.validation import place, words
from loopwright.service.jobs.journal import temporary
from loopwright.service.offline.tunings import BadTuning
from loopwright.service.states.job_state import IllegalMove
from loopwright.service.store.claims import StillAnswering
from loopwright.service.store.damage import is_damage
from loopwright.service.store.store import Busy, FolderInUse, NoSuchJob
from loopwright.tuning.reasons import ADVICE, Ended, Reason, Refused

MEDIA_TYPE = "application/problem+json"
Responses = dict[int | str, dict[str, Any]]
"""The type of the argument `responses` of a FastAPI route."""
CLIENT_GONE = 499
"""The status that nginx logs when the client has disconnected; nobody reads the answer."""


class InvalidValue(BaseModel):
    """An invalid value of a request."""

    where: str = Field(description="Path of the value", examples=["body.model.K"])
    why: str = Field(description="Why the value is invalid", examples=["K must not be 0: PV would not answer MV"])


class Problem(BaseModel):
    """RFC 9457 problem details."""

    type: str = Field(description="Kind of problem", examples=["about:blank"])
    title: str = Field(description="Title of the HTTP status", examples=["Conflict"])
    status: int = Field(description="HTTP status", examples=[409])
    detail: str = Field(
        description="Explanation of this occurrence",
        examples=["loop TIC-101 is locked by night shift since 2026-01-31T12:00:00.000Z: valve"],
    )
    reason: Reason | None = Field(default=None, description="Reason code from the closed list", examples=["node_lost"])
    advice: str | None = Field(default=None, description="What the client or the operator should do")
    job: str | None = Field(default=None, description="URL of the active job", examples=["/jobs/4f0c2a9be113"])
    errors: list[InvalidValue] | None = Field(default=None, description="The invalid values of the request")


def problem(
    status: int,
    detail: str,
    *,
    reason: Reason | None = None,
    headers: dict[str, str] | None = None,
    job: str | None = None,
    errors: Sequence[InvalidValue] = (),
) -> JSONResponse:
    """The response with the problem. job: URL of the active job."""
    body = Problem(
        type="about:blank",
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        reason=reason,
        advice=None if reason is None else ADVICE[reason],
        job=job,
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
    return problem(409, str(error), headers={"Retry-After": "1"})


def install(app: FastAPI) -> None:
    """Adds handlers that turn every exception of a route into a problem."""

    @app.exception_handler(RequestValidationError)
    async def _invalid(_request: Request, error: RequestValidationError) -> JSONResponse:
        errors = [InvalidValue(where=place(each["loc"]), why=words(each)) for each in error.errors()]
        detail = "; ".join(f"{each.where}: {each.why}" for each in errors)
        return problem(422, detail, reason=Reason.BAD_INPUT, errors=errors)

    @app.exception_handler(BadBody)
    async def _body(_request: Request, error: BadBody) -> JSONResponse:
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
    @app.exception_handler(NoSuchJob)
    async def _unknown(_request: Request, error: Exception) -> JSONResponse:
        return problem(404, str(error))

    @app.exception_handler(Busy)
    async def _busy(_request: Request, error: Busy) -> JSONResponse:
        url = f"/jobs/{error.job_id}"
        return problem(409, str(error), job=url, headers={"Location": url})

    @app.exception_handler(IllegalMove)
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


_REFERENCE: MediaType = {"schema": {"$ref": "#/components/schemas/Problem"}}


def responses(*statuses: int) -> Responses:
    """The documented error responses of a route with these statuses.

    They refer to the schema that `schemas` adds: with a model, FastAPI would make a field for each of them, one by one.
    """
    content = {MEDIA_TYPE: _REFERENCE, "application/json": _REFERENCE}
    return {status: {"content": content, "description": HTTPStatus(status).phrase} for status in statuses}


def schemas() -> dict[str, Schema]:
    """The schemas of a problem by name, for the components of an OpenAPI document."""
    _, found = models_json_schema([(Problem, "serialization")], ref_template="#/components/schemas/{model}")
    made: dict[str, Schema] = jsonable_encoder(found["$defs"], exclude_none=True)  # as FastAPI encodes the document
    return made


def documented(*statuses: int) -> dict[int, DocumentedResponse]:
    """The same responses for an OpenAPI document that FastAPI has already generated."""
    content = {MEDIA_TYPE: _REFERENCE}
    return {status: {"content": content, "description": HTTPStatus(status).phrase} for status in statuses}
