"""The routes of one subject, which are added to the application as they are.

FastAPI's include_router analyses every route of a router a second time, at the first request: 60 ms of processor time
for the routes of this service.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, FastAPI, Path
from fastapi.routing import APIRoute

from loopwright.service.api.bodies import JsonRoute

Tag = Annotated[str, Path(description="Tag of the loop", examples=["TIC-101"])]
JobId = Annotated[str, Path(description="Id of the job", examples=["4f0c2a9be113"])]


def name_of(route: APIRoute) -> str:
    """The id of an operation in the OpenAPI document, by which generated clients name their functions."""
    return route.name


def new_router(*tags: str) -> APIRouter:
    """A router without routes. tags: of all its operations."""
    return APIRouter(tags=list(tags), route_class=JsonRoute, generate_unique_id_function=name_of)


def add(app: FastAPI, router: APIRouter) -> None:
    """Adds all routes of a router."""
    app.router.routes.extend(router.routes)
