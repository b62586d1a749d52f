"""The route of the decisions: who began, stopped, accepted and rolled back tests. The audit trail has them too, with
network addresses and ids of keys, and is for administrators."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response
from pydantic import AfterValidator, AwareDatetime, BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.paging import LINK, Cursor, Limit, more
from loopwright.service.api.routes import new_router
from loopwright.service.jobs.manager import Jobs
from loopwright.service.results import GainsView
from loopwright.service.states.loop_state import gains_of
from loopwright.service.store import audit
from loopwright.service.store.clock import stamp
from loopwright.service.store.tables import AuditRow


def _in_utc(at: datetime) -> datetime:
    try:
        return at.astimezone(UTC)
    except OverflowError:
        raise ValueError("in UTC this time is not within the years 1 to 9999") from None


DecisionKind = Literal["retune", "abort", "accept", "rollback", "accept_failed", "rollback_failed"]
KINDS: tuple[DecisionKind, ...] = ("retune", "abort", "accept", "rollback", "accept_failed", "rollback_failed")


class DecisionView(BaseModel):
    """A decision that somebody has made about a test."""

    number: int = Field(description="Sequence number; the latest decision has the largest one", examples=[17])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    what: DecisionKind = Field(description="accept_failed, rollback_failed: the gains may not have been written")
    loop: str = Field(examples=["TIC-101"])
    job: str = Field(description="URL of the job", examples=["/jobs/4f0c2a9be113"])
    by: str | None = Field(description="Who decided, as given in the request", examples=["operator A"])
    key: str = Field(
        description="Name of the key of the request; `local`: a request without a key from this machine; `cli:USER`: a "
        "command on this machine; `service`: the service itself",
        examples=["control room"],
    )
    gateway: str | None = Field(
        description="Name of the gateway at which it was asked; null: no other shares the database, or the service "
        "itself did it",
        examples=["gw-1"],
    )
    previous_gains: GainsView | None = Field(description="Gains in effect before an acceptance or a rollback")
    new_gains: GainsView | None = Field(description="Gains in effect after an acceptance or a rollback")
    error: str | None = Field(description="Why the decision failed; null: it did not")


def router(jobs: Jobs) -> APIRouter:
    """A router with GET /decisions."""
    routes = new_router("jobs")

    @routes.get(
        "/decisions",
        summary="Who began, stopped, accepted and rolled back tests, the latest first",
        responses={**problems.responses(422), **LINK},
    )
    def list_decisions(
        response: Response,
        loop: Annotated[
            str | None, Query(max_length=64, description="Only decisions about this loop", examples=["TIC-101"])
        ] = None,
        by: Annotated[
            str | None,
            Query(max_length=200, description="Only those with this name, in the request or of the key"),
        ] = None,
        begin: Annotated[
            Annotated[AwareDatetime, AfterValidator(_in_utc)] | None,
            Query(
                alias="from",
                description="Only decisions from this time on, ISO 8601 with a time zone",
                examples=["2026-01-31T12:00:00Z"],
            ),
        ] = None,
        limit: Limit = 100,
        cursor: Cursor = None,
    ) -> list[DecisionView]:
        from_at = None if begin is None else stamp(begin)
        rows = audit.trail(jobs.store.engine, limit + 1, cursor, KINDS, loop, by, from_at)
        if len(rows) > limit:
            rows = rows[:limit]
            given = {"loop": loop, "by": by, "from": from_at, "limit": limit}
            more(response, "/decisions", rows[-1].number, **given)
        return [_view(row) for row in rows]

    return routes


def _view(row: AuditRow) -> DecisionView:
    after = row.after or {}
    decided = row.what in ("accept", "rollback")
    return DecisionView(
        number=row.number,
        at=row.at,
        what=_kind(row.what),
        loop=row.loop or "",
        job=f"/jobs/{row.subject}",
        by=row.by,
        key=row.key,
        gateway=row.gateway,
        previous_gains=_gains(row.before) if decided else None,
        new_gains=_gains(row.after) if decided else None,
        error=str(after["error"]) if "error" in after else None,
    )


def _kind(what: str) -> DecisionKind:
    return next(kind for kind in KINDS if kind == what)


def _gains(state: Mapping[str, object] | None) -> GainsView | None:
    gains = None if state is None else state.get("gains")
    return GainsView.of(gains_of(gains)) if isinstance(gains, dict) else None
