"""The gateways that share a database, and what this one shows of the loops of the others."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime

from fastapi import APIRouter, Response
from pydantic import BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.job_views import LastDataView, LiveErrorView, LiveView
from loopwright.service.api.paging import LINK, Limit, Position, page_of
from loopwright.service.api.routes import new_router
from loopwright.service.errors import GatewayLost
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.live.messages import BusView, LoopValues
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import OwnGateway
from loopwright.service.live.rows import old
from loopwright.service.store.clock import now, stamp
from loopwright.tuning.reasons import Failed, Reason


class GatewayBusView(BaseModel):
    """A bus of a gateway."""

    bus: str = Field(description="Address of the CAN bus", examples=["socketcan:can0"])
    up: bool | None = Field(description="Whether it is up; null: it is not listened to, or not known")
    why: str | None = Field(description="Why there is no data of it; null: there is")

    @classmethod
    def of(cls, bus: BusView) -> GatewayBusView:
        return cls(bus=bus.bus, up=bus.up, why=bus.why)


class GatewayView(BaseModel):
    """A gateway: a service with loops of its own."""

    name: str = Field(examples=["gw-1"])
    here: bool = Field(description="Whether it is the one that answers this request")
    url: str | None = Field(
        description="Where browsers reach it (`loopwright serve --own-url`); null: it has not said so",
        examples=["https://gw-1.example"],
    )
    version: str | None = Field(description="null: it has not run since the database was brought to this version")
    last_seen: str | None = Field(
        description="When it was last there: UTC, ISO 8601, by the clock of the database",
        examples=["2026-01-31T12:00:00.000Z"],
    )
    answers: bool = Field(description="Whether it was there within the last 10 s")
    buses: list[GatewayBusView]
    loops: int = Field(description="Number of its loops", examples=[12])


def router(directory: LoopDirectory, own: OwnGateway, others: OtherGateways) -> APIRouter:
    """A router with GET /gateways."""
    routes = new_router("operations")

    @routes.get(
        "/gateways",
        summary="The gateways that share the database, sorted by name",
        responses={**LINK, **problems.responses(422, 503)},
    )
    def list_gateways(response: Response, limit: Limit = 1000, cursor: Position = None) -> list[GatewayView]:
        others.look()
        loops = Counter(host for _, host in directory.everywhere())
        found = [_here(own, loops[own.name])]
        found += [_other(name, loops[name], others) for name in {*loops, *others.every()} - {own.name}]
        found.sort(key=lambda each: each.name)
        return list(page_of(response, "/gateways", found, limit, cursor))

    return routes


def live_there(config: LoopConfig, host: str, others: OtherGateways) -> tuple[LiveView | None, LiveErrorView | None]:
    """Returns the present state of a loop of another gateway, or why it is not known."""
    tag, why = config.tag, others.why_no_data(host)
    values, settings = others.values(tag, host), others.settings(tag, host)
    if why is None and settings is not None and values.sp is not None and values.mode is not None:
        return LiveView(
            sp=values.sp,
            pv=values.pv,
            mv=values.mv,
            mode=values.mode,
            on_trial=bool(values.on_trial),
            **dict(settings),
        ), None
    if why is not None:
        return None, LiveErrorView.of(GatewayLost(why))
    down = any((bus.gateway, bus.bus, bus.up) == (host, config.bus, False) for bus in others.buses())
    reason = Reason.BUS_LOST if down else Reason.NODE_LOST
    detail = values.no_data or "the controller has not been read yet"
    return None, LiveErrorView.of(Failed(reason, f"gateway {host}: {detail}"))


def last_data(values: LoopValues) -> LastDataView | None:
    """Returns the values that were heard last; None: nothing was heard."""
    last = old(values)
    return None if last is None else LastDataView(**dict(last), age_s=values.age_s)


def _here(own: OwnGateway, loops: int) -> GatewayView:
    buses = [GatewayBusView.of(bus) for bus in own.buses()]
    return GatewayView(
        name=own.name, here=True, url=own.url, version=own.version, last_seen=now(), answers=True, buses=buses,
        loops=loops,
    )  # fmt: skip


def _other(name: str, loops: int, others: OtherGateways) -> GatewayView:
    found = others.every().get(name)
    said = None if found is None else found.said
    return GatewayView(
        name=name,
        here=False,
        url=None if said is None else said.url,
        version=None if said is None else said.version,
        last_seen=None if said is None else stamp(datetime.fromtimestamp(said.at_s, UTC)),
        answers=others.answers(name),
        buses=[GatewayBusView.of(bus) for bus in others.buses() if bus.gateway == name],
        loops=loops,
    )
