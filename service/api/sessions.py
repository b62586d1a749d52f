"""The route that says who is asking."""

from __future__ import annotations

from importlib.metadata import version

from fastapi import APIRouter
from pydantic import BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.bodies import JsonRoute
from loopwright.service.security.keys import Scope
from loopwright.service.security.principal import current


class SessionView(BaseModel):
    """The caller, and the service that answers."""

    name: str = Field(description="Name of the key; `local`: no keys are asked for", examples=["control room"])
    scope: Scope = Field(description="What the caller may do; each scope includes the one before", examples=["operate"])
    keys: bool = Field(description="Whether keys are asked for")
    host: str = Field(description="Name of the service", examples=["local"])
    version: str = Field(description="Version of the service", examples=["0.1.0"])


def router(host: str, keys: bool) -> APIRouter:
    """A router with GET /session. keys: whether keys are asked for."""
    routes = APIRouter(tags=["operations"], route_class=JsonRoute)

    @routes.get("/session", summary="Who is asking, and what the caller may do", responses=problems.responses())
    def session() -> SessionView:
        who = current.get()
        return SessionView(name=who.name, scope=who.scope, keys=keys, host=host, version=version("loopwright"))

    return routes
