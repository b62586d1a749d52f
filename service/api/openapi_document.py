"""The types of the parts of an OpenAPI document that this package reads or completes."""

from __future__ import annotations

from typing import Any, TypedDict, cast

from fastapi.encoders import jsonable_encoder
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

Schema = TypedDict(
    "Schema",
    {
        "$ref": str,
        "type": str,
        "pattern": str,
        "maxLength": int,
        "description": str,
        "properties": dict[str, "Schema"],
        "required": list[str],
        "anyOf": list["Schema"],
        "oneOf": list["Schema"],
    },
    total=False,
)


class MediaType(TypedDict, total=False):
    schema: Schema


class RequestBody(TypedDict, total=False):
    content: dict[str, MediaType]


class HeaderField(TypedDict, total=False):
    description: str
    schema: Schema


class DocumentedResponse(TypedDict, total=False):
    description: str
    headers: dict[str, HeaderField]
    content: dict[str, MediaType]


Parameter = TypedDict(
    "Parameter",
    {"name": str, "in": str, "description": str, "required": bool, "schema": Schema, "example": str},
    total=False,
)


class Operation(TypedDict, total=False):
    tags: list[str]
    summary: str
    description: str
    security: list[dict[str, list[str]]]
    parameters: list[Parameter]
    requestBody: RequestBody
    responses: dict[str, DocumentedResponse]


class Info(TypedDict, total=False):
    title: str
    version: str
    description: str
    contact: dict[str, str]
    license: dict[str, str]


class TagObject(TypedDict):
    name: str
    description: str


class Components(TypedDict, total=False):
    schemas: dict[str, Schema]
    securitySchemes: dict[str, dict[str, str]]


class Document(TypedDict, total=False):
    info: Info
    servers: list[dict[str, str]]
    tags: list[TagObject]
    paths: dict[str, dict[str, Operation]]
    webhooks: dict[str, dict[str, Operation]]
    components: Components


def as_document(generated: dict[str, Any]) -> Document:
    """The document that FastAPI generates, which FastAPI types as a dictionary."""
    return cast("Document", generated)


def schemas_of(model: type[BaseModel]) -> dict[str, Schema]:
    """The schemas of a model and of its parts by name, for the components of a document."""
    _, found = models_json_schema([(model, "serialization")], ref_template="#/components/schemas/{model}")
    made: dict[str, Schema] = jsonable_encoder(found["$defs"], exclude_none=True)  # as FastAPI encodes the document
    return made
