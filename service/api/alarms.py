"""Routes for what is abnormal, and for acknowledging it."""

from __future__ import annotations

from typing import Annotated

from fastapi import Body, FastAPI, Path, Request, Response
from fastapi.responses import JSONResponse

from loopwright.service.alarms.alarm import Alarm
from loopwright.service.alarms.watch import FRESH_S, AlarmWatch, NoSuchAlarm
from loopwright.service.api import problems
from loopwright.service.api.job_views import Decision, signed_by
from loopwright.service.api.paging import LINK, Limit, Position, page_of
from loopwright.service.api.routes import add, new_router

AlarmId = Annotated[str, Path(description="Id of the alarm", examples=["0f3ac2d9be11"])]


def install(app: FastAPI, watch: AlarmWatch) -> None:
    """Adds GET /alarms, GET /alarms/{id} and POST /alarms/{id}/acknowledge."""
    router = new_router("alarms")

    @router.get("/alarms", summary="The active alarms, the worst first", responses={**LINK, **problems.responses(422)})
    def list_alarms(response: Response, limit: Limit = 1000, cursor: Position = None) -> list[Alarm]:
        return list(page_of(response, "/alarms", watch.look(FRESH_S), limit, cursor))

    @router.get(
        "/alarms/{alarm_id}", summary="An alarm, also one that was acknowledged", responses=problems.responses(404)
    )
    def get_alarm(alarm_id: AlarmId) -> Alarm:
        return watch.find(alarm_id)

    @router.post(
        "/alarms/{alarm_id}/acknowledge",
        summary="Acknowledge an alarm: a person answers for it, and it ends",
        responses=problems.responses(404, 409, 422),
    )
    def acknowledge_alarm(alarm_id: AlarmId, decision: Annotated[Decision | None, Body()] = None) -> Alarm:
        return watch.acknowledge(alarm_id, signed_by(decision))

    add(app, router)

    @app.exception_handler(NoSuchAlarm)
    async def _unknown(_request: Request, error: NoSuchAlarm) -> JSONResponse:
        return problems.problem(404, str(error), reason=problems.ProblemReason.UNKNOWN_ALARM)
